"""`hma tokenizer`: arguments and help. What the commands do is in `commands.tokenizer`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg
from tyro.extras import SubcommandApp

from experiments.cli.how import Remake
from experiments.commands import study as study_commands
from experiments.commands import tokenizer as commands
from experiments.setting import Where, make_setting

tokenizer_app = SubcommandApp()

HELP = "The image tokenizer: trained here, made of published weights, or none."


@tokenizer_app.command(name="train")
def tokenizer_train(where: OmitArgPrefixes[Where], remake: OmitArgPrefixes[Remake]) -> None:
    """Train the study's image tokenizer on its datasets."""
    study_commands.train_tokenizer(make_setting(where), remake.replace)


@tokenizer_app.command(name="import")
def import_(
    source: Positional[Path],
    out: Path,
    image_size: Annotated[int, arg(name="image-size")] = 256,
    patch: int = 2,
    dtype: Literal["float32", "bfloat16"] = "float32",
) -> None:
    """Make a tokenizer of published weights: magvit2.ckpt, or the VAE of Stable Video Diffusion.

    Every tensor must be there, with the shape that the configuration asks for; those of a training run
    (loss.*, model_ema.*) are left out. No code of a file is run. Give --tokenizer OUT to other commands.

    Args:
        source: magvit2.ckpt or a safetensors file of it, or a directory of the diffusers library.
        out: Directory to write.
        image_size: Side of the square images in pixels: a multiple of 16.
        patch: Of the VAE: cells along the side of one token; 2 is what released models take.
        dtype: What the network computes in; bfloat16 is faster on accelerators and what the release used.
    """
    commands.import_tokenizer(source, out, image_size=image_size, patch=patch, dtype=dtype)


@tokenizer_app.command(name="pixels")
def pixels(
    out: Path, image_size: Annotated[int, arg(name="image-size")] = 64, patch: int = 8
) -> None:
    """Make the tokenizer that is none: a token is a patch of pixels. For -continuous presets.

    Args:
        out: Directory to write.
        image_size: Side of the square images in pixels.
        patch: Side of a token in pixels.
    """
    commands.pixel_tokenizer(out, image_size=image_size, patch=patch)
