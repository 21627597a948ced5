"""Which fields of a source become which features of a LeRobot dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from data_pipelines.sources.rlds.schema import field_slice, step_key
from data_pipelines.sources.source import action_fields, vector_sizes
from hma_jax.config import ConfigError, require

if TYPE_CHECKING:
    from data_pipelines.sources.source import EpisodeSource

ACTION, STATE = "action", "observation.state"

STATES = ("observation/state", "observation/proprio")
"""Names that sources use for the robot's state; the first that exists becomes `observation.state`."""


@dataclass(frozen=True)
class LeRobotFields:
    """Features by the names that LeRobot gives them.

    `cameras`: the flat key of each. `vectors`: for each, the keys that are concatenated to it; keys may be sliced
    ("steps/action[:7]"). `names`: the names of each vector's values.
    """

    cameras: Mapping[str, str]
    vectors: Mapping[str, tuple[str, ...]]
    names: Mapping[str, tuple[str, ...]]


def choose_fields(source: EpisodeSource, action: Sequence[str] = (), state: Sequence[str] = ()) -> LeRobotFields:
    """All cameras and vectors of `source`. `action` and `state`: keys, relative to a step, of the fields that become
    `action` and `observation.state`; other fields with these names are left out. By default `action_fields` and one of
    STATES.

    Raises ConfigError for unknown keys, for a source without a camera, and for two cameras of one name.
    """
    images = [key for key, feature in source.features.items() if feature.camera]
    numbers = {key: f.size for key, f in source.features.items() if f.size and not f.image and not f.encoding}
    vectors = list(vector_sizes(source.features))
    require(bool(images), f"{source.location}: it has no camera, so it cannot be written as a LeRobot dataset")
    cameras = {_camera(key): key for key in images}
    if lost := [key for key in images if cameras[_camera(key)] != key]:
        other = cameras[_camera(lost[0])]
        raise ConfigError(
            f"{source.location}: the cameras {lost[0]!r} and {other!r} would both be called {_camera(other)!r}; rename one"
        )
    actions = [step_key(key) for key in action or action_fields([key.removeprefix("steps/") for key in vectors])]
    states = [step_key(key) for key in state] or [step_key(key) for key in STATES if step_key(key) in vectors][:1]
    source.check_keys(images[0], [*actions, *states])
    chosen = {ACTION: tuple(actions), STATE: tuple(states)}
    taken = {field_slice(key)[0] for key in (*actions, *states)}
    chosen = {**{_feature(key): (key,) for key in vectors if key not in taken}, **chosen}
    chosen = {name: keys for name, keys in chosen.items() if keys}
    names = {
        name: tuple(value for key in keys for value in _value_names(key, numbers)) for name, keys in chosen.items()
    }
    return LeRobotFields(cameras, chosen, names)


def _value_names(key: str, sizes: Mapping[str, int]) -> list[str]:
    field, part = field_slice(key)
    name, numbers = field.rpartition("/")[2], range(sizes[field])[part]
    return [name] if sizes[field] == 1 else [f"{name}_{i}" for i in numbers]


def _camera(key: str) -> str:
    return f"observation.images.{key.removeprefix('steps/').removeprefix('observation/').replace('/', '_')}"


def _feature(key: str) -> str:
    return key.removeprefix("steps/").replace("/", ".")
