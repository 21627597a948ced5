"""A step whose numbers are not finite: the error, and the record of the batch that it was given.

DIFFERS: the release goes on after a loss that is NaN, with a gradient of zeros (reference section 4.1).
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
"""Records of a batch in the message; the file has all."""

Records = Callable[[int], Sequence[str]]
"""A line for each record that the batch at a place of the stream (0: the first) is made of."""

log = logging.getLogger(__name__)


class DivergedError(RuntimeError):
    """A loss, gradient or update became infinite or NaN. The last good checkpoint is kept."""


def require_finite(step: int, values: Mapping[str, float], run_dir: Path | None, records: Records) -> None:
    """Raises DivergedError, naming `step` and the records of its batch, if its loss or one of its checks
    (`state.FINITE`) failed. All of them are written to FILE in `run_dir`, unless that is None."""
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
    except OSError as error:  # that the step diverged is the news
        log.warning("%s could not be written: %s", path, error.strerror)
