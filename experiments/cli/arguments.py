"""Arguments of several commands besides `StudyArguments`; they hold for one command and are not passed to the next."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, UseAppendAction, arg

from experiments.preparing.made_from import Step
from experiments.running.launchers.registry import LAUNCHERS
from experiments.running.run_options import RunOptions
from experiments.setting import UNSET, StudyArguments, require_local


@dataclass(frozen=True)
class RunningArguments:
    """How trials are run; none of it changes a result."""

    workers: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 1; elsewhere: what there is)")] = None
    """Trials at a time, each in its own process: on this machine with its share of cores and accelerators."""
    launcher: Annotated[str, arg(metavar="|".join(LAUNCHERS))] = "local"
    """Where trials run: on this machine, through Slurm, or on a Ray cluster; docs/launching.md."""
    launcher_set: Annotated[UseAppendAction[tuple[str, ...]], arg(name="launcher-set", metavar="KEY=VALUE")] = ()
    """One setting of the launcher, such as partition=gpu or gpus=1."""
    retry_failed: Annotated[FlagCreatePairsOff[bool], arg(name="retry-failed"), UNSET] = False
    """Run trials again that failed, from their checkpoints, or diverged, from the start.
    Otherwise they stay as they are, and visible."""
    accept_code: Annotated[FlagCreatePairsOff[bool], arg(name="accept-code"), UNSET] = False
    """Go on though the code changed since trials of the study ran; the page then counts the sources.
    For changes that alter no result."""
    dry_run: Annotated[FlagCreatePairsOff[bool], arg(name="dry-run"), UNSET] = False
    """Print trials, parameters, FLOPs and expected time on the devices that they would use here, and stop."""

    def words(self) -> list[str]:
        """The arguments that say where and how many at a time."""
        words = [] if self.workers is None else ["--workers", str(self.workers)]
        words += ["--launcher", self.launcher] if self.launcher != "local" else []
        return words + [word for one in self.launcher_set for word in ("--launcher-set", one)]


@dataclass(frozen=True)
class ReplaceArguments:
    """What was made with other settings or data is never replaced without being asked for."""

    replace: Annotated[Step | None, arg(metavar="STEP"), UNSET] = None
    """Make this step, and those that follow from it, again in place of what differs there.
    In order: suite, tokenizer, tokens, windows, study."""


@dataclass(frozen=True)
class ModelArguments:
    """How one model is trained."""

    run: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: OUT/model)")] = None
    """Directory of the training run. Resumed if it exists."""
    trajectories: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: all)")] = None
    """Trajectories of each robot, chosen by hash: the same as in a sweep over trajectories."""

    def directory(self) -> Path | None:
        """`run`. Raises ConfigError for a URL."""
        require_local("--run", self.run)
        return self.run


# As commands take them: `--help` shows those of each under its name.
StudyOptions = Annotated[OmitArgPrefixes[StudyArguments], arg(name="study")]
ModelOptions = Annotated[OmitArgPrefixes[ModelArguments], arg(name="model")]
SavingOptions = Annotated[OmitArgPrefixes[RunOptions], arg(name="saving")]
ReplaceOptions = Annotated[OmitArgPrefixes[ReplaceArguments], arg(name="replacement")]
