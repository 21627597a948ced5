"""The record type of the dataset registry: everything a reader must be told about one dataset."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from data_pipelines.rlds.schema import field_slice
from hma_jax.config import require
from hma_jax.config.json import stable_hash

FRAME_RATE = 2.0
"""Hz at which the model sees frames unless a study says otherwise (paper section 4)."""


NOT_OF_ACTIONS = ("name", "image_key", "hz", "rate", "camera", "split", "note", "video_targets", "version", "unverified")
"""Fields of an entry that say nothing of what an action's values are."""


def stride_of(hz: float, rate: float | None = FRAME_RATE) -> int:
    """Native frames per model frame, at least 1: of the two integers around hz / rate the one nearer in ratio.

    Frames are then as near to `rate` Hz as they can be: 5 Hz for 2 has stride 3 (1.67 Hz, off by a factor of
    1.2), not 2 (2.5 Hz, 1.25). The two are equally near at sqrt(n (n + 1)), which no fraction equals, so there is
    no tie to decide. `rate` None is the native one, stride 1.
    DIFFERS: the release floors the ratio and knows a rate for 28 of its 40 datasets only;
    the others run at their native rate (reference sections 5.3 and 5.4).
    """
    if rate is None:
        return 1
    require(rate > 0, f"the rate of a window's frames must be positive, in Hz, got {rate}")
    ratio = hz / rate
    below = max(int(ratio), 1)
    return below if ratio * ratio <= below * (below + 1) else below + 1


@dataclass(frozen=True)
class DatasetSpec:
    """How one RLDS dataset is read.

    Keys are fields of a step as features.json names them. The action is the concatenation of
    `action_keys` in their order; `action_dims` says how many values each has. `action[:7]` takes
    the first seven values of a field, for fields whose rest is no action. Without any key the
    dataset is video alone; with `video_targets` False its frames are shown but never predicted.
    """

    name: str
    image_key: str
    action_keys: tuple[str, ...]
    action_dims: tuple[int, ...]
    hz: float  # native rate of frames and actions
    camera: str = ""  # for people, as all that follows but `split` and `video_targets`
    split: str = "train"
    note: str = ""
    video_targets: bool = True
    version: str = ""  # of tfds, for which the keys were written
    unverified: str = ""  # which of this entry's facts no public source confirms
    rate: float | None = None  # Hz at which its frames are shown, whatever the study's rate; None: the study's

    def __post_init__(self):
        name = self.name
        require(
            len(self.action_keys) == len(self.action_dims),
            f"dataset {name!r}: action_keys and action_dims must have the same length",
        )
        require(self.hz > 0, f"dataset {name!r}: hz, the native rate, must be positive, got {self.hz}")
        require(
            self.rate is None or self.rate > 0,
            f"dataset {name!r}: rate, of its frames in Hz, must be positive, got {self.rate}",
        )
        require(
            all(d >= 1 for d in self.action_dims),
            f"dataset {name!r}: action_dims must be at least 1, got {self.action_dims}",
        )
        for key, dim in zip(self.action_keys, self.action_dims, strict=True):
            part = field_slice(key)[1]
            if part.stop is not None:
                taken = part.stop - part.start
                require(
                    taken == dim, f"dataset {name!r}: {key!r} takes {taken} values, action_dims says {dim}"
                )

    @property
    def stride(self) -> int:
        """Native frames per model frame at the rate of pre-training."""
        return self.stride_at(FRAME_RATE)

    def stride_at(self, rate: float | None) -> int:
        """Native frames per model frame in a study at `rate` Hz (None: native), unless this entry has its own."""
        return stride_of(self.hz, rate if self.rate is None else self.rate)

    def action_layout(self) -> str:
        """A hash of what the values of an action mean and where they stand; of equal layouts it is equal.

        Covers every fact of the entry but what `NOT_OF_ACTIONS` names, as far as it is not the default.
        """
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in NOT_OF_ACTIONS}
        defaults = {f.name: f.default for f in dataclasses.fields(self)}
        return stable_hash({name: value for name, value in own.items() if value != defaults[name]})

    @property
    def action_dim(self) -> int:
        return sum(self.action_dims)

    def facts(self) -> DatasetSpec:
        """This entry without its words for people, which do not change the data."""
        return dataclasses.replace(self, camera="", note="", version="", unverified="")
