"""What `hma convert` does. Every command ends by saying what it wrote and what to run next."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.commands.study import wrote
from experiments.progress import console

if TYPE_CHECKING:
    from hma_jax.config import Weights
    from hma_jax.config.evaluation import SamplerKind
    from hma_jax.training.runs import Run


def from_official(checkpoint: Path, out: Path) -> None:
    from hma_jax.convert import read_official, require_free, write_run

    require_free(out)
    run = read_official(checkpoint)
    write_run(run, out)
    if run.model.conditioning == "cross_attention":
        console.print("note: cross-attention is computed here as the paper has it, by the release otherwise")
    _describe(run)
    wrote(out, then=f"hma convert to-safetensors {_quoted(out)} --out DIR (or to-stablehlo, to-official)")


def to_official(run: Path, out: Path, weights: Weights) -> None:
    from hma_jax.convert import loads_in_release, require_free, write_official
    from hma_jax.convert.official import read_config
    from hma_jax.training.runs import load_run

    require_free(out)
    loaded = load_run(run, weights)
    for remark in write_official(loaded, out):
        console.print(f"note: {remark}", markup=False, soft_wrap=True)
    _describe(loaded)
    again = f"hma convert from-official {_quoted(out)} --out RUN"
    if loads_in_release(read_config(out)):
        name = "STMAR" if loaded.model.diffusion else "STMaskGIT"
        again = f"load it in the official release with {name}.from_pretrained({str(out)!r}), or read it again: {again}"
    wrote(out, then=again)


def to_safetensors(run: Path, out: Path, weights: Weights) -> None:
    from hma_jax.convert import require_free, write_neutral
    from hma_jax.training.runs import load_run

    require_free(out)
    loaded = load_run(run, weights)
    write_neutral(loaded, out)
    _describe(loaded)
    back = f"hma convert from-safetensors {_quoted(out)} --out RUN"
    wrote(out, then=f"{_quoted(out / 'model.json')} explains the weights; back with {back}")


def from_safetensors(directory: Path, out: Path) -> None:
    from hma_jax.convert import read_neutral, require_free, write_run

    require_free(out)
    run = read_neutral(directory)
    write_run(run, out)
    _describe(run)
    wrote(out, then=f"hma evaluate {_quoted(out)} with the --preset and --out of its study")


def to_stablehlo(
    run: Path,
    out: Path,
    *,
    batch: int,
    prompt: int,
    frames: int,
    unmask_steps: int,
    temperature: float,
    sampler_steps: int,
    sampler: SamplerKind,
    platforms: tuple[str, ...],
    weights: Weights,
) -> None:
    from hma_jax.config import DecodeConfig, SamplerConfig
    from hma_jax.convert import ProgramConfig, require_free, write_stablehlo
    from hma_jax.training.runs import load_run

    require_free(out)
    latents = SamplerConfig(sampler, sampler_steps, temperature)
    decode = DecodeConfig(unmask_steps, temperature, sampler=latents)
    config = ProgramConfig(batch, prompt, frames, decode, tuple(platforms))
    loaded = load_run(run, weights)
    write_stablehlo(loaded, out, config)
    _describe(loaded)
    wrote(out, then=f"read {_quoted(out / 'model.json')} for the program's inputs and outputs")


def _describe(run: Run) -> None:
    from hma_jax.model.hma import declare_model

    variant = "continuous" if run.model.diffusion else "discrete"
    count = declare_model(run.model, run.table).count()
    console.print(
        f"{variant} model, width {run.model.width}, {run.model.layers} layers, {count:,} parameters, robots: "
        + ", ".join(run.table.names),
        markup=False,
        soft_wrap=True,
    )


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
