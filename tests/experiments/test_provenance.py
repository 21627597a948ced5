"""What names a trial, and what is recorded and checked of the sources that it ran."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import experiments
from experiments import run_study as study_runs
from experiments.analysis.rows import Row, read_csv, write_csv
from experiments.report.draw import draw_again
from experiments.report.page import _origin
from experiments.running import provenance
from experiments.running.attempts import read_states
from experiments.running.closure import ROOT, closure_hash, trace
from experiments.running.launchers.local import LocalLauncher
from experiments.running.launchers.registry import LauncherOptions
from experiments.running.ledger import REFUSED, Ledger
from experiments.running.machine import commit_of
from experiments.running.provenance import ROOTS, CodeChanged, load_sources, record_end, record_start
from experiments.running.result_file import read_result, write_result
from experiments.running.runner import Job, run_missing
from experiments.running.trial import trial_id
from experiments.running.trial_checks import check_finished, group_by_sources, require_one_closure
from experiments.running.workspace import Workspace, find_record, save_record
from experiments.study import SCALING
from experiments.study_setup import StudyArguments, make_setup
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import unique_trials
from experiments.terminal.exit_code import TrialsFailed
from hma_jax.config import ConfigError
from hma_jax.runtime.exits import Exit
from tests.experiments import fake_trial
from tests.experiments.fakes import PROVENANCE, STUDY, finished_study, record_of, rows_of

PLAIN = '''
"""What it is."""
import math

RATE = 0.5
"""Of what."""

@cache
def area(r: float, *, n=2) -> float:
    """Of a circle."""
    return math.pi * r**n if r > 0 else 0
'''

# --- Sources --------------------------------------------------------------------------------------


def write_modules(root: Path, **files: str) -> None:
    for name, text in files.items():
        path = root.joinpath(*name.split("__")).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        (path.parent / "__init__.py").touch()
        path.write_text(text)


def hash_of(text: str, root: Path) -> str:
    write_modules(root, experiments__plain=text)
    return trace(["experiments.plain"], root)["experiments.plain"]


@pytest.mark.parametrize(
    ("old", "new"),
    [("# nothing", "# something else"), ("What it is.", "What it was."), ("Of what.", "Of that."), ("Of a circle.", "!"),
     ("    return math.pi * r**n if r > 0 else 0", "    return (\n        math.pi * r ** n  # why\n        if r > 0 else 0\n    )"),
     ('"""What it is."""\n', ""), ("import math\n", "import math\n\n\n\n")],
)  # fmt: skip
def test_comments_docstrings_and_layout_are_no_change(old, new, tmp_path):
    text = "# nothing\n" + PLAIN
    assert old in text and hash_of(text.replace(old, new), tmp_path) == hash_of(PLAIN, tmp_path)


@pytest.mark.parametrize(
    ("old", "new"),
    [("0.5", "0.25"), ("r > 0", "r >= 0"), ("n=2", "n=3"), ("else 0", "else 0.0"), ("math.pi", "math.tau"),
     ("@cache\n", ""), ("*, n", "n"), ("if r > 0 else 0", ""), ("RATE", "RATES"), ("r**n", "n**r")],
)  # fmt: skip
def test_whatever_is_computed_is_a_change(old, new, tmp_path):
    assert old in PLAIN and hash_of(PLAIN.replace(old, new), tmp_path) != hash_of(PLAIN, tmp_path)


def test_the_closure_is_what_is_imported(tmp_path):
    write_modules(
        tmp_path,
        experiments__main="import json\nfrom hma_jax.a import f\ndef run():\n    from data_pipelines import late\n",
        hma_jax__a="import hma_jax.deep.b\nif TYPE_CHECKING:\n    import hma_jax.types\n"
        "def rare():\n    import hma_jax.seldom\ntry:\n    import hma_jax.c\nexcept ImportError:\n    pass\n",
        hma_jax__deep__b="", hma_jax__c="", hma_jax__types="", hma_jax__seldom="", data_pipelines__late="",
        experiments__other="",
    )  # fmt: skip
    assert list(trace(["experiments.main"], tmp_path)) == [
        "data_pipelines", "data_pipelines.late", "experiments", "experiments.main",
        "hma_jax", "hma_jax.a", "hma_jax.c", "hma_jax.deep", "hma_jax.deep.b",
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"no module experiments\.none"):
        trace(["experiments.none"], tmp_path)


def test_a_trial_runs_neither_simulators_nor_plots():
    names = trace(ROOTS)
    assert {"experiments.running.trial", "hma_jax.training.step", "data_pipelines.loading.loader"} <= names.keys()
    strangers = ("data_pipelines.simulators", "data_pipelines.suite", "experiments.report", "experiments.cli")
    assert not [name for name in names if name.startswith(strangers)]


# --- A change in the middle of a sweep ------------------------------------------------------------


@pytest.fixture
def checkout(tmp_path) -> Path:
    """The sources, for editing."""
    for package in ("hma_jax", "data_pipelines", "experiments"):
        shutil.copytree(ROOT / package, tmp_path / "src" / package, ignore=shutil.ignore_patterns("results", "*.pyc"))
    return tmp_path / "src"


def test_a_change_to_the_code_in_mid_sweep_is_refused_by_the_next_trial(checkout, tmp_path):
    given = trace(ROOTS, checkout)
    with open(checkout / "hma_jax" / "objective" / "losses.py", "a") as file:
        file.write("\nSMOOTHING = 1\n")
    jobs = [Job(f"t{i}", f"trial {i}", {"trial": {}, "provenance": {}, "code": given}) for i in range(3)]
    ledger = Ledger(tmp_path / "ledger.jsonl")

    def command(directory: Path) -> list[str]:
        trial = [sys.executable, "-m", "experiments.running.trial_main", str(directory)]
        return ["sh", "-c", 'cd "$0" && PYTHONPATH="$0" exec "$@"', str(checkout), *trial]

    states = run_missing(jobs, tmp_path / "trials", ledger, LocalLauncher(tmp_path, 1, command=command))
    assert [states[f"t{i}"].event for i in range(3)] == ["refused", "missing", "missing"]
    assert "sources changed since this sweep was started: hma_jax.objective.losses." in states["t0"].message
    assert "If the change alters no result, run the command again with --accept-code" in states["t0"].message
    for accepted, last in ((True, "again: hma study"), (False, "again, .* no result: hma study --accept-code")):
        with pytest.raises(TrialsFailed, match=f"To try them {last}$") as failed:
            study_runs.require_results(jobs, states, "hma study", accepted)
    for line in ("missing: trial 1", "missing: trial 2"):
        assert f"  {line}: not started, because another trial was refused\n" in str(failed.value)
    assert not (tmp_path / "trials" / "t0" / "run").exists()
    (tmp_path / "trials" / "t0" / "failure.json").unlink()
    assert subprocess.run(command(tmp_path / "trials" / "t0")).returncode == Exit.REFUSED


def test_a_refused_trial_is_tried_again_without_being_asked_for(tmp_path):
    ledger, jobs = Ledger(tmp_path / "ledger.jsonl"), [Job("t0", "trial", {"end": "result", "steps": 1, "seconds": 0})]
    ledger.append("t0", REFUSED)
    states = run_missing(jobs, tmp_path / "trials", ledger, fake_trial.launcher(tmp_path))
    assert states["t0"].event == "finished"


def test_a_comment_in_mid_sweep_is_no_change(checkout):
    given = trace(ROOTS, checkout)
    for path in (checkout / "hma_jax").rglob("*.py"):
        path.write_text("# A comment.\n" + path.read_text() + "\n\n'''And a docstring.'''\n")
    assert trace(ROOTS, checkout) == given


def test_all_that_a_trial_runs_is_imported_before_it_works(monkeypatch):
    before = {"experiments.running.trial": "1", "experiments.terminal.words": "2"}
    found = iter([before, before | {"experiments.terminal.words": "3"}])
    monkeypatch.setattr(provenance, "trial_closure", lambda: next(found))
    with pytest.raises(CodeChanged, match=r"experiments\.terminal\.words"):  # changed while it was imported
        load_sources(before)
    monkeypatch.setattr(provenance, "trial_closure", lambda: before)
    assert load_sources(before) == load_sources(None) == before
    with pytest.raises(CodeChanged, match=r"experiments\.new"):
        load_sources(before | {"experiments.new": "1"})


def test_a_start_is_recorded_once(tmp_path):
    for _ in range(2):
        record_start(tmp_path, PROVENANCE, {"experiments.running.trial": "1"})
    record_start(tmp_path, PROVENANCE, {"experiments.running.trial": "2"})
    record_end(tmp_path)
    record = provenance.read_record(tmp_path)
    assert [start.code for start in record.starts] == [
        closure_hash({"experiments.running.trial": str(i)}) for i in (1, 2)
    ]
    assert record.code == record.starts[-1].code and len(record.closures) == 2
    assert (
        record.besides["experiments.terminal.words"]
        == trace(["experiments.terminal.words"])["experiments.terminal.words"]
    )
    machine = record.starts[0].machine
    assert {"jax", "jaxlib", "numpy"} <= machine["packages"].keys() and {
        "processor",
        "system",
        "commit",
    } <= machine.keys()


# --- Finished trials ------------------------------------------------------------------------------


def ids_of(study=STUDY) -> list[str]:
    return list(unique_trials(plan_sweeps(study, SCALING), PROVENANCE))


def test_the_commit_is_that_of_the_sources_not_of_a_repository_around_them(tmp_path):
    """A package may be installed into an environment that lies in the directory of a user's own project."""

    def git(*arguments):
        who = ("-c", "user.name=a", "-c", "user.email=a@b")
        done = subprocess.run(["git", "-C", tmp_path, *who, *arguments], check=True, capture_output=True, text=True)
        return done.stdout.strip()

    own, installed = tmp_path / "own.py", tmp_path / "installed.py"
    own.touch()
    installed.touch()
    for command in (("init",), ("add", "own.py"), ("commit", "-m", "a project")):
        git(*command)
    assert commit_of(own) == git("rev-parse", "--short=12", "HEAD")
    own.write_text("changed")
    assert commit_of(own).endswith(" + uncommitted changes")
    assert commit_of(installed) == ""


def test_finished_trials_copied_from_another_machine_count_as_done(tmp_path):
    there, here = finished_study(tmp_path / "there"), Workspace(tmp_path / "here")
    shutil.copytree(there.trials, here.trials)
    ids, ledger = ids_of(), Ledger(here.ledger)
    for samples in here.trials.glob("*/samples.npz"):  # may be left out
        samples.unlink()
    check_finished(here.trials, ids)
    require_one_closure(here.trials, ids, None, accept=False)
    assert {s.event for s in read_states(ids, here.trials, ledger).values()} == {"finished"}
    again = LocalLauncher(tmp_path, 1, command=lambda _: pytest.fail("it ran again"))
    run_missing([Job(id, id, {}) for id in ids], here.trials, ledger, again)
    sweeps = plan_sweeps(STUDY, SCALING)
    for workspace in (there, here):
        write_csv(workspace.results, Row, rows_of(workspace, sweeps))
    assert here.results.read_bytes() == there.results.read_bytes()


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


TAMPERING = {
    "a better number": (lambda d: edit(d / "result.json", '"mean": 20.0', '"mean": 21.0'), "result.json was changed"),
    "frames of another": (lambda d: (d / "samples.npz").write_bytes(b"PK"), "samples.npz was changed, or cut off"),
    "no sources": (lambda d: (d / "provenance.json").unlink(), "provenance.json is missing"),
    "other sources": (lambda d: edit(d / "provenance.json", "c0de", "c0da"), "provenance.json was changed"),
    "another seed": (lambda d: edit(d / "job.json", '"seed": 0', '"seed": 5'), "job.json describes trial"),
    "other tokens": (lambda d: edit(d / "job.json", "5708e", "5708f"), "job.json describes trial"),
    "no job": (lambda d: (d / "job.json").unlink(), "the description of the finished trial cannot be read"),
    "a job of nothing": (
        lambda d: edit(d / "job.json", '"provenance": {', '"provenance": 3, "p": {'),
        "cannot be read",
    ),
    "cut off": (lambda d: (d / "result.json").write_text((d / "result.json").read_text()[:300]), "is damaged"),
    "without a hash": (lambda d: edit(d / "result.json", '"hash"', '"hush"'), "no 'hash' in result.json"),
}


@pytest.mark.parametrize("name", TAMPERING)
def test_a_finished_trial_that_was_changed_is_refused(name, tmp_path):
    workspace = finished_study(tmp_path)
    id = trial_id(next(iter(unique_trials(plan_sweeps(STUDY, ["width"]), PROVENANCE).values())), PROVENANCE)
    change, words = TAMPERING[name]
    change(workspace.trials / id)
    with pytest.raises(ConfigError, match=words) as raised:
        check_finished(workspace.trials, ids_of())
    assert str(workspace.trials / id) in str(raised.value) and "emove" in str(raised.value)


def test_a_finished_trial_under_the_name_of_another_is_refused(tmp_path):
    workspace = finished_study(tmp_path)
    first, second = ids_of()[:2]
    shutil.rmtree(workspace.trials / first)
    shutil.copytree(workspace.trials / second, workspace.trials / first)
    with pytest.raises(ConfigError, match=f"result.json is of trial {second}"):
        check_finished(workspace.trials, ids_of())


# --- Sweeps of several sources --------------------------------------------------------------------


def run_by(directory: Path, *closures: dict[str, str]) -> None:
    """As if the trial had run these sources one after the other."""
    (directory / "provenance.json").unlink(missing_ok=True)
    for closure in closures:
        record_start(directory, PROVENANCE, closure)
    values = json.loads((directory / "result.json").read_text())
    write_result(directory, {name: value for name, value in values.items() if name != "hash"})


OLD, NEW = {"experiments.running.trial": "1", "hma_jax.a": "1"}, {"experiments.running.trial": "1", "hma_jax.a": "2"}


def test_trials_are_counted_by_the_sources_they_ran(tmp_path):
    workspace, ids = finished_study(tmp_path), ids_of()
    for i, id in enumerate(ids):
        run_by(workspace.trials / id, *([OLD] if i else [NEW, OLD]))
    require_one_closure(workspace.trials, ids[1:], OLD, accept=False)
    require_one_closure(workspace.trials, ids[1:], OLD | {"hma_jax.b": "1"}, accept=False)  # it has one more, no other
    groups = group_by_sources(workspace.trials, ids)
    assert [len(group.trials) for group in groups] == [1, len(ids)]  # the first ran both
    with pytest.raises(
        CodeChanged, match=r"(?s)differs in hma_jax\.a.*Nothing was run.*--accept-code.*RESULTS_VERSION"
    ):
        require_one_closure(workspace.trials, ids, None, accept=False)
    with pytest.raises(CodeChanged, match="to be run; differs in hma_jax.a"):
        require_one_closure(workspace.trials, ids[1:], NEW, accept=False)
    require_one_closure(workspace.trials, ids, NEW, accept=True)
    result = json.loads((workspace.trials / ids[0] / "result.json").read_text())
    del result["hash"], result["files"]
    result["run"]["machine"] |= {"processor": "another", "cores": 1}
    write_result(workspace.trials / ids[0], result)
    page = _origin(workspace, record_of(), ids, {id: read_result(workspace.trials / id) for id in ids})
    assert f"{len(ids) - 1} trials: abacus, 2 cores per trial; 1 trial: another, 1 core per trial" in page
    assert "2 different ones, by hash: " in page and closure_hash(NEW) in page and closure_hash(OLD) in page


@pytest.mark.parametrize("accept", [False, True])
def test_a_study_goes_on_under_changed_sources_only_if_that_is_accepted(accept, tmp_path, monkeypatch):
    workspace = finished_study(tmp_path)  # by sources that are not these
    monkeypatch.setattr("experiments.preparing.pipeline.prepare", lambda *_, **__: PROVENANCE)
    monkeypatch.setattr("experiments.preparing.windows.require_judged", lambda *_: None)
    monkeypatch.setattr("experiments.preparing.suite.require_simulated", lambda *_: None)
    ran = []
    monkeypatch.setattr(study_runs, "run_jobs", lambda jobs, *_, **__: ran.extend(jobs) or {})
    monkeypatch.setattr(study_runs, "draw", lambda *_: None)
    monkeypatch.setattr(study_runs, "require_results", lambda *_: None)
    save_record(workspace, record_of())
    shutil.rmtree(workspace.trials / ids_of()[-1])
    setup = replace(make_setup(StudyArguments("smoke", tmp_path)), study=STUDY)

    def run():
        study_runs.run_study(setup, SCALING, again="", launcher_options=LauncherOptions(), retry_failed=False,
                           accept_code=accept, replace=None)  # fmt: skip

    if accept:
        run()
        assert len(ran) == len(ids_of()) and ran[0].record["code"] == trace(ROOTS)
    else:
        with pytest.raises(CodeChanged, match=r"differs in experiments\.running\.trial"):
            run()
        assert not ran and "hma study" in find_record(workspace).command


# --- Results that are kept -------------------------------------------------------------------------

KEPT = Path(experiments.__file__).parent / "results"


@pytest.mark.parametrize("name", ["cpu", "ablations"])
def test_results_that_are_kept_are_read(name):
    record, rows = find_record(Workspace(KEPT / name)), read_csv(KEPT / name / "results.csv")
    assert record.provenance.results == {"cpu": 2, "ablations": 0}[name]
    assert record.study.name == "cpu" and record.study.eval.decode.unmask_steps == 2
    assert {(r.store, r.manifest, r.tokenizer, r.results) for r in rows} == {tuple(vars(record.provenance).values())}
    assert {r.sweep for r in rows} == set(record.axes) and all(r.code for r in rows)


def test_results_that_are_kept_are_drawn_again_from_their_table(unrendered, tmp_path):
    for file in ("study.json", "results.csv"):
        shutil.copy(KEPT / "ablations" / file, tmp_path)
    draw_again(tmp_path)
    assert (tmp_path / "results.csv").read_bytes() == (KEPT / "ablations" / "results.csv").read_bytes()
    assert {p.name for p in (tmp_path / "figures").iterdir()} >= {"settings.png", "conditioning.png"}
    assert not (tmp_path / "report.html").exists()
