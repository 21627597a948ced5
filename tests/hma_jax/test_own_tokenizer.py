"""Tokenizers of a user's own Python code: the one that docs/own_data.md shows, and others of JAX and with latents."""

from __future__ import annotations

import os
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from hma_jax.config import ConfigError, PixelsConfig, PythonConfig
from hma_jax.evaluation.images import decode_in_pieces
from hma_jax.runtime.user_code import raising_as_called
from hma_jax.tokenizers.io import load_config, load_tokenizer, save_tokenizer, trust_tokenizer
from hma_jax.tokenizers.pixels import PixelTokenizer
from hma_jax.tokenizers.python import PythonTokenizer, try_out
from tests.hma_jax.pretrained import noise

PAGE = Path(__file__).parents[2] / "docs" / "own_data.md"
(COLOURS,) = (x for x in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S) if "make_tokenizer" in x)

JAX = """
import numpy as np

from .network import halves


class Bright:
    image_size, grid, channels, piece = 8, 2, 3, 2

    def __init__(self, folder):
        self.params = {"gain": np.load(folder / "gain.npy")}

    def encode(self, params, images):
        return halves(images).reshape(-1, 4, 3) * params["gain"]

    def decode(self, params, tokens):
        return (tokens / params["gain"]).reshape(-1, 2, 2, 3).repeat(4, 1).repeat(4, 2)


make_tokenizer = Bright
"""
HOST = """
import numpy as np


class Bright:
    image_size, grid, channels = 8, 2, 3

    def encode(self, images):
        return np.float32(images.reshape(-1, 2, 4, 2, 4, 3).mean((2, 4)).reshape(-1, 4, 3) / 128)

    def decode(self, latents):
        return (latents * 128).reshape(-1, 2, 2, 3).repeat(4, 1).repeat(4, 2)


def make_tokenizer(folder):
    return Bright()
"""
NETWORK = """
def halves(images):
    return images.reshape(-1, 2, 4, 2, 4, 3).astype("float32").mean((2, 4))
"""


def write(folder: Path, code: str, **changes: str) -> Path:
    for old, new in changes.values():
        assert old in code
        code = code.replace(old, new)
    folder.mkdir(exist_ok=True)
    (folder / "tokenizer.py").write_text(code)
    return folder


@pytest.fixture
def colours(tmp_path) -> Path:
    return write(tmp_path / "colours", COLOURS)


@pytest.fixture
def bright(tmp_path) -> Path:
    folder = write(tmp_path / "bright", JAX)
    (folder / "network.py").write_text(NETWORK)
    np.save(folder / "gain.npy", np.float32(2**-7))
    return folder


def test_ids_of_the_code_on_the_page(colours):
    tokenizer = PythonTokenizer(None, colours, piece=2)
    try_out(tokenizer)
    assert tokenizer.config == PythonConfig(image_size=64, grid=8, vocab_size=1000)
    assert (tokenizer.tokens, tokenizer.factors, tokenizer.factor_vocab, tokenizer.channels) == (64, 1, 1000, 0)
    images = np.full((3, 64, 64, 3), (0, 128, 255), np.uint8)
    ids = tokenizer.encode(images)
    assert ids.dtype == np.int32 and ids.tolist() == [[950] * 64] * 3
    assert tokenizer.decode(ids)[2, 0, 0].tolist() == [12, 140, 243]


@pytest.mark.parametrize("kind", ["colours", "bright"])
def test_compiled_programs_encode_and_decode_as_the_host_does(kind, request):
    tokenizer = PythonTokenizer(None, request.getfixturevalue(kind))
    images = noise(5, tokenizer.image_size)
    tokens = tokenizer.encode(images)
    within = jax.jit(tokenizer.encode_fn)(tokenizer.params, images)
    assert within.dtype == tokens.dtype and np.allclose(within, tokens, rtol=1e-6)
    program = jax.jit(lambda params, tokens: decode_in_pieces(tokenizer.decode_uint8_fn, 2, params, tokens))
    assert np.array_equal(program(tokenizer.params, tokens), tokenizer.decode(tokens))


ONE_CORE = """
import os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import jax, numpy as np
from hma_jax.tokenizers.python import PythonTokenizer
tokenizer = PythonTokenizer(None, sys.argv[1])
images = np.zeros((704, 64, 64, 3), np.uint8)
jax.block_until_ready(jax.jit(lambda x: tokenizer.encode_fn({}, x + 1))(images))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes cannot be kept to one core here")
def test_on_a_single_core_images_come_to_the_host(colours):
    subprocess.run([sys.executable, "-c", ONE_CORE, str(colours)], check=True, timeout=120)


def test_a_simulator_decodes_no_more_frames_than_it_makes(tmp_path):
    code = COLOURS.replace("def decode(self, ids):", "def decode(self, ids):\n        assert len(ids) == 2")
    tokenizer = PythonTokenizer(None, write(tmp_path / "mine", code))
    jax.block_until_ready(jax.jit(tokenizer.decode_fn)({}, np.zeros((2, 64), np.int32)))


def test_a_copy_is_the_same_tokenizer(bright, tmp_path):
    tokenizer = PythonTokenizer(None, bright)
    save_tokenizer(tokenizer, tmp_path / "one")
    shutil.rmtree(bright)
    one = load_tokenizer(tmp_path / "one")
    save_tokenizer(one, tmp_path / "two")
    save_tokenizer(one, tmp_path / "one")  # over itself
    two = pickle.loads(pickle.dumps(load_tokenizer(tmp_path / "two", expect=tokenizer.config, piece=3)))
    assert tokenizer.identity == one.identity == two.identity and (one.piece, two.piece) == (2, 3)
    assert load_config(tmp_path / "two") == tokenizer.config
    images = noise(3, 8)
    assert np.array_equal(tokenizer.encode(images), two.encode(images))
    assert not list(tmp_path.rglob("__pycache__"))


@pytest.mark.parametrize("name", ["network.py", "gain.npy", "more.txt"])
def test_a_changed_file_is_another_tokenizer_and_is_not_run(bright, tmp_path, name):
    before = PythonTokenizer(None, bright)
    save_tokenizer(before, tmp_path / "saved")
    for folder in (bright, tmp_path / "saved" / "files"):
        with (folder / name).open("ab") as file:
            file.write(b"\n")
    assert PythonTokenizer(None, bright).identity != before.identity
    (tmp_path / "saved" / "files" / "tokenizer.py").write_text("raise SystemExit")
    with pytest.raises(ConfigError, match=r"saved/files is not the folder that tokenizer.json describes"):
        load_tokenizer(tmp_path / "saved")


def test_code_of_others_runs_only_where_it_is_trusted(bright, tmp_path, monkeypatch):
    tokenizer = PythonTokenizer(None, bright)
    save_tokenizer(tokenizer, tmp_path / "theirs")
    monkeypatch.setenv("HMA_CACHE_DIR", str(tmp_path / "another user"))
    with pytest.raises(
        ConfigError, match=r"theirs/files is Python code .* if you trust it: hma tokenizer trust .*theirs$"
    ):
        load_tokenizer(tmp_path / "theirs")
    assert trust_tokenizer(tmp_path / "theirs") == load_tokenizer(tmp_path / "theirs").identity == tokenizer.identity
    with (tmp_path / "theirs" / "files" / "network.py").open("a") as file:
        file.write("\n")
    with pytest.raises(ConfigError, match="theirs/files is not the folder that tokenizer.json describes"):
        trust_tokenizer(tmp_path / "theirs")
    save_tokenizer(PixelTokenizer(PixelsConfig(image_size=8, patch=4)), tmp_path / "pixels")
    with pytest.raises(ConfigError, match="of the kind pixels, which runs no code of its own"):
        trust_tokenizer(tmp_path / "pixels")


def test_two_folders_have_files_of_the_same_name(bright, tmp_path):
    other = shutil.copytree(bright, tmp_path / "other")
    (other / "network.py").write_text(NETWORK.replace(".mean((2, 4))", ".max((2, 4))"))
    first, second = PythonTokenizer(None, bright), PythonTokenizer(None, other)
    images = noise(2, 8)
    assert (second.encode(images) > first.encode(images)).all()


ANEW = "(self.__dict__.setdefault('calls', []).append(0) or 9 * len(self.calls))"
"""Another number in each call of a method."""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("def make_tokenizer", "def make", r"tokenizer.py: has no function make_tokenizer\(folder\)"),
        ("import numpy as np", "import nunpy as np", r"tokenizer.py, line 1: ModuleNotFoundError: No module named"),
        ("image_size, grid = 64, 8", "grid = 8", "returns has no image_size; add it"),
        ("def decode", "def decoded", "returns has no decode; add it"),
        ("vocab_size = LEVELS**3", "width = 3", "ids of a vocab_size of at least 2, or latents"),
        ("vocab_size = LEVELS**3", "vocab_size, factors = 1000, 2", "is not a whole number to the power of factors 2"),
        ("vocab_size = LEVELS**3", "vocab_size = 100", r"encode gives values from 111 to 555; tokens must be in \[0, 100"),
        (".reshape(len(images), 64)", "", r"encode must give integers \[64, 64\], not int64 \[64, 8, 8\]"),
        ("return colours.repeat(8, 1)", "return colours", r"decode must give uint8, .*\[64, 64, 64, 3\], not uint8 \[64, 8"),
        (".repeat(8, 2)", ".repeat(8, 2) / 255", "decode turns noise into black images; floats must be in 0..255"),
        (".repeat(8, 2)", ".repeat(8, 2) * np.r_[[1] * 63, [np.nan]][:, None]", "decode gives values that are not finite in 64"),
        (".repeat(8, 2)", ".repeat(8, 2) * np.where(ids < 999, 1, np.nan)[:, :1, None, None]", "not finite in 60 of 64"),
        (".repeat(8, 2)", ".repeat(8, 2) - ids.mean() / 20", r"decoded beside others differs \(by .* grey levels"),
        (".repeat(8, 2)", f".repeat(8, 2) + {ANEW}", "decode must be deterministic"),
        ("* LEVELS / 256", "* LEVELS / 255", r"encode gives values from 0 to 1110; tokens must be in \[0, 1000"),
        ("vocab_size = LEVELS**3", "vocab_size, piece = 1000, 8.0", "piece must be a whole number, not 8.0"),
        ("images.reshape", "(images / 2 + images.mean(0) / 2).reshape", "an image encoded beside others has different tokens .* than alone"),
        ("LEVELS / 256", "LEVELS / none", "line 14: NameError: name 'none' is not defined; correct the file"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path, old, new, message):
    code = COLOURS.replace("images.reshape", "np.clip(images, 30, 150).reshape") if "555" in message else COLOURS
    with pytest.raises(ConfigError, match=message):
        try_out(PythonTokenizer(None, write(tmp_path / "mine", code, it=(old, new))))


def test_numbers_of_numpy_are_facts_too(tmp_path):
    code = COLOURS.replace("LEVELS**3", "np.prod([LEVELS] * 3)").replace("= 64, 8", "= np.int32(64), np.int64(8)")
    assert PythonTokenizer(None, write(tmp_path / "mine", code)).config == PythonConfig(
        image_size=64, grid=8, vocab_size=1000
    )


def test_a_folder_without_code_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"mine/tokenizer.py: no such file; a tokenizer of your own is a folder with"):
        PythonTokenizer(None, tmp_path / "mine")


@pytest.mark.parametrize(
    ("code", "old", "new", "message"),
    [
        (COLOURS, "LEVELS / 256)", "LEVELS / 255)", r"encode gives values from 1110 to 1110; tokens must be in \[0, 1000"),
        (HOST, "np.float32(", "np.float32(np.inf * ", "encode gives values from inf to inf; tokens must be finite numbers"),
        (HOST, "(latents * 128)", "(latents * [128, 128, np.nan])", "decode gives values that are not finite in 1 of 1 im"),
        (HOST, "(latents * 128)", "(latents * wide)", "tokenizer.py, line 12: NameError: name 'wide' is not defined; cor"),
        (HOST, ".repeat(4, 2)", "", r"decode must give uint8, .*\[1, 8, 8, 3\], not float32 \[1, 8, 2, 3\]"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_compiled_program_is_named_as_on_the_host(tmp_path, code, old, new, message):
    """NaN became black pixels, and an id that is none went to the model."""
    tokenizer = PythonTokenizer(None, write(tmp_path / "mine", code, it=(old, new)))
    white = np.full((1, *tokenizer.image_shape, 3), 255, np.uint8)
    program = jax.jit(lambda images: tokenizer.decode_fn({}, tokenizer.encode_fn({}, images)))
    with pytest.raises(ConfigError, match=message), raising_as_called():
        jax.block_until_ready(program(white))


def test_latents_of_a_model_that_are_no_numbers_are_no_fault_of_the_decoder(tmp_path):
    """Whoever has them says that the model diverged."""
    tokenizer = PythonTokenizer(None, write(tmp_path / "mine", HOST))
    latents = np.stack([np.full((4, 3), 1, np.float32), np.full((4, 3), np.nan, np.float32)])
    assert np.asarray(jax.jit(tokenizer.decode_fn)({}, latents)).mean((1, 2, 3)).tolist() == [128, 0]


def test_latents_that_the_store_cannot_hold_are_refused(tmp_path, bright):
    """They were stored as infinite ones."""
    np.save(bright / "gain.npy", np.float32(1e5))
    for folder in (write(tmp_path / "mine", HOST, it=("/ 128", "* 1e5")), bright):
        with pytest.raises(
            ConfigError, match="encode gives values from .* to .*; tokens must be finite numbers within ±65,504"
        ):
            try_out(PythonTokenizer(None, folder))


def test_images_of_jax_code_must_be_numbers(bright):
    write(bright, JAX, it=('tokens / params["gain"]', 'tokens / params["gain"] * np.float32([1, 1, np.nan])'))
    with pytest.raises(ConfigError, match="decode gives values that are not finite in 2 of 2 images"):
        try_out(PythonTokenizer(None, bright))


def test_shapes_of_jax_code_are_checked(bright):
    write(bright, JAX, it=("reshape(-1, 4, 3)", "reshape(-1, 12)"))
    with pytest.raises(ConfigError, match=r"encode must give float \[2, 4, 3\], not float32 \[2, 12\]"):
        PythonTokenizer(None, bright).encode(noise(2, 8))


def test_factors_of_a_large_vocabulary():
    config = PythonConfig(vocab_size=2**18, factors=2)
    assert (config.factor_vocab, config.tokens) == (512, 256)
