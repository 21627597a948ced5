"""A model for other frameworks: arrays named by our parameter paths, and a JSON description of them.

model.safetensors   every parameter, float32
model.json          step, which weights (last or ema), configurations, robots and provenance; of every array its
                    shape, axes (the dimension letters; null where an axis has none) and muP role
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hma_jax.config import ConfigError, require
from hma_jax.config.base import require_choice
from hma_jax.config.json import to_plain_json
from hma_jax.convert.atomic import atomic_directory
from hma_jax.convert.run_directory import require_run
from hma_jax.convert.table import flat, nested
from hma_jax.convert.tensors import check_tensors, read_finite, read_safetensors, write_safetensors
from hma_jax.model.hma import declare_model
from hma_jax.model.params import ParamSpec
from hma_jax.training.runs import Run, describe_run, read_configs

FORMAT, VERSION = "hma-jax", 1
DESCRIPTION, WEIGHTS = "model.json", "model.safetensors"


def describe_tensors(leaves: Mapping[str, ParamSpec]) -> dict[str, dict[str, Any]]:
    return {
        path: {"shape": list(spec.shape), "axes": list(spec.axes), "role": spec.role} for path, spec in leaves.items()
    }


def write_neutral(run: Run, directory: Path) -> None:
    """Writes both files. Raises ConfigError if `directory` exists, and as `require_run`."""
    require_run(run)
    arrays = {path: np.asarray(x) for path, x in flat(run.params).items()}
    description = {
        "format": FORMAT,
        "version": VERSION,
        "step": run.step,
        "weights": run.weights,
        **describe_run(run.model, run.train, run.table, run.provenance),
        "tensors": describe_tensors(declare_model(run.model, run.table).leaves()),
    }
    with atomic_directory(directory) as temporary:
        (temporary / DESCRIPTION).write_text(to_plain_json(description))
        write_safetensors(temporary / WEIGHTS, arrays)


def read_neutral(directory: Path) -> Run:
    """Reads both files. Raises ConfigError, which names the field or tensors that do not fit."""
    directory = Path(directory)
    path = directory / DESCRIPTION
    try:
        description = json.loads(path.read_text())
    except OSError as error:
        raise ConfigError(f"no {path} ({error.strerror}); give a directory with {DESCRIPTION} and {WEIGHTS}") from error
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON: {error}") from error
    fields = {"format", "version", "step", "weights", "model", "train", "table", "provenance", "tensors"}
    found = set(description) if isinstance(description, dict) else set()
    require(
        found == fields and description["format"] == FORMAT,
        f"{path}: not a model description of this project: its fields are {', '.join(sorted(found)) or 'none'}, but "
        f"{', '.join(sorted(fields))} were expected",
    )
    require(
        description["version"] == VERSION,
        f"{path}: version {description['version']}, but this program reads version {VERSION}; read the file with the "
        "version of this project that wrote it",
    )
    step = description["step"]
    require(type(step) is int and step >= 0, f"{path}: step must be a number of steps, got {step!r}")
    for name in ("model", "train", "table", "tensors", "provenance"):
        kind = type(description[name]).__name__
        require(isinstance(description[name], dict), f"{path}: {name}: expected named fields, got {kind}")
    model, train, table = read_configs(description, str(path))
    which = description["weights"]
    require_choice(which, ("last", "ema"), f"{path}: weights")
    leaves = declare_model(model, table).leaves()
    want = describe_tensors(leaves)
    wrong = [
        name
        for name in want.keys() | description["tensors"].keys()
        if want.get(name) != description["tensors"].get(name)
    ]
    require(
        not wrong,
        f"{path}: tensors whose description does not match the model: {', '.join(sorted(wrong)[:10])}",
    )
    weights = directory / WEIGHTS
    require(weights.is_file(), f"{directory} has no {WEIGHTS}")
    tensors = read_safetensors(weights)
    check_tensors({name: spec.shape for name, spec in leaves.items()}, tensors, str(weights))
    arrays = {name: read_finite(tensors, name, str(weights)).astype(np.float32, copy=False) for name in tensors}
    return Run(model, train, table, nested(arrays), step, description["provenance"], which)
