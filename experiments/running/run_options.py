"""Options of one training run, of `hma train` and `hma adapt`: checkpoints, validation and a profile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, arg

from hma_jax.config import require

UNSET = arg(help_behavior_hint="")
"""For an option whose text says what happens without it."""

CHECKPOINTS = 5
"""Number of checkpoints per training run, evenly spread, in addition to those by time; an interrupted trial resumes
from them. A run of fewer steps is saved only at its end, since saving would take longer than its steps."""

VALIDATIONS = 20
"""Number of validations per training run, for runs that are validated while they train, unless set otherwise."""


@dataclass(frozen=True)
class RunOptions:
    """How a run is saved and validated. Nothing here changes its result; it may differ each time a run is continued."""

    checkpoint_every: Annotated[
        int | None, arg(name="checkpoint-every", metavar="STEPS", help_behavior_hint="(default: a fifth of all)")
    ] = None
    """Steps between checkpoints; 0: no checkpoints by steps.
    The run is always saved at its end and when interrupted."""
    checkpoint_minutes: Annotated[float, arg(name="checkpoint-minutes", metavar="MINUTES")] = 10.0
    """Minutes between checkpoints, in addition to those by steps; 0: no checkpoints by time."""
    keep_checkpoints: Annotated[int, arg(name="keep-checkpoints", metavar="N")] = 2
    """Number of newest checkpoints that are kept."""
    keep_every: Annotated[int, arg(name="keep-every", metavar="STEPS")] = 0
    """Also save and keep a checkpoint each time this many steps have passed; 0: none.
    With schedule wsd the last one before the decay is kept anyway."""
    skip_damaged: Annotated[FlagCreatePairsOff[bool], arg(name="skip-damaged"), UNSET] = False
    """Continue from the newest undamaged checkpoint.
    Damaged checkpoints after it are moved to RUN/damaged."""
    validate_every: Annotated[
        int | None, arg(name="validate-every", metavar="STEPS", help_behavior_hint="(default: a twentieth of all)")
    ] = None
    """Steps between evaluations of the loss on held-out windows; 0: none.
    They are written to RUN/validation.jsonl."""
    trace: Annotated[int | None, arg(metavar="STEPS"), UNSET] = None
    """Record a profile of this many steps with JAX's profiler, after the first ten steps.
    It is written to RUN/profile (docs/performance.md)."""

    def check(self) -> None:
        """Raises ConfigError for invalid values, naming the options of the command line."""
        hint = "; 0 saves at the end and when interrupted"
        for name, more in (
            ("checkpoint_every", hint),
            ("checkpoint_minutes", hint),
            ("validate_every", ""),
            ("keep_every", ""),
        ):
            value, flag = getattr(self, name), "--" + name.replace("_", "-")
            require(value is None or value >= 0, f"{flag} must not be negative, got {value}{more}")
        for flag, value in (("--keep-checkpoints", self.keep_checkpoints), ("--trace", self.trace)):
            require(value is None or value >= 1, f"{flag} must be at least 1, got {value}")

    def steps_between(self, steps: int) -> tuple[int, int]:
        """(checkpoints, validations) of a run of `steps`; 0: none."""
        saves = steps // CHECKPOINTS if self.checkpoint_every is None else self.checkpoint_every
        views = steps // VALIDATIONS if self.validate_every is None else self.validate_every
        return saves, views


UNWATCHED = RunOptions(validate_every=0)
"""Options of a study's trials, which are evaluated only at their end."""
