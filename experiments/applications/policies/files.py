"""Policies on disk: `policy.json` says what it is, `weights.safetensors` holds its parameters."""

from __future__ import annotations

import json
import secrets
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file

from data_pipelines.publishing.files import publish, remove
from experiments.applications.policies.acting import ChunkPolicy, Scale
from experiments.applications.policies.kinds import KINDS
from hma_jax.config import ConfigError, require
from hma_jax.config.json import from_dict, to_dict
from hma_jax.convert.tensors import write_safetensors

DESCRIPTION, WEIGHTS = "policy.json", "weights.safetensors"


def save_policy(policy: ChunkPolicy, directory: Path | str, about: Mapping[str, Any] | None = None) -> None:
    """Replaces `directory`, completely or not at all. `about` is added to its description: robot, task, step, seed."""
    directory = Path(directory)
    making = directory.with_name(f".{directory.name}.{secrets.token_hex(4)}.tmp")
    making.mkdir(parents=True)
    try:
        description = {
            "kind": policy.kind,
            "config": to_dict(policy.config),
            "scale": to_dict(policy.scale),
            "about": dict(about or {}),
        }
        (making / DESCRIPTION).write_text(json.dumps(description, indent=1) + "\n")
        write_safetensors(making / WEIGHTS, named(policy.params))
        publish(making, directory)
    finally:
        remove(making)


def load_policy(directory: Path | str) -> ChunkPolicy:
    """Loads a policy. Raises ConfigError if there is none, or it is damaged."""
    directory = Path(directory)
    description, weights = read_network(directory / DESCRIPTION, directory / WEIGHTS, ("kind", "config", "scale"))
    name = description["kind"]
    require(name in KINDS, f"{directory}: unknown kind of policy {name!r}; known: {', '.join(KINDS)}")
    kind = KINDS[name]
    config = from_dict(kind.config, description["config"], f"{directory}: config")
    scale = from_dict(Scale, description["scale"], f"{directory}: scale")
    wanted = jax.eval_shape(lambda: kind.init(config, len(scale.mean), 0))
    return kind.policy(config, unnamed(weights, wanted, directory), scale)


def read_network(
    description: Path, weights: Path, fields: Collection[str]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What describes a network, which must have `fields`, and its weights. Raises ConfigError if they are damaged."""
    try:
        described, arrays = json.loads(description.read_text()), load_file(weights)
    except (OSError, ValueError, SafetensorError) as error:
        raise ConfigError(f"{description.parent} cannot be read ({error}); train it again") from error
    require(
        isinstance(described, dict) and described.keys() >= set(fields),
        f"{description} does not say all of {', '.join(fields)}; train it again",
    )
    return described, arrays


def named(params: Any) -> dict[str, np.ndarray]:
    """{path: array}."""
    return {jax.tree_util.keystr(path): np.asarray(x) for path, x in jax.tree.leaves_with_path(params)}


def unnamed(arrays: Mapping[str, np.ndarray], like: Any, where: Path) -> Any:
    """The tree of `like` with these arrays. Raises ConfigError if they are not the arrays that it has."""
    shapes = {jax.tree_util.keystr(path): x.shape for path, x in jax.tree.leaves_with_path(like)}
    found = {name: x.shape for name, x in arrays.items()}
    require(shapes == found, f"{where}: the weights do not fit the network in its description; train the policy again")
    return jax.tree.map_with_path(lambda path, _: jnp.asarray(arrays[jax.tree_util.keystr(path)]), like)
