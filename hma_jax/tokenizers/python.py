"""Tokenizers from the user's own Python code: a folder with `tokenizer.py`, whose `make_tokenizer(folder)` returns one.

The returned object states what its tokens are, and encodes and decodes (docs/own_data.md). If it has `params`, it
computes in JAX and becomes a part of compiled programs. Otherwise it computes on the host, with NumPy or PyTorch say,
and compiled programs call it there. A change in any file of the folder makes it a different tokenizer.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import json
import logging
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.experimental.buffer_callback import Buffer, ExecutionContext, buffer_callback

from hma_jax.config import PythonConfig, require
from hma_jax.config.json import from_dict, identity_of
from hma_jax.model.params import Declared, Params, declare
from hma_jax.runtime.files import hash_file
from hma_jax.runtime.user_code import called_from_program, naming_line
from hma_jax.tokenizers.base import Tokenizer, fitting_piece, in_pieces

FILE, FUNCTION = "tokenizer.py", "make_tokenizer"
PAGE = 'docs/own_data.md, "Your own tokenizer"'
FACTS = ("image_size", "grid", "vocab_size", "factors", "channels")
"""The attributes with which an object describes its tokens: the fields of `PythonConfig`."""

NEIGHBOURS = 0.01
"""The share of tokens that may depend on the other images of a batch, because rounding can change an id that is close
to another one."""

GREY_LEVELS = 1.0
"""The mean difference that the number of decoded images may make to an image, because a network in bfloat16, say, then
sums in another order."""

log = logging.getLogger(__name__)


class PythonTokenizer(Tokenizer):
    """Tokens are what the code returns for an image: ids, int32 [B, S], or latents, float32 [B, S, C]."""

    kind = "python"
    config_class = PythonConfig

    def __init__(self, config: PythonConfig | None, folder: Path, *, piece: int | None = None):
        """Runs the code of `folder`. `config` is how it must describe its tokens; None: any description.

        Raises ConfigError if there is no such code, if it fails, or if its description is incomplete or wrong.
        """
        self.folder, self._file, self._lock = Path(folder), Path(folder) / FILE, threading.Lock()
        self._hash = hash_folder(self.folder)
        with naming_line(self._file, PAGE):
            self._own = own = _run(self.folder, self._hash)(self.folder)
            facts = {name: _plain(getattr(own, name)) for name in FACTS if hasattr(own, name)}
            missing = [name for name in ("encode", "decode") if not callable(getattr(own, name, None))]
            piece = _plain(getattr(own, "piece", None)) if piece is None else piece
        missing += [name for name in ("image_size", "grid") if name not in facts]
        require(not missing, f"{self._file}: what {FUNCTION} returns has no {', no '.join(missing)}; add it ({PAGE})")
        says = from_dict(PythonConfig, facts, f"{self._file}: what {FUNCTION} returns")
        require(
            config in (None, says),
            f"{self._file}: what {FUNCTION} returns says {says} here, but it said {config} when it was made a "
            "tokenizer; its facts must follow from the files of its folder alone",
        )
        piece = fitting_piece(says.image_shape) if piece is None else piece
        require(isinstance(piece, int), f"{self._file}: piece must be a whole number, not {piece!r} ({PAGE})")
        self._on_host = not hasattr(own, "params")
        if self._on_host:
            self._set_up(says, {}, piece, jax.local_devices()[:1])
            self._encode = lambda _, images: self._host_encode(images)
            self._decode = lambda _, tokens: self._host_decode(tokens)
        else:
            self._set_up(says, jax.tree.map(jnp.asarray, own.params), piece, jax.local_devices())
            decode = self._jit_over_devices(self.decode_fn)
            self._decode = lambda params, tokens: self._rounded(np.asarray(decode(params, tokens)), tokens)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), piece=self.piece), (self.config, self.folder)

    @classmethod
    def declare(cls, config: PythonConfig) -> Declared:
        del config
        return declare(nnx.Module)  # its parameters are not declared

    @cached_property
    def identity(self) -> str:
        return _identity(self.config, self._hash)

    def encode(self, images: np.ndarray) -> np.ndarray:
        """As `Tokenizer.encode`. Raises ConfigError if the code returns values that are not tokens."""
        tokens = super().encode(images)
        self._require_encoded(tokens)
        return tokens

    def encode_fn(self, params: Params, images: jax.Array) -> jax.Array:
        if self._on_host:
            described = jax.ShapeDtypeStruct(*self._tokens_of(len(images)))
            return _call_host(partial(in_pieces, self._host_encode, size=self.piece), described, images)
        with naming_line(self._file, PAGE):
            tokens = self._own.encode(params, images)
        return self._checked_encoding(tokens, len(images))

    def decode_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        if self._on_host:
            described = jax.ShapeDtypeStruct((len(tokens), *self.image_shape, 3), jnp.uint8)
            size = min(self.piece, len(tokens))  # a simulator decodes a frame or two at a time
            return _call_host(partial(in_pieces, self._host_decode, size=size), described, tokens).astype(jnp.float32)
        with naming_line(self._file, PAGE):
            images = self._own.decode(params, tokens)
        return jnp.clip(self._checked_images(images, len(tokens)).astype(jnp.float32), 0, 255)

    def decode_alone(self, tokens: np.ndarray) -> np.ndarray:
        """Tokens [S] or [S, C] of one image -> uint8 [H, W, 3]; not padded to a piece, as when a simulator decodes."""
        return np.asarray(self._decode(self._device_params, np.stack([tokens] * self._mesh.size)))[0]

    # --- On the host -------------------------------------------------------------------------

    def _host_encode(self, images: np.ndarray) -> np.ndarray:
        with self._lock, naming_line(self._file, PAGE):  # several devices may call at once
            tokens = np.asarray(self._own.encode(np.array(images)))
        tokens = self._checked_encoding(tokens, len(images))
        self._require_encoded(tokens)
        return tokens

    def _host_decode(self, tokens: np.ndarray) -> np.ndarray:
        with self._lock, naming_line(self._file, PAGE):
            images = np.asarray(self._own.decode(np.array(tokens)))
        return self._rounded(self._checked_images(images, len(tokens)), tokens)

    # --- What the code gives back ------------------------------------------------------------

    def _tokens_of(self, count: int) -> tuple[tuple[int, ...], type]:
        """(shape, type) of the tokens of `count` images."""
        if self.channels:
            return (count, self.tokens, self.channels), np.float32
        return (count, self.tokens), np.int32

    def _checked_encoding(self, tokens: Any, count: int) -> Any:
        shape, dtype = self._tokens_of(count)
        kinds, words = ("f", "float") if self.channels else ("iu", "integers")
        self._require_shape("encode", tokens, kinds, words, shape)
        return tokens.astype(dtype)

    def _require_encoded(self, tokens: np.ndarray) -> None:
        self.require_tokens(tokens, f"{self._file}: encode", f" ({PAGE})")

    def _rounded(self, images: np.ndarray, tokens: np.ndarray) -> np.ndarray:
        """Images as uint8. Raises ConfigError for images that are not finite, unless their tokens are not finite
        either: a model made those, and the caller reports them."""
        if images.dtype == np.uint8:
            return images
        wrong = ~np.isfinite(images).all((1, 2, 3)) & np.isfinite(tokens).reshape(len(tokens), -1).all(1)
        require(
            not wrong.any(),
            f"{self._file}: decode gives values that are not finite in {wrong.sum()} of {len(wrong)} images; floats must "
            f"be in 0..255 and numbers ({PAGE})",
        )
        with np.errstate(invalid="ignore"):
            return np.clip(np.rint(images), 0, 255).astype(np.uint8)

    def _checked_images(self, images: Any, count: int) -> Any:
        self._require_shape("decode", images, "uf", "uint8, or float in 0..255,", (count, *self.image_shape, 3))
        return images

    def _require_shape(self, what: str, got: Any, kinds: str, words: str, shape: tuple[int, ...]) -> None:
        dtype = jnp.dtype(got.dtype)
        fits = dtype.kind in kinds or ("f" in kinds and jnp.issubdtype(dtype, jnp.floating))  # bfloat16, say
        require(
            fits and tuple(got.shape) == shape,
            f"{self._file}: {what} must give {words} {list(shape)}, not {dtype} {list(got.shape)} ({PAGE})",
        )


def _call_host(
    function: Callable[[np.ndarray], np.ndarray], described: jax.ShapeDtypeStruct, x: jax.Array
) -> jax.Array:
    """`function(x)`, of the shape and type `described`, inside a compiled program.

    On CPUs `pure_callback` can wait for ever in a process with a single core, because it copies a large `x` on the
    thread that it blocks. A buffer is read in place.
    """

    def on_host(x: Any) -> np.ndarray:
        with called_from_program():
            return function(np.asarray(x))

    def in_place(_: ExecutionContext, out: Buffer, buffer: Buffer) -> None:
        np.asarray(out)[...] = on_host(buffer)

    def copied(x: jax.Array) -> jax.Array:
        return jax.pure_callback(on_host, described, x)

    return jax.lax.platform_dependent(x, cpu=buffer_callback(in_place, described), default=copied)


def try_out(tokenizer: PythonTokenizer) -> None:
    """Encodes and decodes a few images: noise, a black and a white one. Raises ConfigError for results whose shape,
    type or range is not as described, for decoded images that are all black, and if an image's tokens, or the image
    decoded from them, depend on the images beside it."""
    file, images = tokenizer.folder / FILE, np.zeros((5, *tokenizer.image_shape, 3), np.uint8)
    images[:3] = np.random.default_rng(0).integers(0, 256, images[:3].shape, np.uint8)
    images[4] = 255
    together, alone = tokenizer.encode(images), tokenizer.encode(images[1:2])
    other = (np.abs(together[1:2] - alone.astype(np.float64)) > 1e-2 * np.abs(alone)).mean()
    require(
        other <= NEIGHBOURS,
        f"{file}: an image encoded beside others has different tokens ({other:.0%} of them) than alone; encode must "
        "be deterministic, and normalise nothing over a batch (PyTorch: call eval() on the network)",
    )
    decoded = tokenizer.decode(together)
    require(
        decoded.max() > 1,
        f"{file}: decode turns noise into black images; floats must be in 0..255 (not in 0..1 or -1..1) ({PAGE})",
    )
    apart = np.abs(decoded[1].astype(np.float64) - tokenizer.decode_alone(together[1])).mean()
    require(
        apart <= GREY_LEVELS,
        f"{file}: an image decoded beside others differs (by {apart:.1f} grey levels) from the same one decoded alone; "
        "decode must be deterministic, and normalise nothing over a batch (PyTorch: call eval() on the network)",
    )


def _plain(value: Any) -> Any:
    """A NumPy number, such as `np.prod(levels)`, as a Python number; other values unchanged."""
    return value.item() if isinstance(value, np.generic) else value


def folder_identity(config: PythonConfig, folder: Path) -> str:
    """The identity of a tokenizer with these files that describes itself as `config`; its code is not run."""
    return _identity(config, hash_folder(folder))


def _identity(config: PythonConfig, files: str) -> str:
    named = [PythonTokenizer.kind, identity_of(config), files]
    return hashlib.sha256(json.dumps(named, sort_keys=True).encode()).hexdigest()[:16]


def hash_folder(folder: Path) -> str:
    """A hash of the names and bytes of all files of a tokenizer's folder. Raises ConfigError if it has no
    tokenizer.py."""
    digest = hashlib.sha256()
    for name in _files(folder):
        digest.update(f"{name}\n{hash_file(folder / name)}\n".encode())
    return digest.hexdigest()


def copy_folder(folder: Path, to: Path) -> None:
    """Copies all files of a tokenizer's folder to `to`, replacing what is there."""
    if to.resolve() == folder.resolve():
        return
    shutil.rmtree(to, ignore_errors=True)
    for name in _files(folder):
        (to / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(folder / name, to / name)


def _files(folder: Path) -> list[str]:
    """The paths, within a folder, of its files, without hidden ones and Python's bytecode."""
    require(
        (folder / FILE).is_file(),
        f"{folder / FILE}: no such file; a tokenizer of your own is a folder with {FILE}, which has a function "
        f"{FUNCTION}(folder) ({PAGE})",
    )
    found = []
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        if any(part.startswith(".") or part == "__pycache__" for part in name.parts):
            continue
        require(
            not (path.is_symlink() and path.is_dir()),
            f"{path} is a link to a folder, whose files would not be copied; put the files themselves there",
        )
        if path.is_file():
            found.append(name.as_posix())
    return sorted(found)


def _run(folder: Path, files: str) -> Any:
    """`make_tokenizer` from tokenizer.py, which is run as a package of its own. It can import other files of the
    folder, as in `from .network import Network`, and these are not confused with those of another tokenizer."""
    path, name = folder / FILE, f"own_tokenizer_{files[:16]}"
    _say(path)
    for known in [known for known in sys.modules if known == name or known.startswith(name + ".")]:
        del sys.modules[known]
    spec = importlib.util.spec_from_file_location(name, path, submodule_search_locations=[str(folder)])
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    with _no_bytecode():
        exec(compile(path.read_bytes(), path, "exec"), vars(module))
    found = vars(module).get(FUNCTION)
    require(callable(found), f"{path}: has no function {FUNCTION}(folder) ({PAGE})")
    return found


@functools.cache
def _say(path: Path) -> None:
    log.warning("the tokenizer runs the Python code of %s", path)


@contextmanager
def _no_bytecode() -> Iterator[None]:
    """Prevents Python from writing bytecode into the folder."""
    before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        yield
    finally:
        sys.dont_write_bytecode = before
