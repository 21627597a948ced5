"""`hma tokenizer`: trains an image tokenizer, or makes one from published weights, your own code or pixel patches."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from experiments.cli.arguments import ReplaceOptions, StudyOptions
from experiments.preparing.made_from import Step
from experiments.study_setup import StudySetup, command, make_setup
from experiments.terminal.command_line import Commands
from experiments.terminal.progress import console, say, short, step, wrote
from experiments.terminal.words import counted
from hma_jax.config import PixelsConfig, require

if TYPE_CHECKING:
    from hma_jax.tokenizers.base import Tokenizer

tokenizer_app = Commands()

HELP = "Train an image tokenizer, import published weights, or make one from your own code or from pixel patches."


@tokenizer_app.command(name="train")
def tokenizer_train(arguments: StudyOptions, replacement: ReplaceOptions) -> None:
    """Train the study's image tokenizer on its datasets."""
    train_tokenizer(make_setup(arguments), replacement.replace)


@tokenizer_app.command(name="import")
def import_(
    source: Annotated[Positional[Path], arg(metavar="SOURCE")],
    out: Annotated[Path, arg(metavar="DIR")],
    image_size: Annotated[int, arg(name="image-size")] = 256,
    patch: int = 2,
    dtype: Literal["float32", "bfloat16"] = "float32",
    weights: Literal["last", "ema"] = "last",
) -> None:
    """Make a tokenizer from published weights: magvit2.ckpt, or the VAE of Stable Video Diffusion.

    Every tensor must be present, with the shape that the configuration requires; the discriminator's (loss.*) are left
    out. No code of a file is run. Give --tokenizer OUT to other commands.

    Args:
        source: magvit2.ckpt or a safetensors file of it (1X's, or an Open-MAGVIT2 without adaptive normalisation), or a
            directory of the diffusers library.
        out: Directory to write.
        image_size: Side of the square images in pixels: a multiple of 16.
        patch: VAE only: latent cells along the side of one token; released models take 2.
        dtype: Number format of the computation; bfloat16 is faster on accelerators, and the release used it.
        weights: MAGVIT2 only: last: the last weights, as the release takes them; ema: their moving average
            (model_ema.*), with which Open-MAGVIT2 makes its own tokens if it keeps one.
    """
    from hma_jax.convert import find_reader, has_average, read_svd_vae, require_free

    require_free(out)
    reader = find_reader(source)
    options = {"image_size": image_size, "compute_dtype": dtype}
    if reader is read_svd_vae:
        require(weights == "last", f"{source} is a VAE, which has no averaged weights; leave out --weights")
        options["patch"] = patch
    else:
        options["weights"] = weights
    with step(f"read {short(source)}"):
        tokenizer = reader(source, **options)
    if weights == "last" and has_average(source):
        say("note: averaged weights (model_ema.*) are left out, as the release does; --weights ema reads them instead")
    _write(tokenizer, out)


@tokenizer_app.command(name="pixels")
def pixels(
    out: Annotated[Path, arg(metavar="DIR")], image_size: Annotated[int, arg(name="image-size")] = 64, patch: int = 8
) -> None:
    """Make a tokenizer without a network: a token is a patch of pixels. For -continuous presets.

    Args:
        out: Directory to write.
        image_size: Side of the square images in pixels.
        patch: Side of a token in pixels.
    """
    from hma_jax.convert import require_free
    from hma_jax.tokenizers.pixels import PixelTokenizer

    require_free(out)
    _write(PixelTokenizer(PixelsConfig(image_size=image_size, patch=patch)), out)


@tokenizer_app.command(name="python")
def python(
    folder: Annotated[Positional[Path], arg(metavar="FOLDER")], out: Annotated[Path, arg(metavar="DIR")]
) -> None:
    """Make a tokenizer from your own Python code: a folder with tokenizer.py and, beside it, its weights.

    All files of the folder are copied. Every command that uses the tokenizer runs this code. Others who get the
    tokenizer, or a run or study that holds it, have to say that they trust it: `hma tokenizer trust`.

    Args:
        folder: Folder with tokenizer.py; docs/own_data.md, "Your own tokenizer", says what is in it.
        out: Directory to write.
    """
    from hma_jax.convert import require_free
    from hma_jax.tokenizers.python import PythonTokenizer, try_out

    require_free(out)
    tokenizer = PythonTokenizer(None, folder)
    with step(f"try {short(folder)}"):
        try_out(tokenizer)
    _write(tokenizer, out)


@tokenizer_app.command(name="trust")
def trust(directory: Annotated[Positional[Path], arg(metavar="DIR")]) -> None:
    """Let a tokenizer made from somebody else's Python code run here, in this and all later commands.

    One that `hma tokenizer python` made here needs this only for other users, or on machines with another home
    directory (HMA_CACHE_DIR). Read the code first: DIR/files.

    Args:
        directory: Directory of the tokenizer; that of a run is in its study's folder `tokenizer`.
    """
    from hma_jax.tokenizers.io import trust_tokenizer

    say(
        f"trusted: {trust_tokenizer(directory)}; the code of {short(directory)} runs from now on, as long as it is unchanged"
    )


def train_tokenizer(setup: StudySetup, replace: Step | None) -> None:
    from experiments.preparing.sources import find_sources
    from experiments.preparing.suite import make_suite
    from experiments.preparing.tokenizer import make_tokenizer

    study, workspace = setup.study, setup.workspace
    require(
        setup.tokenizer is None,
        "a tokenizer is given with --tokenizer, so none is trained; to use it: "
        f"{setup.command('tokenize')}; to train another, leave out --tokenizer",
    )
    with workspace.locked():
        sources = find_sources(study, setup.data) if setup.data else make_suite(study, workspace, replace)
        make_tokenizer(study, workspace, sources, replace)
    wrote(workspace.tokenizer, then=setup.command("tokenize"))


def _write(tokenizer: Tokenizer, out: Path) -> None:
    from hma_jax.convert.atomic import atomic_directory
    from hma_jax.tokenizers.io import save_tokenizer

    with atomic_directory(out) as temporary:
        save_tokenizer(tokenizer, temporary)
    if tokenizer.channels:
        what = f"latents of {tokenizer.channels} channels"
    else:
        what = f"ids of {counted(tokenizer.factors, 'factor')} with {tokenizer.factor_vocab:,} entries"
    side = tokenizer.image_size
    say(f"{tokenizer.kind} {tokenizer.identity}: {side} x {side} pixels to {tokenizer.tokens} tokens, {what}")
    preset = "cpu-continuous" if tokenizer.channels else "cpu"
    wrote(out, then=command("tokenize", "--preset", preset, "--tokenizer", out))
    console.print("this command uses the simulated suite; add --data DIR for your own data, --preset for another study")
