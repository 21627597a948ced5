"""The record type of the dataset registry: everything that reading a dataset needs and its files do not say."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from data_pipelines.names import NAME_RULE, is_dataset_name, quote
from data_pipelines.registry.angles import AngleForm, AngleUnit, angle_width, convert_angles
from data_pipelines.sources.rlds.schema import field_slice
from hma_jax.config import ConfigError, require
from hma_jax.config.base import later
from hma_jax.config.json import stable_hash

if TYPE_CHECKING:
    from hma_jax.model.embodiments import Embodiment

FRAME_RATE = 2.0
"""Hz at which the model sees frames unless a study says otherwise (paper section 4)."""


MAX_STRIDE = 1_000_000
"""Largest number of native frames per model frame: more than any recording has, and small enough to compute with."""


NOT_OF_ACTIONS = (
    "name", "image_key", "hz", "rate", "camera", "split", "note", "video_targets", "version", "unverified",
    "episodes", "median_steps", "mean_steps", "val_split", "image_corrections", "joins",
)  # fmt: skip
"""Fields of an entry that do not affect the meaning of action values."""


ImageCorrection = Literal["rotate_180", "swap_red_blue"]


def stride_of(hz: float, rate: float | None) -> int:
    """Native frames per model frame, at least 1: of the two integers around hz / rate, the one that is nearer in ratio.

    Frames are then as near to `rate` Hz as possible: for 5 Hz and a rate of 2 the stride is 3 (1.67 Hz, off by a
    factor of 1.2), not 2 (2.5 Hz, 1.25). Both would be equally near at sqrt(n (n + 1)), which is irrational, so there
    are no ties. `rate` None is the native rate, stride 1.
    DIFFERS: the release rounds the ratio down, and knows a rate for only 28 of its 40 datasets; the others run at their
    native rate (reference sections 5.3 and 5.4).
    """
    if rate is None:
        return 1
    require(rate > 0, f"the frame rate must be positive, in Hz, got {rate}")
    ratio = hz / rate
    require(
        ratio <= MAX_STRIDE,
        f"a frame of the model would span {ratio:.3g} native frames, at {hz:g} Hz and a rate of {rate:g} Hz; at most "
        f"{MAX_STRIDE:,} are possible: correct hz, which counts native frames per second, or the rate",
    )
    below = max(int(ratio), 1)
    return below if ratio * ratio <= below * (below + 1) else below + 1


def split_camera_key(text: str) -> tuple[str, tuple[str, ...]]:
    """`image_key` and `image_corrections` of a `DatasetSpec.camera_key`."""
    words, known = text.split(" "), get_args(ImageCorrection)
    first = next((i for i in range(1, len(words)) if all(word in known for word in words[i:])), len(words))
    return " ".join(words[:first]), tuple(words[first:])


@dataclass(frozen=True)
class DatasetSpec:
    """How one RLDS dataset is read.

    Keys are fields of a step as features.json names them. The action is the concatenation of
    `action_keys` in their order; `action_dims` says how many values each has. `action[:7]` takes
    the first seven values of a field, for fields whose other values are not actions. Without any key the dataset has
    video only; with `video_targets` False its frames are shown to the model but never predicted.

    `angles` are the values of the action, counted from 0 over all its keys, that are angles in
    `angle_unit` and wrap; `angle_form` says how they are given (see `angles`). They are part of the
    action's layout: tokens made with other angle settings are different data.
    """

    name: str
    image_key: str
    action_keys: tuple[str, ...]
    action_dims: tuple[int, ...]
    hz: float  # native rate of frames and actions
    camera: str = ""  # for people, like all fields that `facts` leaves out
    split: str = "train"
    note: str = ""
    video_targets: bool = True
    version: str = ""  # version in tfds for which the keys were written
    unverified: str = ""  # facts of this entry that no public source confirms
    rate: float | None = later(None)  # Hz at which its frames are shown, whatever the study's rate; None: the study's
    angles: tuple[int, ...] = later(())  # values that wrap; part of the data, like the next two fields
    angle_form: AngleForm = later("as_recorded")
    angle_unit: AngleUnit = later("radian")
    # For people again; 0: unknown.
    episodes: int = later(0)  # of `split`
    median_steps: float = later(0.0)  # of an episode
    mean_steps: float = later(0.0)
    val_split: str = later("")  # the part of `split` ("train+val") that is held out; "": episodes chosen by hash
    # Applied to every frame that is read: for a camera that is mounted upside down, or colours written as BGR.
    image_corrections: tuple[ImageCorrection, ...] = later(())
    # Datasets, by the names in their own files, that together make up this one, in this order; (): a single dataset.
    joins: tuple[str, ...] = later(())

    def __post_init__(self):
        name = self.name
        require(is_dataset_name(name), f"{quote(name)} cannot be the name of a dataset: {NAME_RULE}")
        require(
            len(self.action_keys) == len(self.action_dims),
            f"dataset {name!r}: action_keys and action_dims must have the same length",
        )
        require(
            0 < self.hz < math.inf,
            f"dataset {name!r}: hz, the native rate, must be positive and finite, got {self.hz}",
        )
        require(
            self.rate is None or 0 < self.rate < math.inf,
            f"dataset {name!r}: rate, the frame rate in Hz, must be positive and finite, got {self.rate}",
        )
        require(
            all(d >= 1 for d in self.action_dims),
            f"dataset {name!r}: action_dims must be at least 1, got {self.action_dims}",
        )
        require(
            not self.val_split or self.val_split in self.split.split("+")[1:],
            f"dataset {name!r}: val_split {self.val_split} is the held-out split, so split must name it after another "
            f"one, such as 'train+{self.val_split}'; got {self.split!r}",
        )
        for key, dim in zip(self.action_keys, self.action_dims, strict=True):
            part = field_slice(key)[1]
            if part.stop is not None:
                taken = part.stop - part.start
                require(taken == dim, f"dataset {name!r}: {key!r} uses {taken} values, but action_dims says {dim}")
        width = sum(self.action_dims)
        require(
            list(self.angles) == sorted(set(self.angles)) and all(0 <= d < width for d in self.angles),
            f"dataset {name!r}: angles must be increasing positions in its {width} action values, counted from 0, got "
            f"{self.angles}",
        )
        require(
            bool(self.angles) or self.angle_form == "as_recorded",
            f"dataset {name!r}: angle_form {self.angle_form!r} needs the list of values that are angles: add `angles`",
        )
        known = get_args(ImageCorrection)
        require(
            list(self.image_corrections) == [c for c in known if c in self.image_corrections],
            f"dataset {name!r}: image_corrections may list {', '.join(known)}, in this order and each once, got "
            f"{self.image_corrections}",
        )
        for joined in self.joins:
            require(
                is_dataset_name(joined),
                f"dataset {name!r}: joins has {quote(joined)}, which cannot be the name of a dataset. Write the names that "
                "`hma data inspect` prints, not directories",
            )
        require(len(set(self.joins)) == len(self.joins), f"dataset {name!r}: joins names a dataset twice: {self.joins}")

    @property
    def stride(self) -> int:
        """Native frames per model frame at the rate of pre-training."""
        return self.stride_at(FRAME_RATE)

    def stride_at(self, rate: float | None) -> int:
        """Native frames per model frame in a study at `rate` Hz (None: native), unless this entry has its own."""
        return stride_of(self.hz, rate if self.rate is None else self.rate)

    def rate_for(self, stride: int) -> float:
        """The rate, in Hz, that gives this stride, rounded to six digits, which is accurate enough."""
        return float(f"{self.hz / stride:.6g}")

    def check_compatible(self, robot: Embodiment, rate: float | None) -> None:
        """Raises ConfigError, saying what to change, unless a study at `rate` Hz gives each frame the same actions as
        this `robot` of a model has."""
        name = self.name
        again = "in a file for --registry (`hma data inspect --entry` writes one), and tokenise into another --out"
        if self.action_dim != robot.action_dim:
            raise ConfigError(
                f"{name}: the model was trained with {robot.action_dim} action values, but the registry's entry has "
                f"{self.action_dim}: {self._takes()}. Write those of the model into the entry of {name}, {again}."
            )
        stride = self.stride_at(rate)
        if stride != robot.stride:
            right = f"{self.rate_for(robot.stride):g}"
            raise ConfigError(
                f"{name}: the model was trained with frames at stride {robot.stride}, but here the stride is {stride} "
                f"at {self.hz:g} Hz. Write `rate = {right}` into the entry of {name}, {again}; --set rate={right} "
                "does the same for all datasets whose entries have no rate. To train at stride "
                f"{stride}, add it as a new robot with `hma adapt --everything` (docs/models.md, Another rate)."
            )
        self.check_layout(robot, f", {again}")

    def check_layout(self, robot: Embodiment, again: str = "") -> None:
        """Raises ConfigError unless an action's values are those of this `robot` of a model, in the same order;
        `again`: what else the user must do."""
        if robot.layout and self.action_layout() != robot.layout:  # converted models do not say
            raise ConfigError(
                f"{self.name}: the action has other values, or another order of them, than when the model was "
                f"trained: the registry's entry has {self._takes()}. Restore the entry of {self.name}{again}."
            )

    def _takes(self) -> str:
        dims = zip(self.action_keys, self.action_dims, strict=True)
        return ", ".join(f"{key} ({dim})" for key, dim in dims) or "no actions"

    def action_layout(self) -> str:
        """A hash of the meaning and order of the action values; equal for equal layouts.

        Covers all fields of the entry with a value other than the default, except those in `NOT_OF_ACTIONS`.
        """
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in NOT_OF_ACTIONS}
        defaults = {f.name: f.default for f in dataclasses.fields(self)}
        return stable_hash({name: value for name, value in own.items() if value != defaults[name]})

    @property
    def action_dim(self) -> int:
        """Number of values of one native action as the model receives it."""
        return angle_width(sum(self.action_dims), self.angles, self.angle_form)

    def convert(self, actions: np.ndarray) -> np.ndarray:
        """float32 [N, action_dim]: the actions of an episode [N, sum(action_dims)], as the model receives them."""
        return convert_angles(actions, self.angles, self.angle_form, self.angle_unit)

    @property
    def camera_key(self) -> str:
        """`image_key` and `image_corrections` in one text: equal for equal frames. Without corrections it is the
        key."""
        return " ".join((self.image_key, *self.image_corrections))

    def correct(self, images: np.ndarray) -> np.ndarray:
        """uint8 [..., H, W, 3]: frames of its camera, after `image_corrections`; without corrections, the array
        itself."""
        if "rotate_180" in self.image_corrections:
            images = images[..., ::-1, ::-1, :]
        if "swap_red_blue" in self.image_corrections:
            images = images[..., ::-1]
        return np.ascontiguousarray(images) if self.image_corrections else images

    def facts(self) -> DatasetSpec:
        """This entry without the fields that only describe it and do not affect the data."""
        return dataclasses.replace(
            self, camera="", note="", version="", unverified="", episodes=0, median_steps=0.0, mean_steps=0.0
        )
