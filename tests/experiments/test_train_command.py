"""`hma train`: its own settings, and what it says it trains on."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipelines.loading import loader
from data_pipelines.registry import DatasetSpec
from data_pipelines.registry import table as registry_table
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.evalset import freeze_manifest
from experiments.cli.initial_model import new_datasets, setup_of
from experiments.cli.main import main
from experiments.presets import get_preset
from experiments.running import run_trial as trials
from experiments.running.launchers import local
from experiments.running.run_options import RunOptions
from experiments.running.slots import Accelerators
from experiments.study_setup import StudyArguments
from hma_jax.config import ConfigError
from hma_jax.convert import read_official, write_run
from hma_jax.tokenizers.autoencoder import declare_tokenizer
from hma_jax.tokenizers.io import save_tokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer
from hma_jax.training import train as model_training
from hma_jax.training.reading import list_steps
from hma_jax.training.run_lock import locked_run
from hma_jax.training.runs import load_run
from tests.data_pipelines.fakes import write_rlds
from tests.data_pipelines.windows.test_evalset import small_store
from tests.experiments.idle import ARM, BASE, SMOKE, idle_training  # noqa: F401
from tests.hma_jax.convert.fakes import DISCRETE, make_checkpoint

PAGE = Path(__file__).parents[2] / "docs" / "models.md"


@pytest.fixture(scope="module")
def where(tmp_path_factory) -> list[str]:
    """Ten training episodes of one robot with 3 windows each, of another none that is long enough."""
    root = tmp_path_factory.mktemp("data")
    data = [write_rlds(root, ARM, [18] * 12), write_rlds(root, BASE, [3, 2, 3, 3])]
    return [*SMOKE, "--out", str(root / "out"), "--data", *map(str, data)]


@pytest.fixture
def train(where, tmp_path, monkeypatch, capsys):
    """Runs `hma train`; returns what it said and how training was called."""
    calls, phases, real = [], [], trials.train_trial

    def spy(trial, prepared, run, **how):
        calls.append((trial, how["options"]))
        return real(trial, prepared, run, **how | {"progress": lambda phase, *_: phases.append(phase)})

    monkeypatch.setattr(trials, "train_trial", spy)

    def run(*arguments: str):
        capsys.readouterr()
        assert main(["train", *where, "--run", str(tmp_path / "run"), *arguments]) == 0
        return capsys.readouterr().out, *calls[-1]

    run.phases = phases  # what the progress line said
    return run


def test_all_trajectories_unless_told_otherwise(train, tmp_path):
    """The smoke study has at most 4 of each robot; no sweep's bound holds for a single model."""
    said, trial, _ = train()
    assert trial.max_trajectories is None
    assert (
        "training on 1 of 2 robots: 10 of 13 trajectories, 30 windows of 4 frames, each seen 0.4 times on average"
        in said
    )
    assert f"\nlogs: {tmp_path / 'run'} (tensorboard --logdir {tmp_path / 'run'})\n" in said
    assert list((tmp_path / "run" / "tensorboard").iterdir())
    assert (
        f"note: not trained on {BASE.name}: a window has at least 2 frames, which at stride 2 need 4 native frames"
        in said
    )
    assert load_run(tmp_path / "run").provenance["loader"]["max_trajectories"] is None


def test_a_dry_run_prices_the_one_model_and_makes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(local, "find_accelerators", lambda: None)
    dry = ["train", "--preset", "smoke", "--dry-run", "--out", str(tmp_path), "--set", "flops_per_second=1e20"]
    dry += ["--set", "train.batch=16"]
    for more, said in (
        ("", "priced for 1 device at 100.0 EFLOP/s each"),
        ("--mesh 2 -1 2", "priced for 4 devices at"),
        ("--processes 4", "priced for 4 devices at"),
        ("--set trial_seconds=7200", "2.0 h to train."),
    ):
        assert main([*dry, *more.split()]) == 0
        printed = " ".join(capsys.readouterr().out.split())
        assert "1 trial of 3 steps" in printed and " to evaluate" not in printed and said in printed
        assert "'Control'" not in printed, "one model has no such trial"
    monkeypatch.setattr(local, "find_accelerators", lambda: Accelerators("gpu", tuple("01234567")))
    assert main([*dry, *"--coordinator host0:29400 --processes 2 --process 1".split()]) == 0
    assert "priced for 16 devices at" in " ".join(capsys.readouterr().out.split())
    assert main([*dry, "--trajectories", "0"]) == 2 and "--trajectories must be at least 1" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_settings_that_one_model_does_not_have_are_told(tmp_path, capsys):
    dry = ["train", "--preset", "smoke", "--dry-run", "--out", str(tmp_path), "--set", "train.steps=5"]
    assert main([*dry, "--set", "seeds=1"]) == 0 and "note: " not in capsys.readouterr().out
    assert main([*dry, *"--set seeds=1,2 --set widths=8 --set designs.judged=1 --set axes=width".split()]) == 0
    assert (
        "note: one model is trained, of seed 1; without effect: seeds beyond the first, widths, designs.judged, axes\n"
    ) in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "gpus"), [("train", ()), ("adapt", ()), ("sweep", ("0",)), ("sweep", ())], ids=lambda x: x or "cpu"
)
def test_a_mesh_that_does_not_fit_is_refused_before_anything_is_prepared(
    command, gpus, where, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("experiments.preparing.pipeline.prepare", lambda *_, **__: pytest.fail("it is prepared"))
    monkeypatch.setattr(local, "find_accelerators", lambda: Accelerators("gpu", gpus) if gpus else None)
    study = [
        *SMOKE,
        "--out",
        str(tmp_path / "out"),
        "--data",
        *where[where.index("--data") + 1 :],
        "--mesh",
        "3",
        "1",
        "1",
    ]
    more = {"train": [], "sweep": ["width"]}
    if command == "adapt":
        more[command] = [str(make_released(tmp_path / "a", as_registered(ARM)))]
        config = get_preset("smoke").tokenizer
        save_tokenizer(LfqTokenizer(config, declare_tokenizer(config).init(0)), tmp_path / "a" / "tokenizer")
    assert main([command, *more[command], *study]) == 2
    said = capsys.readouterr().err
    assert "a mesh of data=3, fsdp=1, tensor=1 does not fit 1 device(s); set one axis to -1" in said


@pytest.mark.parametrize(
    ("there", "replace", "said"),
    [
        (False, "tokens", "first run `hma tokenizer train --preset"),
        (True, "suite", "first run `hma tokenizer train --replace suite --preset"),
        (True, "tokens", "it is prepared"),
    ],
)
def test_several_processes_do_not_wait_for_one_that_trains_a_tokenizer(
    there, replace, said, where, tmp_path, monkeypatch, capsys
):
    def prepare(*_, **__):
        raise ConfigError("it is prepared")

    monkeypatch.setattr("experiments.preparing.pipeline.prepare", prepare)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    if there:
        (tmp_path / "tokenizer").mkdir()
    given = [*SMOKE, "--out", str(tmp_path), *where[where.index("--data") :], "--replace", replace]
    assert main(["train", *given]) == 2
    assert said in capsys.readouterr().err


def test_a_dry_run_counts_nothing_that_is_there(train):
    train()
    said, *_ = train("--set", "train.steps=6", "--dry-run")
    said = " ".join(said.split())
    assert "Already done, and not counted: the tokenizer, tokens, 3 steps of training. About" in said
    assert "to prepare" not in said


def test_fewer_trajectories_when_asked_for(train):
    said, trial, _ = train("--trajectories", "3")
    assert trial.max_trajectories == 3
    assert "3 of 13 trajectories (at most 3 of each robot), 9 windows" in said


@pytest.mark.parametrize(("asked", "every"), [(None, 2), ("3", 3), ("0", 0)])
def test_checkpoints_are_saved_as_often_as_asked_for(train, asked, every):
    _, _, options = train("--set", "train.steps=12", *(["--checkpoint-every", asked] if asked else []))
    assert options.steps_between(12)[0] == every


def test_a_run_of_few_steps_is_saved_at_its_end_alone():
    assert RunOptions().steps_between(4) == (0, 0) and RunOptions().steps_between(5)[0] == 1


def test_checkpoints_are_saved_by_the_minute_and_kept_as_asked_for(train, tmp_path):
    often = ("--checkpoint-every", "0", "--checkpoint-minutes", "1e-9", "--keep-checkpoints", "4")
    train("--set", "train.steps=5", *often)
    assert list_steps(tmp_path / "run" / "checkpoints") == [2, 3, 4, 5]


@pytest.mark.parametrize(
    ("asked", "steps"), [("", list(range(2, 41, 2))), pytest.param("30", [30, 40], marks=pytest.mark.slow), ("0", [])]
)
def test_held_out_windows_are_looked_at_as_often_as_asked_for_and_shown(asked, steps, train, tmp_path):
    said, _, _ = train("--set", "train.steps=40", *(["--validate-every", asked] if asked else []))
    file = tmp_path / "run" / "validation.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()] if steps else []
    assert [line["step"] for line in lines] == steps and file.exists() == bool(steps)
    assert all(0 < line["loss"] < 10 and 0 <= line["accuracy"] <= 1 for line in lines)
    if steps:
        losses = {line["step"]: line["loss"] for line in lines}
        best = min(losses, key=losses.get)
        assert f"held-out loss {losses[steps[-1]]:.4f}" in said
        assert (f"lowest {losses[best]:.4f} at step {best}" in said) == (best != steps[-1])
    else:
        assert "held-out" not in said
    assert train.phases[0] == "training"
    assert train.phases[-1] == (f"training, held-out loss {lines[0]['loss']:.4f}" if steps else "training")


def test_a_run_branches_at_a_step_that_was_kept_and_goes_on_at_another_rate(train, where, tmp_path, capsys):
    run, new = tmp_path / "run", tmp_path / "new"
    train("--set", "train.steps=5", "--keep-every", "2")
    assert list_steps(run / "checkpoints") == [2, 4, 5]
    assert main(["branch", str(run), str(new), "--step", "2"]) == 0
    assert f"has the checkpoint of step 2 of {run}" in capsys.readouterr().out.replace("\n", " ")
    slower = ("--set", "train.optimizer.learning_rate=1e-5", "--set", "seeds=7", "--set", "train.steps=4")
    assert main(["train", *where, "--run", str(run), *slower]) == 2, "the run itself goes on as it began"
    assert "`hma branch`" in capsys.readouterr().err
    assert main(["train", *where, "--run", str(new), *slower]) == 0
    first, second = (
        [json.loads(line)["loss"] for line in (place / "metrics.jsonl").read_text().splitlines()]
        for place in (run, new)
    )
    assert second[:2] == first[:2] and len(second) == 4
    assert main(["branch", str(run), str(new)]) == 2


def test_the_checkpoint_before_the_decay_stays(train, tmp_path):
    wsd = ("--set", "train.optimizer.schedule=wsd", "--set", "train.optimizer.warmup_steps=1")
    train(*wsd, "--set", "train.steps=10", "--set", "train.optimizer.decay_fraction=0.5", "--checkpoint-every", "0")
    assert list_steps(tmp_path / "run" / "checkpoints") == [5, 10]


def test_steps_are_profiled_as_asked_for_and_which_and_where_is_said(train, tmp_path):
    said, _, _ = train("--set", "train.steps=3", "--trace", "2")
    profile = tmp_path / "run" / "profile"
    assert f"note: steps 2 to 3 were profiled. To see that: pip install xprof, then xprof --logdir {profile}" in said
    assert f"wrote {profile}" in said and list(profile.glob("plugins/profile/*/*.xplane.pb"))
    said, _, _ = train("--set", "train.steps=3", "--trace", "2")
    assert "note: no step was profiled: the run had all of its steps" in said and f"wrote {profile}" not in said
    said, _, _ = train("--set", "train.steps=4", "--trace", "1000000")
    assert "train width 16 for 4 steps of 4 windows, of which it has 3 ..." in said, "that it is extended is said"
    assert "note: step 4 was profiled (1,000,000 were asked for)" in said and f"wrote {profile}" in said


def test_windows_are_read_by_as_many_threads_as_asked_for(train, monkeypatch):
    threads, real = [], loader.make_loader
    monkeypatch.setattr(loader, "make_loader", lambda *a, **how: threads.append(how["threads"]) or real(*a, **how))
    train("--set", "train.steps=1")
    train("--set", "train.steps=2", "--set", "execution.loader_threads=5")
    assert threads == [2, 5]


def test_a_run_that_another_process_trains_is_refused(where, tmp_path, capsys):
    with locked_run(tmp_path / "run"):
        assert main(["train", *where, "--run", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: {tmp_path / 'run'} is being trained in by process ") and "Traceback" not in said
    assert main(["train", *where, "--run", str(tmp_path / "run")]) == 0


def test_the_number_of_damaged_episodes_that_were_left_out_is_in_the_checkpoint(tmp_path):
    def spoil(episode, features):
        if episode in (3, 5):
            features["steps/action"][0] = np.nan

    data = write_rlds(tmp_path, ARM, [18] * 12, change=spoil)
    where = [*SMOKE, "--out", str(tmp_path / "out"), "--data", str(data), "--set", "store.corrupt=skip"]
    assert main(["train", *where]) == 0
    assert load_run(tmp_path / "out" / "model").provenance["lost"] == {ARM.name: 2}


@pytest.mark.slow
def test_the_average_of_the_weights_is_evaluated_unless_told_otherwise(train, where, tmp_path, capsys):
    train("--set", "train.ema_decay=0.5")

    def evaluate(run: Path, *arguments: str) -> str:
        code = main(["evaluate", str(run), *where, *arguments])
        said = capsys.readouterr()
        return " ".join((said.out if code == 0 else said.err).split())  # a long directory breaks the table's title

    assert "step 3, averaged weights" in evaluate(tmp_path / "run")
    last = evaluate(tmp_path / "run", "--weights", "last", "--replace")
    assert "step 3" in last and "averaged" not in last


@pytest.mark.parametrize(
    "setting",
    [
        ["--trajectories", "0"], ["--checkpoint-every", "-1"], ["--checkpoint-minutes", "-1"],
        ["--keep-checkpoints", "0"], ["--validate-every", "-1"], ["--trace", "0"],
    ],
)  # fmt: skip
def test_settings_of_its_own_are_checked_before_any_work(setting, where, capsys):
    assert main(["train", *where, *setting]) == 2
    assert f"{setting[0]} must " in capsys.readouterr().err


def test_a_width_that_no_sweep_has(train, where, tmp_path):
    _, trial, _ = train("--set", "model.width=24")
    assert trial.model.width == 24
    assert load_run(tmp_path / "run").model.width == 24


def test_a_run_begins_with_the_weights_of_another(train, tmp_path, capsys, where):
    train("--set", "train.steps=3")
    source = tmp_path / "run"
    begun = tmp_path / "begun"
    options = ("--set", "train.steps=1", "--set", "train.optimizer.learning_rate=1e-9", "--run", str(begun))
    options += ("--set", "train.optimizer.schedule=constant")
    train("--from", str(source), *options)  # the last --run counts
    before, after = load_run(source), load_run(begun)
    assert after.step == 1 and after.provenance["origin"]["step"] == 3
    for old, new in zip(jax.tree.leaves(before.params), jax.tree.leaves(after.params), strict=True):
        np.testing.assert_allclose(new, old, atol=1e-6)
    other = ["train", *where, "--run", str(tmp_path / "other"), "--from", str(source), "--set", "model.width=24"]
    assert main(other) != 0
    said = capsys.readouterr().err
    assert "is another model than --set asks for (there -> asked for): model.width: 16 -> 24. Leave out" in said

    shutil.rmtree(source)
    said, *_ = train("--from", str(source), *options, "--set", "train.steps=2")
    assert f"note: {source} is gone; {begun} goes on from its own checkpoint" in said
    again = load_run(begun)
    assert again.step == 2 and again.provenance == after.provenance
    new = ["train", *where, "--run", str(tmp_path / "new"), "--from", str(source)]
    assert main(new) != 0 and f"no checkpoints at {source}" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "adapt"])
def test_a_run_goes_on_though_the_one_that_it_began_with_has_trained_on(command, tmp_path, capsys):
    source, run = tmp_path / "a" / "model", tmp_path / "b" / "model"
    damaged = run / "checkpoints" / "3"
    known, new = write_rlds(tmp_path / "known", ARM, [18] * 12), write_rlds(tmp_path / "new", BASE, [40] * 12)
    trained = ["train", *SMOKE, "--out", str(tmp_path / "a"), "--data", str(known)]
    begun = [command, *(["--from"] if command == "train" else []), str(source), *SMOKE, "--out", str(tmp_path / "b")]
    begun += ["--data", str(known if command == "train" else new), "--skip-damaged", "--checkpoint-every", "1"]

    def said(arguments: list[str], steps: int, code: int = 0) -> str:
        assert main([*arguments, "--set", f"train.steps={steps}", "--set", "train.optimizer.schedule=constant"]) == code
        return " ".join("".join(capsys.readouterr()).split())

    said(trained, 2)
    said(begun, 3)
    said(trained, 4)
    next(damaged.rglob("_CHECKPOINT_METADATA")).write_bytes(b"")  # what is left to say what it began with is earlier
    note = f"note: {run} began with step 2 of a model that has 4 by now, and goes on from its own checkpoint"
    assert note in said(begun, 4)
    assert load_run(run).step == 4 and load_run(run).provenance["origin"]["step"] == 2
    shutil.rmtree(source / "checkpoints" / "4")
    shutil.rmtree(source / "checkpoints" / "2")
    said(trained, 1)
    assert "than the one that is asked for (there -> asked for): step: 2 -> 1; name" in said(begun, 5, code=2)
    assert f"{run} began with the weights of another model: name that model again" in said(
        ["train", *SMOKE, "--out", str(tmp_path / "b"), "--data", str(known)], 5, code=2
    )
    if command == "train":
        begun[begun.index("--out") :] = ["--out", str(tmp_path / "b"), "--data", str(known), "--run", str(source)]
        begun[2] = str(run)
        assert f"{source} began by itself, not with the weights of another model: leave out --from" in said(begun, 5, 2)


def test_robots_are_added_to_the_averaged_weights_of_a_run_that_keeps_them(tmp_path):
    """They are what is evaluated, and what was said of the known robots is to stay."""

    def step(state, batch):
        moved = jax.tree.map(lambda x: x + 1, state.params)
        return state._replace(step=state.step + 1, params=moved), {"loss": jnp.float32(5)}

    known, new = write_rlds(tmp_path / "known", ARM, [18] * 12), write_rlds(tmp_path / "new", BASE, [40] * 12)
    source, adapted = tmp_path / "a" / "model", tmp_path / "b" / "model"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_training, "make_train_step", lambda *_: step)
        averaged = ("--set", "train.ema_decay=0.5")
        assert main(["train", *SMOKE, "--out", str(tmp_path / "a"), "--data", str(known), *averaged]) == 0
    adapt = ["adapt", str(source), *SMOKE, "--out", str(tmp_path / "b"), "--data", str(new)]
    adapt += ["--set", "train.optimizer.schedule=constant", "--set"]
    assert main([*adapt, "train.steps=1"]) == 0
    assert load_run(adapted).table.names == (ARM.name, BASE.name)
    tables = [load_run(*which).params["embed"]["tables"] for which in ((adapted,), (source, "ema"), (source, "last"))]
    np.testing.assert_array_equal(tables[0], tables[1])
    assert not np.array_equal(tables[1], tables[2])

    shutil.rmtree(tmp_path / "a")
    before = load_run(adapted)
    assert main([*adapt, "train.steps=2", "--everything"]) == 2  # not as it began
    assert main([*adapt, "train.steps=2"]) == 0
    after = load_run(adapted)
    assert (after.step, after.provenance, after.train.only) == (2, before.provenance, (BASE.name,))
    assert after.table == before.table


def test_a_known_robot_is_trained_at_its_native_rate_as_the_page_says(tmp_path, monkeypatch, capsys):
    """As in the paper's post-training, after pre-training at 2 Hz. Actions between frames are fewer then."""
    monkeypatch.setattr(registry_table, "_registered", {})
    data, source, native = write_rlds(tmp_path, ARM, [18] * 12), tmp_path / "a" / "model", tmp_path / "b" / "model"
    assert main(["train", *SMOKE, "--out", str(tmp_path / "a"), "--data", str(data)]) == 0
    given = ["--out", str(tmp_path / "b"), "--data", str(data), "--tokenizer", str(tmp_path / "a" / "tokenizer")]
    capsys.readouterr()
    assert main(["train", "--from", str(source), *SMOKE, *given, "--set", "rate=null"]) == 2
    assert "add it as a new robot with `hma adapt --everything`" in " ".join(capsys.readouterr().err.split())

    (entry,) = re.findall(r"```toml\n(\[cory_hall_native\]\n.*?)```", PAGE.read_text(), re.DOTALL)
    (tmp_path / "native.toml").write_text(entry)
    given += ["--registry", str(tmp_path / "native.toml")]
    assert main(["adapt", str(source), *SMOKE, *given, "--everything"]) == 0
    assert "new: cory_hall_native; training everything" in capsys.readouterr().out
    known, new = load_run(native).table.entries
    assert (known, (new.name, new.stride)) == (load_run(source).table.entries[0], ("cory_hall_native", 1))
    held_out = [
        TokenStore(tmp_path / at / "tokens").manifest(name).val for at, name in (("a", ARM.name), ("b", new.name))
    ]
    assert held_out[0].episodes == held_out[1].episodes


def make_released(root: Path, *robots: tuple[str, int, int]) -> Path:
    """A run that was converted, of another model than the smoke study's, which takes its tokens."""
    changes = {"d_model": 8, "T": 4, "S": 16, "image_vocab_size": 256}
    write_run(read_official(make_checkpoint(root / "checkpoint", DISCRETE | changes, robots)), root / "model")
    return root / "model"


def as_registered(spec: DatasetSpec) -> tuple[str, int, int]:
    return spec.name, spec.action_dim, spec.stride


@pytest.fixture(scope="module")
def released(tmp_path_factory) -> Path:
    return make_released(tmp_path_factory.mktemp("a"), as_registered(BASE), as_registered(ARM), ("push2", 2, 1))


def test_a_converted_run_is_fine_tuned_as_the_model_that_it_is(released, train, tmp_path, capsys):
    train()  # there is a tokenizer
    said, trial, _ = train("--from", str(released), "--run", str(tmp_path / "tuned"))
    assert "note: unchanged, because the study has no data of them: push2" in said
    before, after = load_run(released), load_run(tmp_path / "tuned")
    assert trial.model == after.model == before.model and before.model.width == 8
    assert after.table == before.table and set(trial.datasets) == {ARM.name, BASE.name}
    for old, new in zip(jax.tree.leaves(before.params), jax.tree.leaves(after.params), strict=True):
        np.testing.assert_array_equal(old, new)  # no step here learns anything


def test_a_converted_run_is_not_resumed(released, where, tmp_path, monkeypatch, capsys):
    """Nor is one of ours that was read back from safetensors: it would be trained anew, as if from fresh weights."""
    monkeypatch.setattr("experiments.preparing.pipeline.prepare", lambda *_, **__: pytest.fail("it is prepared"))
    ours = replace(load_run(released), provenance={"loader": {}, "tokenizer": "its own"})
    write_run(ours, tmp_path / "read back")
    for run, quoted in ((released, released), (tmp_path / "read back", f"'{tmp_path / 'read back'}'")):
        assert main(["train", *where, "--run", str(run)]) == 2
        said = capsys.readouterr().err
        assert f"{run} was converted, not trained here, so it cannot be resumed; fine-tune it with: " in said
        assert f"hma train --from {quoted} --preset smoke " in said and said.endswith(" --run NEW\n")


@pytest.mark.parametrize("command", ["train", "evaluate"])
def test_what_a_trial_keeps_is_not_written_over(command, train, where, tmp_path, capsys):
    """Its study would refuse it, and with it every report."""
    train()
    trial = tmp_path / "trials" / "1d"
    shutil.copytree(tmp_path / "run", trial / "run")
    (trial / "job.json").write_text("{}")
    there = sorted(trial.rglob("*"))
    asked = ["--run", str(trial / "run"), "--set", "train.steps=5"] if command == "train" else ["--to", str(trial)]
    asked = [*([str(tmp_path / "run")] if command == "evaluate" else []), *asked]
    assert main([command, *asked, *where]) == 2
    said = (
        f"train --from {trial / 'run'}"
        if command == "train"
        else "is the directory of a trial, whose results must not be changed"
    )
    assert said in capsys.readouterr().err
    assert sorted(trial.rglob("*")) == there


def test_a_new_run_does_not_lie_where_the_model_lies_that_it_begins_with(tmp_path, where, monkeypatch, capsys):
    """By default both would be OUT/model."""
    monkeypatch.setattr("experiments.preparing.pipeline.prepare", lambda *_, **__: pytest.fail("it is prepared"))
    config, source = get_preset("smoke").tokenizer, make_released(tmp_path, *map(as_registered, (ARM, BASE)))
    save_tokenizer(LfqTokenizer(config, declare_tokenizer(config).init(0)), tmp_path / "tokenizer")
    given = [*SMOKE, *where[where.index("--data") :], "--out", str(tmp_path)]
    for more in ((), ("--dry-run",)):
        assert main(["train", "--from", str(source), *given, *more]) == 2
        assert "give the new run a directory of its own with --run NEW" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["train", "adapt"])
def test_a_new_run_does_not_lie_among_what_a_study_made(command, where, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("experiments.preparing.pipeline.prepare", lambda *_, **__: pytest.fail("it is prepared"))
    tokenizer, out, other = tmp_path / "lfq", tmp_path / "out", tmp_path / "other"
    config = get_preset("smoke").tokenizer
    save_tokenizer(LfqTokenizer(config, declare_tokenizer(config).init(0)), tokenizer)
    source = make_released(tmp_path, as_registered(ARM)) if command == "adapt" else None
    words = [command, *[str(source)] * (source is not None), *SMOKE, "--out", str(out), "--tokenizer", str(tokenizer)]
    words += where[where.index("--data") :]
    other.mkdir()
    (other / "eval_manifest.json").write_text("{}")
    for run, its_own in ((out, out / "model"), (out / "tokenizer", out / "model"), (other, other / "model")):
        assert main([*words, "--run", str(run)]) == 2
        said = capsys.readouterr().err
        assert f"--run {run} is " in said and f"directory of its own, such as {its_own}" in said
    assert not out.exists() and [path.name for path in other.iterdir()] == ["eval_manifest.json"]


def test_a_model_goes_on_with_its_own_tokenizer_robots_and_rates(released, where, tmp_path, monkeypatch, capsys):
    """What does not fit is said before a tokenizer is trained on the data."""
    monkeypatch.setattr("experiments.preparing.pipeline.prepare", lambda *_, **__: pytest.fail("it is prepared"))
    out, data = tmp_path / "out", where[where.index("--data") + 1 :]

    def refused(*arguments: str) -> str:
        assert main([*arguments, *SMOKE, "--out", str(out)]) == 2 and not out.exists()
        return capsys.readouterr().err

    adapt, goes_on = ("adapt", str(released)), ("train", "--from", str(released))
    for command in (adapt, goes_on):
        said = refused(*command, "--data", *data)
        assert f"its tokenizer is neither beside it nor in {out}; add --tokenizer" in said
    tokenizer = tmp_path / "study" / "tokenizer"
    config = get_preset("smoke").tokenizer
    save_tokenizer(LfqTokenizer(config, declare_tokenizer(config).init(0)), tokenizer)
    given = ("--tokenizer", str(tokenizer), "--data", *data)
    assert "there is nothing to add. To train it on: hma train --from " in refused(*adapt, *given)
    assert "trained with frames at stride 3, but here the stride is 13" in refused(
        *goes_on, *given, "--set", "rate=0.4"
    )
    beside = make_released(tmp_path / "study", as_registered(ARM))
    assert f"knows {ARM.name}, not {BASE.name}. To add them: hma adapt " in refused(
        "train", "--from", str(beside), "--data", *data
    )
    only = ("--set", f"train.only={BASE.name}")
    said = refused("adapt", str(beside), "--data", *data, *only)
    assert "leave out train.only: `hma adapt` trains only the new robots' parameters" in said
    said = refused("adapt", str(beside), "--data", *data, "--set", "train.masking.setting=passive")
    assert f"train.only: {BASE.name} would have no parameters to train" in said
    arguments, trained = StudyArguments("smoke", out, tuple(data)), load_run(beside)
    setup = setup_of(beside, trained, arguments)
    assert setup.tokenizer == tokenizer and new_datasets(trained, setup) == [BASE.name]
    other = replace(trained, provenance={"tokenizer": "another"})
    with pytest.raises(ConfigError, match="trained on tokens of tokenizer another, .*; add --tokenizer"):
        setup_of(beside, other, arguments)


def test_held_out_loss_is_of_as_many_episodes_as_a_batch_takes(tmp_path):
    """Of the first windows it would be that of one long episode and its neighbours."""
    store = small_store(tmp_path, lengths=(40,) * 16, min_val=4)
    manifest, table = freeze_manifest(store, ("toy",), 4, 64, 0, rate=2.0), store.embodiment_table(["toy"], rate=2.0)
    prepared = SimpleNamespace(store=store, manifest=manifest)
    trial = SimpleNamespace(train=SimpleNamespace(batch=4), evaluated=("toy",))
    (batch,) = trials.validation_batches(trial, prepared, table)
    assert batch["valid"].all()
    assert len(set((batch["tokens"][:, 0, 0] // 256).tolist())) == 4  # ids say which episode a frame is of
