"""Robomimic demonstrations: one HDF5 file of `data/demo_*`, with camera images.

Per demonstration of N steps: `actions` [N, A], `obs/<camera>_image` uint8 [N, H, W, 3] before each action (if none has
that ending, as in LIBERO's files, `obs/<camera>` of that shape), other `obs/*` as vectors, `states` of the simulator,
`rewards` and `dones` [N]. `mask/<key>` names demonstrations, such as the training ones (`train`, `valid`). The rate is
the environment's `control_freq`: 20 Hz for every published task. The text is LIBERO's `language_instruction`, or else
the environment's name.
DIFFERS: the release uses only states, renders them at 128 pixels, calls the rate 6 Hz, and has a held-out split of one
task (reference sections 5.4 and 5.5); here episodes keep their images, state and rate, and the held-out ones are drawn
by hash.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError, UnreachableError
from data_pipelines.names import quote
from data_pipelines.sources.convertible import Episode, Layout, UnitError, choose, require_module
from data_pipelines.sources.rlds.location import is_io_error, retry
from data_pipelines.sources.rlds.schema import of_a_part
from data_pipelines.sources.rlds.writer import encode_jpeg, image_field
from data_pipelines.sources.settings import RobomimicSettings
from data_pipelines.sources.video import shrink
from hma_jax.config import ConfigError

CONTROL_RATE = 20.0
SIM_STATE = "observation/sim_state"
SUCCESS_REWARD = 1.0
"""robosuite's reward of a solved task, sparse or shaped; shaping alone stays below it."""

ADVICE = (
    "Download the file again, or leave the demonstration out with --skip-damaged (when tokenising, corrupt='skip')."
)


DAMAGE_ERRORS = (AttributeError, KeyError, OSError, RuntimeError, TypeError, ValueError)
"""What h5py raises for a damaged file; AttributeError: for a group in place of an array, or the reverse."""


class RobomimicSource:
    """Opens the file once to learn its layout, and again for each demonstration.

    Raises DataError for a file of another layout or without images, ConfigError for a camera or
    mask that it lacks.
    """

    def __init__(self, path: str | Path, settings: RobomimicSettings = RobomimicSettings()):
        settings.check()
        self.path, self.short_side = Path(path), settings.short_side
        with self.open() as file, damage_as(str(path), DataError):
            self.task, self.recorded_hz = _environment(self.path, file)
            self.text = _instruction(self.path, file) or self.task
            self.masks = _demonstrations(self.path, file, settings.filter_key)  # the mask of each demonstration
            self.units = list(self.masks)
            demo = file["data"][self.units[0]]
            self.layout, self.cameras, self.ending, self.unsupported_images = self._read_layout(demo, settings.camera)
        self.hz = float(settings.hz or self.recorded_hz or CONTROL_RATE)
        self.description = f"Robomimic demonstrations of {self.task} ({self.path.name}), {self.hz:g} Hz."

    def identity(self) -> dict[str, Any]:
        return {
            "format": "robomimic",
            "file": [self.path.name, self.path.stat().st_size],
            "content": self.content,
            "units": list(self.units),
            "cameras": list(self.cameras),
            "hz": self.hz,
            "short_side": self.short_side,
            "text": self.text,
        }

    @functools.cached_property
    def content(self) -> str:
        """Hash over the name, actions and first image of each camera of every demonstration. The file's size is not
        enough: images rendered again from the same states take the same number of bytes."""
        digest = hashlib.sha256()
        with self.open() as file:
            for name in self.units:
                digest.update(f"{name}:".encode())
                where = f"{self.path}: data/{name}"
                with suppress(UnitError), damage_as(where):  # reading the demonstration reports what is wrong
                    rows = read_rows(file["data"][name], "actions", where)
                    digest.update(np.ascontiguousarray(rows, "<f8").tobytes())
                    for camera in self.cameras:
                        picture = read_rows(file["data"][name], f"obs/{camera}{self.ending}", where, slice(1))
                        digest.update(np.ascontiguousarray(picture).tobytes())
        return digest.hexdigest()[:16]

    def read(self, unit: int) -> Iterator[Episode]:
        name = self.units[unit]
        where = f"{self.path}: data/{name}"
        with self.open() as file, damage_as(where):
            demo = file["data"][name]
            actions = read_rows(demo, "actions", where)
            steps = len(actions)
            images = {}
            for camera in self.cameras:
                frames = read_rows(demo, f"obs/{camera}{self.ending}", where)
                if not holds_images(frames) or len(frames) != steps:
                    raise UnitError(
                        f"{where}/obs/{camera}{self.ending} is {frames.dtype} {list(frames.shape)}; {steps} actions "
                        f"need uint8 images [{steps}, H, W, 3]. {ADVICE}"
                    )
                images[f"observation/{camera}"] = [encode_jpeg(shrink(f, self.short_side)) for f in frames]
            vectors = {"action": actions.reshape(steps, -1)}
            for key in self.layout.vectors:
                if key != "action":
                    rows = read_rows(demo, hdf5_path(key), where)
                    vectors[key] = rows.reshape(len(rows), -1)
            rewards = np.asarray(demo["rewards"]) if "rewards" in demo else None
            dones = np.asarray(demo["dones"]) if "dones" in demo else None
        yield Episode(
            origin=f"{self.path.name}/data/{name}",
            images=images,
            vectors=vectors,
            instructions=[self.text] * steps,
            rewards=rewards,
            success=succeeded(rewards, dones),
        )

    def open(self) -> Any:
        return _open_file(self.path)

    def _read_layout(
        self, demo: Any, wanted: tuple[str, ...]
    ) -> tuple[Layout, tuple[str, ...], str, dict[str, tuple[int, ...]]]:
        """(fields, cameras, the ending of their fields' names, unsupported images with their shapes: those with other
        names, and depth images)."""
        where = f"{self.path}: {demo.name.lstrip('/')}"
        obs = {k: v for k, v in demo.get("obs", {}).items() if hasattr(v, "dtype")}  # robomimic writes no groups here
        pictures = [k for k, array in obs.items() if holds_images(array)]
        ending = "_image" if any(k.endswith("_image") for k in pictures) else ""  # none in LIBERO's: agentview_rgb
        available = sorted(k.removesuffix(ending) for k in pictures if k.endswith(ending))
        if not available:
            raise DataError(
                f"{where}/obs has no *_image nor other uint8 images [N, H, W, 3] (it holds {', '.join(sorted(obs)) or 'nothing'}): "
                "it is a low-dimensional or raw file. Download the image file of the task, or render images from its "
                "states with robomimic's dataset_states_to_obs.py --camera_names agentview robot0_eye_in_hand."
            )
        cameras = choose(wanted, available, "camera", where)
        if "actions" not in demo:
            raise DataError(f"{where} has no 'actions'; this is not a robomimic file.")
        vectors = {"action": int(np.prod(demo["actions"].shape[1:]))}
        for key in sorted(obs):
            if np.dtype(obs[key].dtype).kind in "fiub" and obs[key].ndim <= 2:
                vectors[f"observation/{key}"] = int(np.prod(obs[key].shape[1:]))
        states = demo.get("states")  # a group in other programs' files
        if getattr(states, "ndim", 0) == 2 and states.shape[1]:
            if SIM_STATE in vectors:
                raise _same_name(where, "states", "obs/sim_state", SIM_STATE)
            vectors[SIM_STATE] = int(states.shape[1])
        images = {f"observation/{c}": image_field(None, None) for c in cameras}
        if both := sorted(images.keys() & vectors.keys()):
            raise _same_name(where, hdf5_path(both[0]) + ending, hdf5_path(both[0]), both[0])
        used = {camera + ending for camera in available}
        others = sorted(key for key in obs if obs[key].ndim >= 3 and key not in used)
        unsupported_images = {f"observation/{key}": tuple(map(int, obs[key].shape[1:])) for key in others}
        return Layout(images, vectors, "rewards" in demo or "dones" in demo), cameras, ending, unsupported_images


def read_environment(path: Path) -> tuple[str, float | None]:
    """(task, Hz or None), without reading the demonstrations. Raises DataError for a file of another kind."""
    with _open_file(path) as file, damage_as(str(path), DataError):
        return _environment(path, file)


def read_totals(path: Path, split: str) -> tuple[int, int | None]:
    """(number of demonstrations in `split`, their total steps or None), without reading them. Raises DataError for a
    file of another kind, ConfigError for an unknown mask."""
    with _open_file(path) as file, damage_as(str(path), DataError):
        whole = split == "train"
        steps = file["data"].attrs.get("total") if whole else None
        return len(_demonstrations(path, file, None if whole else split)), None if steps is None else int(steps)


def _environment(path: Path, file: Any) -> tuple[str, float | None]:
    if "data" not in file:
        raise DataError(f"{path}: no group 'data'; this is not a robomimic file.")
    args = _read_attribute(path, file, "env_args")
    return str(args.get("env_name", "robomimic")), _control_rate(path, args)


def _open_file(path: Path) -> Any:
    h5py = require_module("h5py")

    def opened() -> Any:
        try:
            return h5py.File(path, "r")
        except OSError as error:
            if is_io_error(error):
                raise  # to be tried again
            raise DataError(f"{path}: not a readable HDF5 file ({error}). Download it again.") from error

    return retry(path, opened)


@contextmanager
def damage_as(where: str, kind: type[DataError] = UnitError) -> Iterator[None]:
    """Raises `DAMAGE_ERRORS` of the block as `kind`, and errors of a failing disk as UnreachableError. Use it only for
    blocks that read the file: other errors would be taken for damage."""
    try:
        yield
    except (DataError, ConfigError):
        raise
    except DAMAGE_ERRORS as error:
        if is_io_error(error):
            raise UnreachableError(f"{where} cannot be read ({error}). Run the same command again.") from error
        advice = ADVICE if kind is UnitError else "Download the file again."
        raise kind(f"{where} is damaged ({error}). {advice}") from error


def holds_images(array: Any) -> bool:
    """Whether it is uint8 [N, H, W, 3]."""
    return array.dtype == np.uint8 and array.ndim == 4 and array.shape[3] == 3


def read_rows(demo: Any, key: str, where: str, rows: slice = slice(None)) -> np.ndarray:
    """Rows of a dataset of a demonstration. Raises UnitError, UnreachableError for a failing disk."""

    def read() -> np.ndarray:
        try:
            return np.asarray(demo[key][rows])
        except DAMAGE_ERRORS as error:
            if is_io_error(error):
                raise  # to be tried again
            raise UnitError(f"{where}/{key} cannot be read ({error}). {ADVICE}") from error

    return retry(Path(demo.file.filename), read)


def succeeded(rewards: np.ndarray | None, dones: np.ndarray | None) -> bool | None:
    """Whether a demonstration reached its goal; None if the file does not say.

    By its rewards if it has them: `dones` also marks the end of a failed demonstration if the file was extracted with
    `--done_mode 1` or 2.
    """
    if rewards is not None:
        return bool(np.max(rewards, initial=0) >= SUCCESS_REWARD)
    return None if dones is None else bool(np.max(dones, initial=0) > 0)


def hdf5_path(key: str) -> str:
    return "states" if key == SIM_STATE else f"obs/{key.removeprefix('observation/')}"


def _same_name(where: str, one: str, other: str, name: str) -> DataError:
    """The error for two fields of which one would hide the other."""
    return DataError(
        f"{where}: {quote(one)} and {quote(other)} would both be called {name!r}. Rename one of them in a copy of the "
        "file (h5py: move(OLD, NEW)), in every demonstration."
    )


def _instruction(path: Path, file: Any) -> str:
    """What the demonstrations do, in words, as LIBERO's files say it; "" if the file does not. Their `env_name` is the
    scene, which many tasks share."""
    text = _read_attribute(path, file, "problem_info").get("language_instruction")
    return text.strip('" ') if isinstance(text, str) else ""


def _read_attribute(path: Path, file: Any, name: str) -> dict[str, Any]:
    """The JSON object in an attribute of `data`; empty if there is none."""
    text = file["data"].attrs.get(name)
    if text is None:
        return {}
    try:
        values = json.loads(text)
    except (ValueError, TypeError) as error:  # the latter for an attribute that is not text
        message = f"{path}: the attribute {name} of 'data' is not JSON ({error}). Download the file again."
        raise DataError(message) from error
    return values if isinstance(values, dict) else {}


def _control_rate(path: Path, args: dict[str, Any]) -> float | None:
    """Hz, as `env_args` says; None if it does not say. Raises DataError for a value that is not a rate."""
    kwargs = args.get("env_kwargs")
    rate = kwargs.get("control_freq") if isinstance(kwargs, dict) else None
    if rate is None:
        return None
    if type(rate) not in (int, float) or not 0 < rate < math.inf:
        raise DataError(
            f"{path}: the attribute env_args of 'data' says control_freq {quote(rate)}, which is not a rate in Hz. "
            "Correct it."
        )
    return float(rate)


def _demonstrations(path: Path, file: Any, filter_key: str | None) -> dict[str, str]:
    """Names in the order of their numbers, each with the mask among `filter_key` that contains it, or ""."""
    numbered = re.compile(r"demo_\d+").fullmatch
    names = [name for name in file["data"] if numbered(name)]
    others = [] if filter_key else [name for name in file["data"] if not numbered(name)]
    if unread := next((name for name in others if f"{name}/actions" in file["data"]), None):
        raise DataError(
            f"{path}: data/{quote(unread)} has actions, but is not called demo_<number>, so it would not be read. Rename it "
            "in a copy of the file (h5py: move(OLD, NEW)), or choose demonstrations by a mask."
        )
    if not names:
        raise DataError(f"{path}: no demonstration 'data/demo_*' in it.")
    wanted = [] if filter_key is None else filter_key.split("+")
    of = {} if wanted else dict.fromkeys(names, "")
    masks = sorted(file["mask"]) if wanted and "mask" in file else []
    for mask in wanted:
        if mask not in masks:
            raise ConfigError(f"{path}: no mask {mask!r}; it has {', '.join(masks) or 'none'}.{of_a_part(mask)}")
        chosen = [n.decode() if isinstance(n, bytes) else str(n) for n in file["mask"][mask][()]]
        missing = sorted(set(chosen) - set(names))
        if missing:
            raise DataError(f"{path}: mask/{mask} names {missing[0]!r}, which 'data' does not have.")
        if not chosen:
            raise DataError(f"{path}: mask/{mask} names no demonstration.")
        for name in chosen:
            if (other := of.setdefault(name, mask)) != mask:
                raise DataError(
                    f"{path}: mask/{other} and mask/{mask} both name {name!r}. Choose masks that share none."
                )
        for name, following in pairwise(sorted(chosen)):
            if name == following:
                raise DataError(f"{path}: mask/{mask} names {name!r} twice. Correct the mask.")
    return dict(sorted(of.items(), key=lambda item: int(item[0].removeprefix("demo_"))))
