"""A step whose numbers are not finite: the error, and a file about the batch of the step.

DIFFERS: after a loss that is NaN the release continues, with a gradient of zeros (reference section 4.1).
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from hma_jax.runtime.files import write_file
from hma_jax.training.state import FINITE

FILE = "diverged.json"
MAX_LISTED = 4
"""The most records of a batch that the message lists; the file has all."""

Records = Callable[[int], Sequence[str]]
"""The index of a batch in the stream (0: the first) -> a line for each record of which it is made."""

log = logging.getLogger(__name__)


class DivergedError(RuntimeError):
    """A loss, gradient or update became infinite or NaN. The last good checkpoint is kept."""


def require_finite(step: int, values: Mapping[str, float], run_dir: Path | None, records: Records) -> None:
    """Raises DivergedError, which names `step` and records of its batch, if the loss is not finite or one of the step's
    checks (`state.FINITE`) failed. All records are written to FILE in `run_dir`, unless that is None."""
    bad = [name.removeprefix(FINITE) for name, fine in values.items() if name.startswith(FINITE) and not fine]
    if math.isfinite(values["loss"]) and not bad:
        return
    if not math.isfinite(values["loss"]):
        what = f"the loss is {values['loss']} at step {step}"
    else:
        which = " and the ".join(bad) + (" are" if len(bad) > 1 else " is")
        what = f"the {which} not finite at step {step} (its loss is {values['loss']:.4g})"
    batch = list(records(step - 1))
    if run_dir is not None:
        _write(run_dir / FILE, {"step": step, "what": what, "records": batch})
    few = ""
    if batch:
        more = f" and {len(batch) - MAX_LISTED} more, listed in {FILE} of the run" if len(batch) > MAX_LISTED else ""
        few = f"its batch was {'; '.join(batch[:MAX_LISTED])}{more}; if these windows are correct, "
    raise DivergedError(
        f"{what}; {few}lower the learning rate or lengthen the warm-up, and train in a new output directory. To go on "
        "from the last checkpoint with a lower rate or another order of data: `hma branch`"
    )


def _write(path: Path, record: Mapping[str, object]) -> None:
    try:
        write_file(path, json.dumps(record, indent=1))
    except OSError as error:  # the divergence is the error to report
        log.warning("%s could not be written: %s", path, error.strerror)
