"""Arguments that several commands share, besides `StudyArguments`. They hold for one command and are not passed to the
next."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, UseAppendAction, arg

from experiments.preparing.made_from import Step
from experiments.running.launchers.registry import LAUNCHERS
from experiments.running.run_options import RunOptions
from experiments.study_setup import UNSET, StudyArguments, require_local


@dataclass(frozen=True)
class RunningArguments:
    """How trials are run; none of it changes a result."""

    workers: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 1; on a cluster: no limit)")] = None
    """How many trials run at the same time, each in its own process.
    On this machine they share cores and accelerators equally."""
    launcher: Annotated[str, arg(metavar="|".join(LAUNCHERS))] = "local"
    """Where trials run: on this machine, through Slurm, or on a Ray cluster (docs/launching.md)."""
    launcher_set: Annotated[UseAppendAction[tuple[str, ...]], arg(name="launcher-set", metavar="KEY=VALUE")] = ()
    """One setting of the launcher, such as partition=gpu or gpus=1."""
    retry_failed: Annotated[FlagCreatePairsOff[bool], arg(name="retry-failed"), UNSET] = False
    """Run failed trials again from their last checkpoint; without it the report lists them as failed.
    Trials that diverged are never run again: they would diverge again."""
    accept_code: Annotated[FlagCreatePairsOff[bool], arg(name="accept-code"), UNSET] = False
    """Continue although the code has changed since earlier trials of the study ran.
    Only for changes that alter no result. The report then says how many versions of the code ran."""
    dry_run: Annotated[FlagCreatePairsOff[bool], arg(name="dry-run"), UNSET] = False
    """Print the trials with their parameters, FLOPs and expected time on the devices that they would use, and stop."""

    def words(self) -> list[str]:
        """The arguments that say where and how many at a time."""
        words = [] if self.workers is None else ["--workers", str(self.workers)]
        words += ["--launcher", self.launcher] if self.launcher != "local" else []
        return words + [word for one in self.launcher_set for word in ("--launcher-set", one)]


@dataclass(frozen=True)
class ReplaceArguments:
    """Results made with other settings or data are replaced only on request."""

    replace: Annotated[Step | None, arg(metavar="STEP"), UNSET] = None
    """Redo this step and those that depend on it, and replace results made with other settings or data.
    The steps in order: suite, tokenizer, tokens, windows, study."""


@dataclass(frozen=True)
class ModelArguments:
    """How one model is trained."""

    run: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: OUT/model)")] = None
    """Directory of the training run. Resumed if it exists."""
    trajectories: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")] = None
    """Train on N trajectories of each robot, chosen by hash: the same ones as in a sweep over trajectories."""

    def directory(self, study: StudyArguments) -> Path:
        """`run`, or by default the study's directory for a single model. Raises ConfigError for a URL."""
        require_local("--run", self.run)
        return self.run or study.anywhere().out / "model"


# The types that commands take: `--help` shows the options of each under its name.
StudyOptions = Annotated[OmitArgPrefixes[StudyArguments], arg(name="study")]
ModelOptions = Annotated[OmitArgPrefixes[ModelArguments], arg(name="model")]
SavingOptions = Annotated[OmitArgPrefixes[RunOptions], arg(name="saving")]
ReplaceOptions = Annotated[OmitArgPrefixes[ReplaceArguments], arg(name="replacement")]
