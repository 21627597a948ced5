"""`hma branch`: a checkpoint of a run as a run of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from experiments.study_setup import UNSET
from experiments.terminal.progress import say, short, wrote
from hma_jax.config import require
from hma_jax.training.run_lock import require_plain


def branch(
    source: Annotated[Positional[Path], arg(metavar="RUN")],
    run: Annotated[Positional[Path], arg(name="new", metavar="NEW")],
    step: Annotated[int | None, arg(metavar="STEP"), UNSET] = None,
) -> None:
    """Copy one checkpoint of a run into a run of its own, to go on from there with other settings.

    To continue it, run `hma train --run NEW` with the arguments that RUN was trained with. --set may change settings of
    the optimiser (not matrices) and of the masks (not setting), the seed or the number of steps: a lower learning rate
    or another order of data after a spike of the loss, or more steps from before the learning rate decayed. Checkpoints
    of NEW record how it was trained until then. Other commands treat NEW like any run.

    Args:
        source: Directory of a training run.
        run: Directory of the new run; it must not exist. Its tokenizer is found if it lies beside RUN.
        step: Step of the checkpoint; the newest without this option. `hma train --keep-every` keeps earlier ones.
    """
    from hma_jax.training.branch import FILE
    from hma_jax.training.branch import branch as branch_run

    require_plain(source)
    require_plain(run)
    cut_short = (run / FILE).exists()
    require(cut_short or not run.exists(), f"{short(run)} exists; give the branch a directory of its own")
    copied = branch_run(source, run, step)
    say(f"{short(run)} has the checkpoint of step {copied:,} of {short(source)}")
    wrote(
        run, about=f"to go on: `hma train --run {short(run)}` with the arguments of {short(source)} and other settings"
    )
