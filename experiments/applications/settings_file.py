"""The settings file of a directory of results, so that no result is taken for one of other settings or another
model."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.running.machine import describe_machine
from experiments.terminal.program import command_line
from hma_jax.config import require
from hma_jax.config.json import completed, diff, identity_of, to_dict
from hma_jax.model.params import Params
from hma_jax.runtime.files import append_line, read_json, write_file
from hma_jax.simulator.simulator import Simulator

FILE = "settings.json"
PROVENANCE = "provenance.jsonl"
"""File beside it with a line for every start of a command on this directory. Results may come from several starts."""

SIMULATOR = "simulator"
"""The field with what a simulator's results depend on besides its weights."""

SAMPLER = f"{SIMULATOR}.decode.sampler"
"""The field of how latents are sampled, on which no result of a model of token ids depends."""


def pin_settings(
    out: Path,
    run: Path,
    simulator: Simulator,
    *settings: Any,
    may_differ: Collection[str] = (),
    unused: Collection[str] = (),
    file: str = FILE,
) -> None:
    """Pins the directory `out` to the `simulator` of `run` and to `settings`, configurations or dicts with some:
    writes them to `file` there or, if it exists, checks that it says the same. To be called once all are known to be
    valid. For a field that was added later (`hma_jax.config.base.later`), a file without it stands for the value from
    before.

    Fields named in `may_differ` (how many results there are) and in `unused` (what no result depends on), and those
    under them, may differ. Raises ConfigError, naming the differences, if another field differs.
    """
    path, wanted = out / file, described(run, simulator, *settings)
    if path.exists():
        known = read_json(path, "copy it again from where it was made, or choose another --out")
        for part in ({SIMULATOR: {"decode": simulator.decode}}, *settings):
            known = completed(known, part)
        unused = unused if simulator.tokenizer.channels else (*unused, SAMPLER)
        free = tuple(f"{name}{end}" for name in (*may_differ, *unused) for end in ":.")
        differences = [line for line in diff(known, wanted) if not line.startswith(free)]
        require(
            not differences,
            f"{out} holds results made with other settings ({'; '.join(differences)}); choose another --out or remove "
            "it",
        )
    else:
        write_settings(out, run, simulator, *settings, file=file)
    began = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    start = {"began": began, "command": command_line(), "settings": file, **describe_machine(jax.devices())}
    append_line(out / PROVENANCE, json.dumps(start))


def write_settings(out: Path, run: Path, simulator: Simulator, *settings: Any, file: str = FILE) -> None:
    """Writes the file anew, for instance after results were added that `may_differ` allows."""
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / file, json.dumps(described(run, simulator, *settings), indent=1) + "\n")


def described(run: Path, simulator: Simulator, *settings: Any) -> dict[str, Any]:
    """The content of the file. Runs are identified by name and a hash of their weights, robots by name and a hash of
    their descriptions."""
    robots = {
        name: short_hash(json.dumps(identity_of(robot)).encode()) for name, robot in sorted(simulator.robots.items())
    }
    besides_weights = {"decode": to_dict(simulator.decode), "robots": robots}
    description = {
        "run": run.resolve().name,
        "weights": hash_of(simulator.model.params),
        SIMULATOR: besides_weights,
    }
    for part in settings:
        description |= to_dict(part)
    return json.loads(json.dumps(description))


def short_hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def hash_of(params: Params) -> str:
    """Hash of every parameter's path, shape and bytes."""
    found = hashlib.sha256()
    for path, x in sorted((jax.tree_util.keystr(path), x) for path, x in jax.tree_util.tree_leaves_with_path(params)):
        array = np.asarray(x)
        found.update(f"{path} {array.dtype} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()[:16]
