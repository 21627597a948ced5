"""Tokenizers on disk, of every kind: `tokenizer.json` and `weights.npz`, or `files/` with the user's own code.

The JSON holds kind, configuration, identity and numbers that were measured besides the weights, such as the scale of
latents. It is written last, so a directory holds a whole tokenizer or none.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from hma_jax.config import AnyTokenizerConfig, ConfigError, require
from hma_jax.config.json import diff, from_dict, to_dict
from hma_jax.model.params import Params, path_name
from hma_jax.runtime.arrays import UNREADABLE, write_arrays
from hma_jax.runtime.files import write_file
from hma_jax.runtime.user_code import require_trusted, trust
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.continuous import ContinuousTokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer
from hma_jax.tokenizers.pixels import PixelTokenizer
from hma_jax.tokenizers.pretrained import Magvit2Tokenizer, SvdVaeTokenizer
from hma_jax.tokenizers.python import PythonTokenizer, copy_folder, folder_identity

DESCRIPTION = "tokenizer.json"
WEIGHTS = "weights.npz"
FILES = "files"
"""The folder that holds the user's own code."""
KINDS: dict[str, type[Tokenizer]] = {
    cls.kind: cls
    for cls in (
        LfqTokenizer,
        ContinuousTokenizer,
        Magvit2Tokenizer,
        SvdVaeTokenizer,
        PixelTokenizer,
        PythonTokenizer,
    )
}
ADVICE = "train, make, import or copy the tokenizer again"


def save_tokenizer(tokenizer: Tokenizer, directory: str | Path) -> None:
    """Writes into `directory`, replacing a tokenizer that is there. Raises ConfigError if it cannot be written."""
    directory = Path(directory)
    description = {
        "kind": tokenizer.kind,
        "config": to_dict(tokenizer.config),
        "identity": tokenizer.identity,
        **{name: getattr(tokenizer, name) for name in tokenizer.measured},
    }
    arrays = {path_name(p): np.asarray(x) for p, x in jax.tree.leaves_with_path(tokenizer.params)}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        (directory / DESCRIPTION).unlink(missing_ok=True)
        if isinstance(tokenizer, PythonTokenizer):
            copy_folder(tokenizer.folder, directory / FILES)
            trust(tokenizer.identity)  # it has run already
        else:
            write_arrays(directory / WEIGHTS, arrays, compressed=False)
        write_file(directory / DESCRIPTION, json.dumps(description, indent=2, sort_keys=True) + "\n")
    except OSError as error:
        raise ConfigError(
            f"cannot write the tokenizer to {directory}: {error.strerror}; choose another directory"
        ) from error


def load_tokenizer(
    directory: str | Path,
    expect: AnyTokenizerConfig | None = None,
    *,
    piece: int | None = None,
) -> Tokenizer:
    """The tokenizer in `directory`. `piece` is explained in `Tokenizer`. The code of a tokenizer of kind "python" is
    run, if this user saved or trusted it (`trust_tokenizer`).

    Raises ConfigError if there is none, if a file is damaged, or if its configuration is not `expect` (when given); the
    error then names every field that differs.
    """
    directory = Path(directory)
    description = _read_description(directory)
    kind = KINDS[description["kind"]]
    config = _config(directory, description)
    if expect is not None and config != expect:
        raise ConfigError(
            f"the tokenizer at {directory} has another configuration; give another directory or "
            "change these fields:\n  " + "\n  ".join(diff(config, expect))
        )
    if kind is PythonTokenizer:
        files = directory / FILES
        # Before its code is run:
        _require_described(files, "folder", folder_identity(config, files), description)
        require_trusted(description["identity"], files, f"hma tokenizer trust {directory}")
        return PythonTokenizer(config, files, piece=piece)
    weights = _read_weights(directory)
    measured = {name: description[name] for name in kind.measured}
    try:
        tokenizer = kind(config, weights, **measured, piece=piece)
    except ConfigError as error:
        raise ConfigError(f"{directory}: {error}; {ADVICE}") from error
    _require_described(directory / WEIGHTS, "file", tokenizer.identity, description)
    return tokenizer


def trust_tokenizer(directory: Path) -> str:
    """Allows the Python code of a tokenizer to run for this user; returns its identity. Raises ConfigError for a
    tokenizer of another kind, and if its files are not those from which it was made."""
    description = _read_description(directory)
    require(
        KINDS[description["kind"]] is PythonTokenizer,
        f"{directory} is a tokenizer of the kind {description['kind']}, which runs no code of its own; use it as it is",
    )
    identity = folder_identity(_config(directory, description), directory / FILES)
    _require_described(directory / FILES, "folder", identity, description)
    trust(identity)
    return identity


def _require_described(path: Path, what: str, identity: str, description: dict[str, Any]) -> None:
    require(
        identity == description["identity"],
        f"{path} is not the {what} that {DESCRIPTION} describes (identity {identity}, expected {description['identity']}); "
        f"{ADVICE}",
    )


def load_config(directory: Path) -> AnyTokenizerConfig:
    """The configuration of the tokenizer in `directory`. Its weights are not read, and its code is not run.

    Raises ConfigError if there is none or its description is damaged.
    """
    return _config(Path(directory), _read_description(Path(directory)))


def read_identity(directory: Path) -> str:
    """The identity of the tokenizer in `directory`, as its description says. Otherwise as `load_config`."""
    return _read_description(Path(directory))["identity"]


def _config(directory: Path, description: dict[str, Any]) -> AnyTokenizerConfig:
    config_class = KINDS[description["kind"]].config_class
    return from_dict(config_class, description["config"], where=f"{directory / DESCRIPTION}: config")


def _read_description(directory: Path) -> dict[str, Any]:
    path = directory / DESCRIPTION
    try:
        description = json.loads(path.read_text())
    except FileNotFoundError:
        raise ConfigError(
            f"no tokenizer at {directory} ({DESCRIPTION} is missing); train one with `hma tokenizer train` or make "
            "one from published weights with `hma tokenizer import`"
        ) from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read ({error}); {ADVICE}") from error
    require(
        isinstance(description, dict),
        f"{path} cannot be read (not a JSON object); {ADVICE}",
    )
    missing = {"kind", "config", "identity"} - set(description)
    require(not missing, f"{path}: missing field(s) {', '.join(sorted(missing))}")
    kind = description["kind"]
    require(
        isinstance(kind, str) and kind in KINDS,
        f"{path}: unknown tokenizer kind {kind!r}; known: {', '.join(KINDS)}",
    )
    for name in KINDS[kind].measured:
        value = description.get(name)
        require(isinstance(value, float), f"{path}: {name} should be a number, got {value!r}; {ADVICE}")
    return description


def _read_weights(directory: Path) -> Params:
    path = directory / WEIGHTS
    try:
        with np.load(path, allow_pickle=False) as file:
            flat = {tuple(name.split("/")): jnp.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise ConfigError(f"{path} is missing; {ADVICE}") from None
    except UNREADABLE as error:
        raise ConfigError(f"{path} is damaged ({error}); {ADVICE}") from error
    return nnx.traversals.unflatten_mapping(flat)
