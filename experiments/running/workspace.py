"""The output directory of a study: where everything is, and which study it holds."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from data_pipelines.registry import register
from experiments.data_size import sizes_by_tokens, use_sizes
from experiments.running.provenance import Provenance
from experiments.study import Study
from experiments.terminal.program import PROGRAM
from experiments.terminal.words import few
from hma_jax.config import ConfigError, require
from hma_jax.config.json import from_dict, to_dict
from hma_jax.runtime.files import write_file
from hma_jax.runtime.locks import EXPIRES, Held, Holder, Lock, exclusive, machine, read_holder
from hma_jax.runtime.outputs import writing_to
from hma_jax.training.run_lock import CHECKPOINTS

LOCK = ".lock"


class Busy(Held):
    """Another command is at work in the directory."""


class _Under:
    """An attribute of a workspace: a path under its root."""

    def __init__(self, name: str):
        self.name = name

    def __get__(self, workspace: Workspace, owner: type) -> Path:
        return workspace.root / self.name


@dataclass(frozen=True)
class Workspace:
    """Paths under `root`. Deleting any of them except predictions and findings is safe: the next run makes it again."""

    root: Path

    suite = _Under("suite")
    """Simulated RLDS datasets."""
    tokenizer = _Under("tokenizer")
    store = _Under("tokens")
    """Token store."""
    manifest = _Under("eval_manifest.json")
    """Frozen evaluation windows."""
    counterfactual = _Under("counterfactual.npz")
    """True frames of the windows under other actions, for robots of the suite."""
    data_summary = _Under("data.json")
    """Episodes and windows per dataset, as JSON."""
    trials = _Under("trials")
    ledger = _Under("ledger.jsonl")
    results = _Under("results.csv")
    """Means over robots, a line for each point, seed and metric."""
    robots = _Under("robots.parquet")
    """The same of every robot."""
    trial_table = _Under("trials.parquet")
    """A row per trial, its configuration and results flat."""
    controllability = _Under("controllability.csv")
    """Per robot, whether the reference model follows actions."""
    optima = _Under("optima.csv")
    """Best learning rates per width, where they were swept."""
    changes = _Under("changes.csv")
    """Differences between the two ends of each axis."""
    best_steps = _Under("best_steps.csv")
    """Points of an axis at the number of steps that suits them."""
    growth = _Under("growth.csv")
    """The effect of more trajectories on robots that have more, and on those that have not."""
    fits = _Under("fits.csv")
    """Coefficients of scaling fits."""
    registry = _Under("registry.toml")
    """The user's own registry entries with which the axes were planned; no file if there are none."""
    predictions = _Under("predictions")
    """Predictions of trials, made before they ran."""
    findings = _Under("findings.md")
    """The author's findings by axis, shown on the page."""
    figures = _Under("figures")
    report = _Under("report.html")
    record = _Under("study.json")
    """Which study lives here."""

    @classmethod
    def of_run(cls, run: Path) -> Workspace:
        """The study to which a run belongs: STUDY/RUN, or the trial STUDY/trials/ID/run. A link to a run belongs to the
        study in which the run lies, or else, as for runs on another disk, to that in which the link lies."""
        if run.is_symlink() and (study := cls._around(run.resolve())).tokenizer.is_dir():
            return study
        return cls._around(run.absolute())

    @classmethod
    def _around(cls, run: Path) -> Workspace:
        study = run.parent.parent.parent
        return cls(study if cls(study).trials == run.parent.parent else run.parent)

    @property
    def holder(self) -> Holder | None:
        """The process that holds the right to write in it; None if there is none."""
        return read_holder(self.root / LOCK)

    @contextmanager
    def locked(self, lock: str = LOCK) -> Iterator[Lock]:
        """Makes the directory and holds the right to write in it, or the right that another `lock` stands for. The lock
        ends with its process, and has a lease for machines that do not see each other's locks.

        Raises ConfigError if the directory cannot be written, Busy if another process holds it.
        """
        with ExitStack() as stack:
            try:
                with writing_to(self.root):
                    self.root.mkdir(parents=True, exist_ok=True)
                    held_lock = stack.enter_context(exclusive(self.root / lock, lease=True))
            except Held as held:
                elsewhere = held.holder is not None and held.holder.machine != machine()
                dead = f" (if its machine died or started anew: {EXPIRES / 60:.0f} minutes)" if elsewhere else ""
                raise Busy(
                    f"another command is using {self.root} ({held.who}); wait until it has finished{dead}, or choose "
                    "another --out",
                    held.holder,
                ) from None
            yield held_lock


@dataclass(frozen=True)
class Record:
    """The content of study.json, so that `hma report` and `hma sweep` need only the study's directory."""

    study: Study
    data: tuple[str, ...] = ()  # RLDS directories of the user; () for the suite
    axes: tuple[str, ...] = ()  # sweeps run so far
    command: str = ""
    provenance: Provenance = field(kw_only=True)  # provenance of the trials that the report shows


def save_record(workspace: Workspace, record: Record) -> None:
    write_file(workspace.record, json.dumps(to_dict(record), indent=1))


def command_at(root: Path, record: Record) -> str:
    """The study's command for its directory `root`, as the user wrote it. The recorded command names the former path,
    and would begin a new study there if the directory has been moved or copied since."""
    words = shlex.split(record.command)
    at = words.index("--out") + 1 if "--out" in words else None
    recorded = words[at] if at else str(Path("runs") / record.study.name)
    if Path(recorded).resolve() == root.resolve():
        return record.command
    words = [word.replace(f"{recorded}/axes/", f"{root}/axes/") for word in words]
    if at:
        words[at] = str(root)
    return shlex.join(words if at else [*words, "--out", str(root)])


def find_record(workspace: Workspace) -> Record | None:
    """The study in the directory, as this or an earlier version recorded it; None if there is none, or if a file is in
    place of the directory.

    Raises ConfigError if its file cannot be read.
    """
    path = workspace.record
    try:
        values = json.loads(path.read_text())
        return from_dict(Record, values)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path} is damaged or of another version ({error}); delete it and run the study's command again"
        ) from error


def load_record(workspace: Workspace) -> Record:
    """The study in the directory. For the rest of this process its own registry entries are added to the registry, and
    the sizes of its datasets are taken from its tokens: its axes are planned with them. Raises ConfigError if there is
    no study, or one that does not say what its axes are."""
    record = find_record(workspace)
    if record is None:
        names = sorted(place.parent.name for place in workspace.root.glob(f"*/{CHECKPOINTS}"))
        # An unfinished tokenizer is called tokenizer.ID.
        single = [name for name in names if Path(name).stem != workspace.tokenizer.name]
        of_train = (
            f". There are single runs of `{PROGRAM} train`, whose progress is in their metrics.jsonl: {few(single)}"
            if single
            else ""
        )
        raise ConfigError(
            f"no study in {workspace.root} (it has no {workspace.record.name}){of_train}; start a study with "
            f"`{PROGRAM} study --out {shlex.quote(str(workspace.root))}`"
        )
    require(
        bool(record.axes),
        f"{workspace.record}: axes is empty; restore the axes that the study had, or run `{record.command}`",
    )
    use_own_entries(workspace)
    use_sizes(sizes_by_tokens(workspace.data_summary) if record.data else {})
    return record


def use_own_entries(workspace: Workspace) -> None:
    """Adds the user's own entries, with which the study was planned, to the registry for the rest of this process."""
    if workspace.registry.exists():
        from data_pipelines.registry.toml_file import load_entries

        register(load_entries(workspace.registry))
