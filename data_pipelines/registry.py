"""The dataset registry: which camera and which action fields of a dataset are used, at what rate.

One table. A dataset of one's own is one more `DatasetSpec` in `REAL`; the entries of the
embedded suite and of the simulator suite are derived from their own tables. Reads no file.
"""

from __future__ import annotations

import difflib
import functools
from dataclasses import dataclass

from data_pipelines.sim.embodiments import EMBODIMENTS as SIMULATED
from data_pipelines.suite.embodiments import EMBODIMENTS
from hma_jax.config import ConfigError, require

FRAME_RATE = 2.0
"""Hz at which the model sees frames (paper section 4)."""


@dataclass(frozen=True)
class DatasetSpec:
    """How one RLDS dataset is read.

    Keys are fields of a step as features.json names them. The action is the concatenation of
    `action_keys` in their order; `action_dims` says how many values each has. Without any the
    dataset is video alone; with `video_targets` False its frames are shown but never predicted.
    """

    name: str
    image_key: str
    action_keys: tuple[str, ...]
    action_dims: tuple[int, ...]
    hz: float  # native rate of frames and actions
    camera: str = ""  # for people
    split: str = "train"
    note: str = ""
    video_targets: bool = True

    def __post_init__(self):
        require(
            len(self.action_keys) == len(self.action_dims),
            f"dataset {self.name!r}: action_keys and action_dims must have the same length",
        )
        require(self.hz > 0, f"dataset {self.name!r}: hz must be positive, got {self.hz}")

    @property
    def stride(self) -> int:
        """Native frames per model frame: the integer that comes nearest to 2 Hz, at least 1.

        DIFFERS: the release floors the ratio and knows a rate for 28 of its 40 datasets only;
        the others run at their native rate (reference sections 5.3 and 5.4).
        """
        return max(round(self.hz / FRAME_RATE), 1)

    @property
    def action_dim(self) -> int:
        return sum(self.action_dims)


REAL = (
    DatasetSpec(
        "bridge_dataset",
        image_key="observation/image_0",
        action_keys=("action",),
        action_dims=(7,),
        hz=5,
        camera="over the shoulder, fixed",
        note="WidowX, Bridge V2: end-effector deltas and gripper",
    ),
    DatasetSpec(
        "droid_sample",
        image_key="observation/exterior_image_1_left",
        action_keys=("action_dict/cartesian_position", "action_dict/gripper_position"),
        action_dims=(6, 1),
        hz=5,
        camera="exterior, fixed",
        note="Franka, DROID at 5 Hz: absolute end-effector pose and gripper",
    ),
    DatasetSpec(
        "unitree_g1_sample",
        image_key="observation/image",
        action_keys=("action",),
        action_dims=(26,),
        hz=30,
        camera="head",
        note="Unitree G1, two arms and hands: absolute joint targets",
    ),
)


@functools.cache
def _table() -> dict[str, DatasetSpec]:
    table = {spec.name: spec for spec in REAL}
    for e in EMBODIMENTS:
        prefix = "action/" if e.dict_actions else ""
        table[e.name] = DatasetSpec(
            e.name,
            image_key=f"observation/{e.image_keys[0]}",
            action_keys=tuple(prefix + key for key, _ in e.action_layout),
            action_dims=tuple(dim for _, dim in e.action_layout),
            hz=e.hz,
            camera=e.image_keys[0],
            note=f"simulated {e.kind}, {e.convention} actions",
        )
    for s in SIMULATED:
        table[s.name] = DatasetSpec(
            s.name,
            image_key="observation/image",
            action_keys=("action",),
            action_dims=(s.action_dim,),
            hz=s.hz,
            camera=s.view.title,
            note=f"{s.package}: {s.instruction or f'{len(s.envs)} tasks'}",
        )
    return table


def all_specs() -> tuple[DatasetSpec, ...]:
    """Every known dataset: the real ones, then the suite in its own order."""
    return tuple(_table().values())


def get_spec(name: str) -> DatasetSpec:
    """The entry called `name`; ConfigError with the closest names otherwise."""
    spec = _table().get(name)
    if spec is None:
        close = difflib.get_close_matches(name, _table(), n=3, cutoff=0.4)
        hint = f"did you mean {', '.join(close)}?" if close else f"known: {', '.join(_table())}."
        raise ConfigError(
            f"unknown dataset {name!r}; {hint} A new one is an entry in data_pipelines/registry.py."
        )
    return spec
