"""What `hma tokenizer import` and `hma tokenizer pixels` do."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from experiments.commands.study import wrote
from experiments.progress import console, step
from experiments.setting import command, short

if TYPE_CHECKING:
    from hma_jax.tokenizers.shared import BaseTokenizer


def import_tokenizer(
    source: Path, out: Path, *, image_size: int, patch: int, dtype: Literal["float32", "bfloat16"]
) -> None:
    from hma_jax.convert import find_reader, read_svd_vae, require_free

    require_free(out)
    reader = find_reader(source)
    options = {"image_size": image_size, "compute_dtype": dtype}
    if reader is read_svd_vae:
        options["patch"] = patch
    with step(f"read {short(source)}"):
        tokenizer = reader(source, **options)
    _write(tokenizer, out)


def pixel_tokenizer(out: Path, *, image_size: int, patch: int) -> None:
    from hma_jax.config import PixelsConfig
    from hma_jax.convert import require_free
    from hma_jax.tokenizers.pixels import PixelTokenizer

    require_free(out)
    _write(PixelTokenizer(PixelsConfig(image_size=image_size, patch=patch)), out)


def _write(tokenizer: BaseTokenizer, out: Path) -> None:
    from hma_jax.convert.aside import written_aside
    from hma_jax.tokenizers.io import save_tokenizer

    with written_aside(out) as aside:
        save_tokenizer(tokenizer, aside)
    if tokenizer.channels:
        what = f"latents of {tokenizer.channels} channels"
    else:
        what = f"ids of {tokenizer.factors} factors with {tokenizer.factor_vocab} entries"
    side = tokenizer.image_size
    console.print(
        f"{tokenizer.kind} {tokenizer.identity}: {side} x {side} pixels to {tokenizer.tokens} tokens, {what}",
        soft_wrap=True,
    )
    preset = "cpu-continuous" if tokenizer.channels else "cpu"
    wrote(out, then=command("tokenize", "--preset", preset, "--tokenizer", out))
    console.print("that takes the simulated suite; with --data DIR ... your own, with --preset another study")
