"""What many commands ask: which study, on which data, where, and how its trials are run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import UseAppendAction, arg

from experiments.commands import study as commands

Preset = Literal["smoke", "cpu", "accelerator", "paper", "smoke-continuous", "cpu-continuous"]


@dataclass(frozen=True)
class Where:
    """Which study, on which data, in which directory."""

    preset: Preset = "cpu"
    """Named study: smoke (seconds), cpu (minutes), accelerator (one GPU), paper (as published); with
    -continuous, on latents instead of ids."""
    out: Path | None = None
    """Directory for everything that is written; runs/PRESET if not given."""
    data: Annotated[tuple[str, ...], arg(metavar="[DIR ...]")] = ()
    """Your RLDS directories, paths or URLs such as gs://..., instead of the simulated suite. Their names must
    be in the registry."""
    registry: Path | None = None
    """TOML file with registry entries of your own, as `hma data inspect --entry` writes it."""
    mixture: str | None = None
    """Named list of datasets, such as dataset10; --data then takes the directories that hold them."""
    tokenizer: Path | None = None
    """Directory of a tokenizer to use, instead of training one on the data. The model's tokens follow it."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="PATH=VALUE")] = ()
    """Change one setting, such as --set model.frames=4 --set train.steps=100; may be repeated."""

    def setting(self) -> commands.Setting:
        return commands.make_setting(
            self.preset, self.out, self.data, self.set, self.tokenizer, self.registry, self.mixture
        )


@dataclass(frozen=True)
class How:
    """How trials are run; none of it changes a result."""

    workers: int = 1
    """Trials at a time, each in its own process with its share of the cores."""
    retry_failed: Annotated[bool, arg(name="retry-failed")] = False
    """Run trials again that failed or diverged; otherwise they stay as they are, and visible."""
    dry_run: Annotated[bool, arg(name="dry-run")] = False
    """Print trials, parameters, FLOPs and expected time, and stop."""
    mesh: tuple[int, int, int] | None = None
    """Devices for data, fsdp and tensor parallelism; -1 takes those that are left."""
