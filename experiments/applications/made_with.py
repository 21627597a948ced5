"""What the results in a directory were made with: none is taken for one of other settings or of another model."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from data_pipelines.publishing.files import write_file
from hma_jax.config import require
from hma_jax.config.json import diff
from hma_jax.model.params import Params

FILE = "settings.json"


def claim(
    out: Path,
    run: Path,
    params: Params,
    settings: Mapping[str, Any],
    *,
    grows: Collection[str] = (),
    file: str = FILE,
) -> None:
    """Makes `out` the directory of what the model of `run`, with these `params`, gives with `settings`. To be called
    when both are known to be good. Fields that `grows` names say how many results there are: with others of these,
    those that are kept stay what they are.

    Raises ConfigError, naming the differences, where `out` holds what was made otherwise.
    """
    path, said = out / file, described(run, params, settings)
    if path.exists():
        known = json.loads(path.read_text())
        differences = [line for line in diff(known, said) if line.split(":")[0] not in grows]
        require(
            not differences,
            f"{out} holds results of other settings ({'; '.join(differences)}); choose another --out or remove it",
        )
        return
    write_settings(out, run, params, settings, file)


def write_settings(out: Path, run: Path, params: Params, settings: Mapping[str, Any], file: str = FILE) -> None:
    """Where more results have been added."""
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / file, json.dumps(described(run, params, settings), indent=1) + "\n")


def described(run: Path, params: Params, settings: Mapping[str, Any]) -> dict[str, Any]:
    """As it is read again. Runs of one name are told from each other by their weights."""
    return json.loads(json.dumps({"run": run.resolve().name, "weights": hash_of(params), **settings}))


def hash_of(params: Params) -> str:
    """Of every parameter's path, shape and bytes."""
    found = hashlib.sha256()
    for path, x in sorted((jax.tree_util.keystr(path), x) for path, x in jax.tree_util.tree_leaves_with_path(params)):
        array = np.asarray(x)
        found.update(f"{path} {array.dtype} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()[:16]
