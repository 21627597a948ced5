"""The command line: one message and the right exit code for every mistake, fast and full help."""

import errno
import json
import os
import shlex
import subprocess
import sys
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest

from experiments import run_study as study_runs
from experiments.cli.main import main
from experiments.preparing import pipeline, windows
from experiments.presets import get_preset
from experiments.running.attempts import State, read_states
from experiments.running.launchers.registry import LauncherOptions
from experiments.running.ledger import Ledger
from experiments.running.runner import Job
from experiments.running.workspace import Workspace, load_record, save_record
from experiments.study_setup import StudyArguments, make_setup
from experiments.sweeps.draws import draw_judged
from experiments.terminal.exit_code import exit_code_of
from hma_jax.config import ConfigError
from hma_jax.runtime import outputs
from hma_jax.runtime.exits import Exit
from tests.experiments.fakes import PROVENANCE, finished_study, record_of

COMMANDS = ("", "study", "sweep", "data", "data suite", "data list", "data inspect", "tokenizer",
            "tokenizer train", "tokenizer import", "tokenizer pixels", "tokenize", "train", "evaluate", "report",
            "convert", "convert from-official", "convert to-official", "convert to-safetensors",
            "convert from-safetensors", "convert to-stablehlo", "bench", "bench generate", "fit",
            "coord-check")  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([*command.split(), "--help"])
    assert end.value.code == 0
    assert "usage: hma" in capsys.readouterr().out


def test_help_needs_no_jax():
    code = "import sys, experiments.cli.main; sys.exit('jax' in sys.modules or 'matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


BEGINS = "import os, sys; from experiments.terminal.exit_code import exit_code_of; "
PRINTS = BEGINS + "sys.exit(exit_code_of(lambda: print(1)))"
ASKS = (
    BEGINS + "from experiments.running.subprocess_call import call_in_subprocess; "
    "sys.exit(exit_code_of(lambda: call_in_subprocess('asks', os.getpid)))"
)


@pytest.mark.parametrize("arguments", [("-m", "experiments.cli", "data", "list"), ("-c", PRINTS), ("-c", ASKS)])
def test_a_program_whose_output_is_closed_works_on(arguments):
    """As supervisors start some: hma, a program of its own, one that starts another process."""
    command = f"exec {shlex.join([sys.executable, *arguments])} >&- 2>&-"
    assert subprocess.run(command, shell=True, timeout=120).returncode == 0


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["study", "--preset", "smoke", "--set", "model.frame=4"], 2, "did you mean model.frames"),
        (["sweep", "transfer", "--preset", "smoke", "--set", "transfer.rates=7"], 2, "sets the grid of the axis lr"),
        (["study", "--preset", "paper"], 2, "--data"),
        (["study", "--preset", "smoke", "--out", "{file}/out"], 2, "cannot write to {file}/out: {file} is a file"),
        (["tokenize", "--preset", "smoke", "--out", "/proc/x/y"], 2, "nothing can be written in /proc (No such file"),
        (["data", "inspect", "{empty}", "--out", "/proc/x"], 2, "cannot write to /proc/x: nothing can be written in"),
        (["data", "inspect", "{empty}", "--out", "{file}"], 2, "cannot write to {file}: {file} is a file"),
        (["data", "view", "{empty}", "--out", "/proc/x/y.html"], 2, "cannot write to /proc/x: nothing can be written"),
        (["data", "view", "{empty}", "--out", "/proc/y.html"], 2, "cannot write to /proc: nothing can be written in"),
        (["tokenizer", "pixels", "--out", "/proc/x"], 2, "cannot write to /proc/x: nothing can be written in"),
        (["compare", "{empty}", "{empty}", "--to", "/proc/x/c.csv"], 2, "choose another --to, in a directory where"),
        (["study", "--preset", "smoke", "--data", "{empty}"], 1, "{empty}"),
        (["study", "--preset", "smoke", "--data", "{empty}/none"], 2, "{empty}/none"),
        (
            ["train", "--preset", "smoke", "--out", "{file}/out", "--dry-run"],
            2,
            "{file} is a file; choose another --out",
        ),
        (["study", "--preset", "smoke", "--dry-run", "--set", "datasets=bridge_datase,b,c"], 2, "bridge_dataset"),
        (["sweep", "width", "--preset", "smoke", "--workers", "0", "--dry-run"], 2, "--workers"),
        (["study", "--preset", "smoke", "--dry-run", "--launcher-set", "bogus=1"], 2, "no such setting; it has none"),
        (
            ["study", "--preset", "smoke", "--dry-run", "--set", "axes="],
            2,
            "axes is empty: the study has no sweep to run",
        ),
        (["sweep", "lr_horizon", "--preset", "cpu-full-continuous", "--dry-run"], 2, "designs.budgets is empty"),
        (["study", "--preset", "smoke", "--dry-run", "--set", "suite.fewest=0"], 2, "suite.fewest must be at least 1"),
        (["report", "{empty}"], 2, "no study"),
        (["evaluate", "{empty}", "--preset", "smoke"], 2, "checkpoint"),
        (["tokenizer", "import", "{empty}", "--out", "{empty}/t"], 2, "{empty}/config.json"),
        (["tokenizer", "import", "{empty}/no.ckpt", "--out", "{empty}/t"], 2, "at {empty}/no.ckpt"),
        (["tokenizer", "import", "{file}", "--out", "{empty}/t"], 2, "{file}: not a readable zip file"),
        (["tokenizer", "pixels", "--out", "{file}"], 2, "{file} exists already"),
        (["tokenizer", "pixels", "--out", "{empty}/t", "--patch", "7"], 2, "64 is not a multiple of 7"),
        (["tokenize", "--preset", "smoke", "--tokenizer", "{empty}"], 2, "hma tokenizer import"),
        (["tokenize", "--preset", "smoke", "--out", "{empty}", "--batch", "0"], 2, "--batch must be at least 1, got 0"),
        (["tokenize", "--preset", "smoke", "--out", "{empty}", "--threads", "-3"], 2, "--threads must be at least 1"),
        (
            ["generate", "{empty}", "--actions", "x", "--out", "{empty}", "--clips", "-1"],
            2,
            "--clips must not be negative",
        ),
        (["convert", "from-official", "{empty}", "--out", "{empty}/run"], 2, "{empty}/config.json"),
        (["convert", "to-official", "{empty}", "--out", "{empty}/x"], 2, "{empty}/checkpoints"),
        (["convert", "from-safetensors", "{empty}", "--out", "{empty}/x"], 2, "{empty}/model.json"),
        (["convert", "to-safetensors", "{empty}", "--out", "{file}"], 2, "{file} exists already"),
        (["convert", "to-stablehlo", "{empty}", "--out", "{empty}/x", "--prompt", "9"], 2, "{empty}/checkpoints"),
    ],
)
def test_a_mistake_is_one_message_and_an_exit_code(arguments, code, message, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    places = {"empty": tmp_path / "empty", "file": tmp_path / "file"}
    assert main([a.format(**places) for a in arguments]) == code
    said = capsys.readouterr()
    assert said.err.startswith("error: ") and "Traceback" not in said.err
    assert message.format(**places) in said.err


@pytest.mark.parametrize(
    ("command", "word"), [("convert to-safetensors x --out", "begins anew"), ("adapt x", "continues")]
)
def test_a_command_that_is_stopped_says_what_the_same_will_do(command, word, tmp_path, monkeypatch, capsys):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("hma_jax.training.runs.load_run", stopped)
    arguments = command.split() + ([str(tmp_path / "y")] if command.endswith("--out") else [])
    assert main(arguments) == 130 and f"the same command {word}" in capsys.readouterr().err


def test_wrong_choice_exits_with_2(capsys):
    with pytest.raises(SystemExit) as end:
        main(["sweep", "width", "--preset", "gpu"])
    assert end.value.code == 2 and "cpu" in capsys.readouterr().err


def test_debug_shows_the_traceback(tmp_path):
    with pytest.raises(Exception, match="no study"):
        main(["report", str(tmp_path), "--debug"])


def test_paper_plan_prints_the_papers_sizes(capsys):
    assert main(["sweep", "width", "--preset", "paper", "--dry-run"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    for width, size in (("64", "3.0"), ("256", "43.6"), ("768", "383.0")):
        assert any(width in words and size in words for words in lines)


@pytest.mark.parametrize(
    ("module", "shown"),
    [
        ("width", "control"),
        pytest.param("settings", "full dynamics, seed 1", marks=pytest.mark.slow),
        pytest.param("conditioning", "cross_attention, seed 0", marks=pytest.mark.slow),
        pytest.param("lr", "learning rate 0.002, no muP", marks=pytest.mark.slow),
    ],
)
def test_sweep_modules_run_as_programs(module, shown):
    done = subprocess.run(
        [sys.executable, "-m", f"experiments.sweeps.{module}", "--preset", "smoke", "--dry-run"],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0 and shown in done.stdout, done.stderr


def test_a_study_is_the_scaling_axes_only(capsys):
    assert main(["study", "--preset", "smoke", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "5 trials" in said and "passive" not in said


def test_report_is_drawn_again_from_disk(unrendered, tmp_path, capsys):
    workspace = finished_study(tmp_path)
    save_record(workspace, record_of())
    assert main(["report", str(tmp_path)]) == 0
    assert "report.html" in capsys.readouterr().out and workspace.report.exists()


@pytest.mark.parametrize(
    ("why", "do"),
    [(errno.EROFS, "copy it to a directory where you may write"), (errno.ENOSPC, "make room on its disk")],
)
def test_a_report_that_cannot_be_written_names_no_option_that_there_is_not(why, do, tmp_path, monkeypatch, capsys):
    def refuse(dir: Path) -> None:
        raise OSError(why, os.strerror(why), str(dir))

    save_record(finished_study(tmp_path), record_of())
    monkeypatch.setattr(outputs.tempfile, "TemporaryFile", refuse)
    assert main(["report", str(tmp_path)]) == 2
    assert f"nothing can be written in {tmp_path} ({os.strerror(why)}); {do}" in capsys.readouterr().err


def test_a_record_that_does_not_say_what_its_trials_depend_on_is_damaged(tmp_path, capsys):
    workspace = Workspace(tmp_path)
    save_record(workspace, record_of())
    values = json.loads(workspace.record.read_text())
    for record in (values | {"provenance": None}, {name: x for name, x in values.items() if name != "provenance"}):
        workspace.record.write_text(json.dumps(record))
        assert main(["status", str(tmp_path)]) == 2
        assert "damaged or of another version" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["report", "fit"])
def test_a_study_whose_axes_were_taken_out_of_its_record_is_told_so(command, tmp_path, capsys):
    workspace = finished_study(tmp_path)
    save_record(workspace, record_of(axes=()))
    assert main([command, str(tmp_path)]) == 2
    said = f"{workspace.record}: axes is empty; restore the axes that the study had, or run `hma study`"
    assert said in capsys.readouterr().err and not workspace.report.exists()


def test_a_study_of_named_axes_alone_has_nothing_to_fit(tmp_path, capsys):
    """It was a table without a line."""
    workspace = finished_study(tmp_path, axes=("settings",))
    save_record(workspace, record_of(axes=("settings",)))
    assert main(["fit", str(tmp_path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "has no axis along which the loss may follow a power law" in said and "exponents" not in said


def test_trials_of_a_curve_that_have_no_result_are_counted_beside_its_fit(tmp_path, capsys):
    workspace = finished_study(tmp_path)
    save_record(workspace, record_of())
    assert main(["fit", str(tmp_path)]) == 0 and "have no result" not in capsys.readouterr().out
    (unfinished, *_) = sorted(workspace.trials.glob("*/result.json"))
    unfinished.unlink()
    assert main(["fit", str(tmp_path)]) == 0
    assert "1 of the " in (said := capsys.readouterr().out) and "trials of these curves have no result" in said


@pytest.fixture
def instant_trials(monkeypatch):
    """Nothing is prepared; trials have fake results, but those of width 8 fail."""

    def run_missing(jobs, trials, ledger, launcher, **_):
        record = load_record(Workspace(trials.parent))
        finished_study(trials.parent, record.study, broken={"width 8 ": "failed"}, axes=record.axes)
        return read_states([job.id for job in jobs], trials, Ledger(ledger.path))

    monkeypatch.setattr(pipeline, "prepare", lambda *_, **__: PROVENANCE)
    monkeypatch.setattr(windows, "require_judged", lambda *_: None)
    monkeypatch.setattr(study_runs, "run_missing", run_missing)
    monkeypatch.setattr(LauncherOptions, "launcher", lambda *_: nullcontext())


def test_a_place_without_its_engine_is_refused_before_anything_is_prepared(monkeypatch, tmp_path, capsys):
    def nowhere(*_):
        raise ConfigError("Slurm is not available")

    monkeypatch.setattr(LauncherOptions, "launcher", nowhere)
    monkeypatch.setattr(pipeline, "prepare", lambda *_, **__: pytest.fail("hours were spent on preparing"))
    assert main(["study", "--preset", "smoke", "--out", str(tmp_path / "out")]) == 2
    assert "Slurm is not available" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_the_place_where_trials_run_is_entered_once(instant_trials, unrendered, tmp_path, monkeypatch):
    """A Ray cluster was joined to see that it is there, left, and joined again once all was prepared."""
    entered, place = [], object()

    @contextmanager
    def enter(*_):
        entered.append("in")
        yield place
        entered.append("out")

    monkeypatch.setattr(LauncherOptions, "launcher", enter)
    real = study_runs.run_missing
    monkeypatch.setattr(
        study_runs, "run_missing", lambda *given, **more: entered.append(given[3] is place) or real(*given, **more)
    )
    assert main(["sweep", "settings", "--preset", "smoke", "--out", str(tmp_path)]) == 0
    assert entered == ["in", True, "out"]


@pytest.mark.parametrize("command", ["study --out", "train --out", "train --out plain --run"])
def test_checkpoints_that_could_not_be_read_are_not_trained_for(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*command.split(), "a [1]", "--preset", "smoke"]) == 2
    assert "a path with [1] cannot hold checkpoints" in capsys.readouterr().err
    assert not (tmp_path / "plain").exists() and not (tmp_path / "a [1]" / "suite").exists()


def test_failed_trial_ends_in_exit_code_1_and_is_still_drawn(instant_trials, tmp_path, capsys):
    assert main(["study", "--preset", "smoke", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert "1 of 5 trials have no result" in said.err and "width 8" in said.err and "--retry-failed" in said.err
    assert "failed" in (tmp_path / "results.csv").read_text()
    assert (tmp_path / "report.html").exists()


def test_trials_that_diverged_are_final(capsys):
    """No command is advised that would train them again to the same end."""
    jobs = [Job(id, f"trial {id}", {}) for id in "abc"]

    def ends(*events: str) -> int:
        states = {job.id: State(event) for job, event in zip(jobs, events, strict=True)}
        return exit_code_of(lambda: study_runs.require_results(jobs, states, "hma study --retry-failed", False))

    assert ends("finished", "diverged", "diverged") == Exit.DIVERGED
    assert capsys.readouterr().err.endswith("  diverged: trial c\n2 diverged, which is final: from the same seed they "
                                            "would diverge again. The report shows it\n")  # fmt: skip
    assert ends("finished", "diverged", "failed") == Exit.FAILED
    assert capsys.readouterr().err.endswith("To try the others again: hma study --retry-failed\n")
    assert ends("finished", "finished", "finished") == Exit.DONE


def test_an_ablation_ends_in_its_own_page(instant_trials, unrendered, tmp_path, capsys):
    assert main(["sweep", "settings", "--preset", "smoke", "--out", str(tmp_path)]) == 0
    assert [p.name for p in (tmp_path / "figures").iterdir()] == ["settings.png"]
    assert "Ablation: dynamics setting" in (tmp_path / "report.html").read_text()


@pytest.fixture
def no_trials(instant_trials, monkeypatch):
    """None is run, and nothing is drawn."""
    for name in ("run_jobs", "draw", "require_results"):
        monkeypatch.setattr(study_runs, name, lambda *_: None)


def test_a_study_remembers_the_command_that_runs_all_of_it(no_trials, tmp_path, monkeypatch, capsys):
    """Not the last one, which ran one axis and was to replace something."""
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "from dataclasses import replace\nfrom experiments.sweeps import trajectories\n"
        "def plan(study):\n    return replace(trajectories.plan(study), name='own')\n"
    )
    where, others = ["--preset", "smoke", "--out", "a b"], ["--set", "train.steps=2"]
    assert main(["study", *where, "--set", "axes=settings", *others, "--replace", "study", "--accept-code"]) == 0
    assert main(["sweep", "mine.py", *where, *others, "--retry-failed", "--accept-code"]) == 0
    command = load_record(Workspace(tmp_path / "a b")).command
    assert shlex.split(command) == ["hma", "study", *where, *others, "--set", "axes=settings,a b/axes/own.py"]
    Path("mine.py").unlink()
    capsys.readouterr()
    assert main([*shlex.split(command)[1:], "--dry-run"]) == 0 and "full dynamics" in capsys.readouterr().out
    assert main(["study", "--preset", "smoke", "--out", "plain"]) == 0
    assert load_record(Workspace(tmp_path / "plain")).command == "hma study --preset smoke --out plain"


def test_a_dry_run_says_that_trials_ran_other_sources_as_the_command_does(no_trials, tmp_path, capsys):
    """Those of its other axes too; the command says so only once all is prepared."""
    study = make_setup(StudyArguments("smoke", tmp_path)).study
    finished_study(tmp_path, study, axes=("settings",))  # by sources that are not these
    save_record(Workspace(tmp_path), record_of(study, ("settings",)))
    command = ["sweep", "conditioning", "--preset", "smoke", "--out", str(tmp_path)]
    for options, refused in (([], True), (["--accept-code"], False)):
        assert main([*command, *options, "--dry-run"]) == 0
        said = " ".join(capsys.readouterr().out.split())
        assert ("this command would be refused: " in said) == ("to be run; differs in experiments" in said) == refused
        assert ("CHANGELOG.md" in said) == refused
    assert main(command) == 2 and "CHANGELOG.md" in capsys.readouterr().err


def test_a_refused_command_leaves_the_axes_of_a_study_alone(no_trials, tmp_path, monkeypatch):
    path, out = tmp_path / "mine.py", tmp_path / "out"
    path.write_text("from dataclasses import replace\nfrom experiments.sweeps import settings\n"
                    "def plan(study):\n    return replace(settings.plan(study), name='own')\n")  # fmt: skip
    assert main(["sweep", str(path), "--preset", "smoke", "--out", str(out)]) == 0
    kept = {file: file.read_bytes() for file in (out / "axes/own.py", out / "study.json")}
    path.write_text(path.read_text() + "# edited\n")

    def refuse(*_):
        raise ConfigError("trials ran other sources")

    monkeypatch.setattr(study_runs, "require_agreement", refuse)
    assert main(["sweep", str(path), "--preset", "smoke", "--out", str(out)]) == 2
    assert {file: file.read_bytes() for file in kept} == kept


def test_axes_of_one_study_share_a_report(instant_trials, unrendered, tmp_path):
    for axis in ("trajectories", "datasets"):
        main(["sweep", axis, "--preset", "smoke", "--out", str(tmp_path)])
        for trial in (tmp_path / "trials").iterdir():
            [path.unlink() for path in trial.iterdir()]
            trial.rmdir()
    assert load_record(Workspace(tmp_path)).axes == ("trajectories", "datasets")


def test_a_study_of_other_settings_is_not_drawn_over(instant_trials, unrendered, tmp_path, capsys):
    smoke = ["--preset", "smoke", "--out", str(tmp_path)]
    assert main(["sweep", "settings", *smoke]) == 0
    page = (tmp_path / "report.html").read_bytes()
    capsys.readouterr()
    other = ["sweep", "conditioning", *smoke, "--set", "train.steps=7"]
    assert main(other) == 2
    said = capsys.readouterr().err
    assert f"{tmp_path / 'study.json'} holds " in said and "train.steps: 3 -> 7" in said and "--replace study" in said
    assert (tmp_path / "report.html").read_bytes() == page
    assert load_record(Workspace(tmp_path)).axes == ("settings",)
    assert main([*other, "--replace", "study"]) == 0
    assert load_record(Workspace(tmp_path)).axes == ("conditioning",)  # nothing in common


def test_axes_whose_trials_stay_the_same_stay_on_the_page_of_a_study_that_is_replaced(no_trials, tmp_path, capsys):
    """After a width was added, the page had that axis alone."""
    smoke = ["--preset", "smoke", "--out", str(tmp_path)]
    assert main(["study", *smoke]) == 0
    wider = ["sweep", "width", *smoke, "--set", "widths=8,16,32"]
    capsys.readouterr()
    assert main([*wider, "--dry-run"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "this command would be refused: " in said and "Finished trials stay" in said
    assert main([*wider, "--replace", "study"]) == 0
    assert load_record(Workspace(tmp_path)).axes == ("datasets", "trajectories", "width")
    assert "leave out" not in capsys.readouterr().out
    assert main([*wider, "--set", "train.steps=7", "--replace", "study"]) == 0
    assert load_record(Workspace(tmp_path)).axes == ("width",)
    said = " ".join(capsys.readouterr().out.split())
    assert "the page will leave out axes that ran with other settings: datasets, trajectories." in said


def test_robots_that_any_seed_is_judged_on_need_held_out_windows(instant_trials, tmp_path, capsys, monkeypatch):
    """Before any trial: on designs over robots every seed judges others."""
    smoke = get_preset("smoke")
    drawn = [set(draw_judged(smoke, seed)) for seed in (0, 3)]
    assert drawn[0] != set.union(*drawn)

    def require_judged(study, workspace, judged):
        raise ConfigError(f"judged: {sorted(judged)}")

    monkeypatch.setattr(windows, "require_judged", require_judged)
    assert main(["sweep", "dilution", "--preset", "smoke", "--set", "seeds=0,3", "--out", str(tmp_path)]) == 2
    assert f"judged: {sorted(set.union(*drawn))}" in capsys.readouterr().err


def test_settings_that_no_axis_so_far_depends_on_go_on_with_the_study(instant_trials, unrendered, tmp_path):
    smoke = ["--preset", "smoke", "--out", str(tmp_path)]
    assert main(["sweep", "settings", *smoke]) == 0
    for trial in (tmp_path / "trials").iterdir():
        [path.unlink() for path in trial.iterdir()]
        trial.rmdir()
    assert main(["sweep", "conditioning", *smoke, "--set", "widths=8,32", "--set", "flops_per_second=1"]) == 0
    assert load_record(Workspace(tmp_path)).axes == ("settings", "conditioning")


def test_a_record_that_cannot_be_read_is_not_replaced_either(instant_trials, tmp_path, capsys):
    (tmp_path / "study.json").write_text('{"study": {"name": "of another version"}}')
    assert main(["sweep", "settings", "--preset", "smoke", "--out", str(tmp_path)]) == 2
    assert "damaged or of another version" in capsys.readouterr().err
    assert "of another version" in (tmp_path / "study.json").read_text()


def test_failed_trials_are_tried_again_by_the_command_that_is_printed(
    instant_trials, unrendered, tmp_path, capsys, monkeypatch
):
    smoke = ["--preset", "smoke", "--out", str(tmp_path)]
    placed = ["--workers", "2", "--launcher", "slurm", "--launcher-set", "gpus=1", "--launcher-set", "partition=a b"]
    assert main(["sweep", "width", *smoke, "--set", "widths=8,32", *placed]) == 1
    printed = capsys.readouterr().err.split("To try them again: ")[1].strip()
    asked = {}

    def run_study(setup, axes, **how):
        asked.update(how, setup=setup, axes=axes)

    monkeypatch.setattr(study_runs, "run_study", run_study)
    assert main(shlex.split(printed)[1:]) == 0
    assert asked["retry_failed"] and asked["axes"] == ("width",)
    assert asked["launcher_options"] == LauncherOptions("slurm", 2, ("gpus=1", "partition=a b"))
    assert asked["setup"] == make_setup(StudyArguments("smoke", tmp_path, set=("widths=8,32",)))


def test_sigterm_ends_like_an_interruption_with_a_last_word(tmp_path):
    """Before, the process was just gone, and its trials with it, without a word."""
    program = (
        "import sys, time; from experiments.cli import main; from experiments import run_study\n"
        "def run(*_, **__):\n"
        "    try:\n"
        "        print('at work', flush=True)\n"
        "        time.sleep(60)\n"
        "    finally: print('saved', flush=True)\n"
        "run_study.run_study = run\n"
        "sys.exit(main.main(['study', '--preset', 'smoke']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "at work\n"
    process.terminate()
    out, said = process.communicate(timeout=60)
    assert (process.returncode, out) == (143, "saved\n")
    assert said == "stopped by a signal; the same command continues from here\n"
