"""Tokenizers on disk: `tokenizer.json` and `weights.npz`.

The JSON holds kind, configuration, identity and, of a continuous one, the scale of its latents.
The JSON file is written last, so a directory holds a whole tokenizer or none.
"""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from hma_jax.config import ConfigError, TokenizerConfig, diff, from_dict, require, to_dict
from hma_jax.params import Params, path_name
from hma_jax.tokenizers.autoencoder import AutoencoderTokenizer
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.continuous import ContinuousTokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer

DESCRIPTION = "tokenizer.json"
WEIGHTS = "weights.npz"
SCALE = "latent_std"
KINDS = (LfqTokenizer.kind, ContinuousTokenizer.kind)
UNREADABLE = (OSError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile)
"""What numpy raises for a damaged archive: RuntimeError when a flipped bit claims encryption or an
unknown compression, EOFError for an empty file."""


def save_tokenizer(tokenizer: AutoencoderTokenizer, directory: Path) -> None:
    """Writes into `directory`, replacing a tokenizer that is there. Raises ConfigError if it cannot."""
    directory = Path(directory)
    description = {
        "kind": tokenizer.kind,
        "config": to_dict(tokenizer.config),
        "identity": tokenizer.identity,
    }
    if isinstance(tokenizer, ContinuousTokenizer):
        description[SCALE] = tokenizer.latent_std
    arrays = {path_name(p): np.asarray(x) for p, x in jax.tree.leaves_with_path(tokenizer.params)}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        (directory / DESCRIPTION).unlink(missing_ok=True)
        aside = directory / f"{WEIGHTS}.tmp"
        with open(aside, "wb") as file:
            np.savez(file, **arrays)
        os.replace(aside, directory / WEIGHTS)
        aside = directory / f"{DESCRIPTION}.tmp"
        aside.write_text(json.dumps(description, indent=2, sort_keys=True) + "\n")
        os.replace(aside, directory / DESCRIPTION)
    except OSError as error:
        raise ConfigError(
            f"cannot write the tokenizer to {directory}: {error.strerror}; choose another directory"
        ) from error


def load_tokenizer(directory: Path, expect: TokenizerConfig | None = None) -> Tokenizer:
    """The tokenizer in `directory`.

    Raises ConfigError if none is there, if a file is damaged, or if its configuration is not
    `expect` (when given), naming every field that differs.
    """
    directory = Path(directory)
    description = _read_description(directory)
    config = from_dict(TokenizerConfig, description["config"], where=f"{directory / DESCRIPTION}: config")
    if expect is not None and config != expect:
        raise ConfigError(
            f"the tokenizer at {directory} has another configuration; give another directory or "
            "change these fields:\n  " + "\n  ".join(diff(config, expect))
        )
    weights = _read_weights(directory)
    try:
        if description["kind"] == LfqTokenizer.kind:
            tokenizer: AutoencoderTokenizer = LfqTokenizer(config, weights)
        else:
            tokenizer = ContinuousTokenizer(config, weights, description[SCALE])
    except ConfigError as error:
        raise ConfigError(f"{directory}: {error}; train or copy the tokenizer again") from error
    require(
        tokenizer.identity == description["identity"],
        f"{directory / WEIGHTS} is not the file {DESCRIPTION} describes (identity "
        f"{tokenizer.identity}, expected {description['identity']}); train or copy the tokenizer again",
    )
    return tokenizer


def _read_description(directory: Path) -> dict[str, Any]:
    path = directory / DESCRIPTION
    try:
        description = json.loads(path.read_text())
    except FileNotFoundError:
        raise ConfigError(
            f"no tokenizer at {directory} ({DESCRIPTION} is missing); train one with `hma tokenizer train`"
        ) from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read ({error}); train or copy the tokenizer again") from error
    require(
        isinstance(description, dict),
        f"{path} cannot be read (not a JSON object); train or copy the tokenizer again",
    )
    missing = {"kind", "config", "identity"} - set(description)
    require(not missing, f"{path}: missing field(s) {', '.join(sorted(missing))}")
    kind, scale = description["kind"], description.get(SCALE)
    require(kind in KINDS, f"{path}: unknown tokenizer kind {kind!r}; known: {', '.join(KINDS)}")
    require(
        kind != ContinuousTokenizer.kind or isinstance(scale, float),
        f"{path}: {SCALE} should be a number, got {scale!r}; train or copy the tokenizer again",
    )
    return description


def _read_weights(directory: Path) -> Params:
    path = directory / WEIGHTS
    try:
        with np.load(path, allow_pickle=False) as file:
            flat = {tuple(name.split("/")): jnp.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise ConfigError(f"{path} is missing; train or copy the tokenizer again") from None
    except UNREADABLE as error:
        raise ConfigError(f"{path} is damaged ({error}); train or copy the tokenizer again") from error
    return nnx.traversals.unflatten_mapping(flat)
