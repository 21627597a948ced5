"""The record type of the dataset registry: everything a reader must be told about one dataset."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from data_pipelines.rlds.schema import field_slice
from hma_jax.config import require

FRAME_RATE = 2.0
"""Hz at which the model sees frames (paper section 4)."""


def stride_of(hz: float) -> int:
    """Native frames per model frame: the integer that comes nearest to 2 Hz, at least 1.

    DIFFERS: the release floors the ratio and knows a rate for 28 of its 40 datasets only;
    the others run at their native rate (reference sections 5.3 and 5.4).
    """
    return max(round(hz / FRAME_RATE), 1)


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
    val_split: str = ""  # the part of `split` ("train+val") that is held out; "": episodes chosen by hash

    def __post_init__(self):
        name = self.name
        require(
            len(self.action_keys) == len(self.action_dims),
            f"dataset {name!r}: action_keys and action_dims must have the same length",
        )
        require(self.hz > 0, f"dataset {name!r}: hz, the native rate, must be positive, got {self.hz}")
        require(
            all(d >= 1 for d in self.action_dims),
            f"dataset {name!r}: action_dims must be at least 1, got {self.action_dims}",
        )
        require(
            not self.val_split or self.val_split in self.split.split("+")[1:],
            f"dataset {name!r}: val_split {self.val_split!r} is held out, so it must follow another in split, "
            f"such as 'train+{self.val_split}'; got {self.split!r}",
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
        """Native frames per model frame."""
        return stride_of(self.hz)

    @property
    def action_dim(self) -> int:
        return sum(self.action_dims)

    def facts(self) -> DatasetSpec:
        """This entry without its words for people, which do not change the data."""
        return dataclasses.replace(self, camera="", note="", version="", unverified="")
