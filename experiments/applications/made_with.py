"""What the results in a directory were made with: none is taken for one of other settings or of another model."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hma_jax.config import require
from hma_jax.config.json import diff, to_dict
from hma_jax.model.params import Params
from hma_jax.runtime.files import write_file
from hma_jax.simulator.simulator import Simulator

FILE = "settings.json"
SIMULATOR = "simulator"
"""What of a simulator is not in its weights."""


def claim(
    out: Path,
    run: Path,
    simulator: Simulator,
    settings: Mapping[str, Any],
    *,
    grows: Collection[str] = (),
    unused: Collection[str] = (),
    file: str = FILE,
) -> None:
    """Makes `out` the directory of what the `simulator` of `run` gives with `settings`. To be called when both are
    known to be good. Fields that `grows` names say how many results there are, those that `unused` names (and what is
    under them) had no part in any: with others of these, results that are kept stay what they are.

    Raises ConfigError, naming the differences, where `out` holds what was made otherwise, and where its file is of a
    time when it did not yet say how frames are filled.
    """
    path, said = out / file, described(run, simulator, settings)
    if path.exists():
        known = json.loads(path.read_text())
        comparable = said if SIMULATOR in known else {name: x for name, x in said.items() if name != SIMULATOR}
        free = tuple(f"{name}{end}" for name in (*grows, *unused) for end in ":.")
        differences = [line for line in diff(known, comparable) if not line.startswith(free)]
        require(
            not differences,
            f"{out} holds results of other settings ({'; '.join(differences)}); choose another --out or remove it",
        )
        require(
            SIMULATOR in known,
            f"{path} does not say how frames were filled and what the robots' ranges were: choose another --out, or "
            "remove that file if you know that nothing of this has changed",
        )
        return
    write_settings(out, run, simulator, settings, file)


def write_settings(out: Path, run: Path, simulator: Simulator, settings: Mapping[str, Any], file: str = FILE) -> None:
    """Where more results have been added."""
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / file, json.dumps(described(run, simulator, settings), indent=1) + "\n")


def described(run: Path, simulator: Simulator, settings: Mapping[str, Any]) -> dict[str, Any]:
    """As it is read again. Runs of one name are told from each other by their weights, robots of one name by a hash of
    all that is known of them."""
    robots = {name: short_hash(json.dumps(to_dict(robot)).encode()) for name, robot in sorted(simulator.robots.items())}
    besides = {"decode": to_dict(simulator.decode), "robots": robots}
    said = {"run": run.resolve().name, "weights": hash_of(simulator.model.params), SIMULATOR: besides, **settings}
    return json.loads(json.dumps(said))


def short_hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def hash_of(params: Params) -> str:
    """Of every parameter's path, shape and bytes."""
    found = hashlib.sha256()
    for path, x in sorted((jax.tree_util.keystr(path), x) for path, x in jax.tree_util.tree_leaves_with_path(params)):
        array = np.asarray(x)
        found.update(f"{path} {array.dtype} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()[:16]
