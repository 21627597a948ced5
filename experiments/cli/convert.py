"""`hma convert`: checkpoints to and from other formats."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from data_pipelines.registry import find_spec
from experiments.presets import get_preset
from experiments.terminal.command_line import Commands
from experiments.terminal.progress import say, wrote
from hma_jax.config import DecodeConfig, Dtype, Weights
from hma_jax.config.evaluation import SamplerKind

if TYPE_CHECKING:
    from hma_jax.training.runs import Run

convert_app = Commands()

HELP = (
    "Convert checkpoints to and from other formats. A RUN is the directory of a training run of this project. "
    "Existing files are never overwritten; an output is written completely or not at all."
)

Platform = Literal["cpu", "cuda", "rocm", "tpu"]
RunDirectory = Annotated[Positional[Path], arg(metavar="RUN")]
Directory = Annotated[Path, arg(metavar="DIR")]

RATES = "rates.toml"
NAMES_IN_RATES = """\
# Each entry is a robot of the model, under the name that its dataset has in its own files. For a dataset of that robot with
# another name, add to the entry: joins = ["DATASET"]

"""

THINNED = ("epic_kitchen",)
"""Datasets of which `hma data convert` keeps fewer frames than the release did. The release's strides therefore count
other frames."""

SWAPPED = ("ego4d",)
"""Datasets whose images the release trained on with red and blue swapped (reference section 5.5)."""

PLAIN = DecodeConfig()
"""How exported programs fill frames where decode.json leaves it open: as in evaluation, without noise."""


def _unless(usual: float | str) -> object:
    return arg(help_behavior_hint=f"(default: as in RUN/decode.json, or {usual})")


@convert_app.command(name="from-official")
def from_official(checkpoint: Annotated[Positional[Path], arg(metavar="CHECKPOINT")], out: Directory) -> None:
    """Make a run from a checkpoint of the official PyTorch release, discrete or continuous.

    Every tensor must be present, with the shape that config.json requires. PyTorch is not needed, and
    no code of the checkpoint is run. The run can be evaluated, fine-tuned (hma train --from), given new
    robots (hma adapt), and converted to other formats; it cannot be resumed. docs/checkpoints.md shows each.

    Args:
        checkpoint: Directory with config.json and model.safetensors (or pytorch_model.bin, model.bin; or several files
            with the index that names them).
        out: Directory of the run to write. Its rates.toml has the registry entries of its robots, as far as the
            registry knows them, with the frame rates that the model was trained at.
    """
    from hma_jax.convert import import_remarks, read_official, require_free, write_run

    require_free(out)
    run = read_official(checkpoint)
    rates, without = _rates(run)
    write_run(run, out, {RATES: rates})
    for note in (*without, *(f"note: {remark}" for remark in import_remarks(run))):
        say(note)
    _describe(run)
    study = _study_of(run, out / RATES)
    wrote(
        out,
        then=f"hma tokenize {study} && \\\n  hma evaluate {_quoted(out)} {study}\n"
        f"or: hma convert to-safetensors {_quoted(out)} --out DIR (or to-stablehlo, to-official)",
    )


@convert_app.command(name="to-official")
def to_official(run: RunDirectory, out: Directory, weights: Weights = "auto") -> None:
    """Write a run as a checkpoint that the official PyTorch release loads.

    The tensors of a run that came from the release and was not trained further are written back byte for byte. Any
    other run is written so that the release's from_pretrained loads it and computes the same. muP that the release
    does not support (continuous models of another width than 256, other attention scales) is folded into the
    weights, and a note says so. Models that the release cannot compute are refused; the error names the setting.

    Args:
        run: Directory of the training run.
        out: Directory to write: config.json and model.safetensors.
        weights: last: the last weights; ema: their moving average; auto: the average if there is one.
    """
    from hma_jax.convert import loads_in_release, require_free, write_official
    from hma_jax.convert.official import read_config
    from hma_jax.training.runs import load_run

    require_free(out)
    loaded = load_run(run, weights)
    for remark in write_official(loaded, out):
        say(f"note: {remark}")
    _describe(loaded)
    name = "STMAR" if loaded.model.diffusion else "STMaskGIT"
    loads = f"the official release loads it with {name}.from_pretrained({str(out)!r}); "
    back = f"`hma convert from-official {_quoted(out)} --out RUN` makes a run of it again"
    wrote(out, about=(loads if loads_in_release(read_config(out)) else "") + back)


@convert_app.command(name="to-safetensors")
def to_safetensors(run: RunDirectory, out: Directory, weights: Weights = "auto") -> None:
    """Write a run's weights for any framework, with a JSON description of every array.

    Args:
        run: Directory of the training run.
        out: Directory to write: model.json and model.safetensors.
        weights: last: the last weights; ema: their moving average; auto: the average if there is one.
    """
    from hma_jax.convert import require_free, write_neutral
    from hma_jax.training.runs import load_run

    require_free(out)
    loaded = load_run(run, weights)
    write_neutral(loaded, out)
    _describe(loaded)
    back = f"`hma convert from-safetensors {_quoted(out)} --out RUN` makes a run of them again"
    wrote(out, about=f"{out / 'model.json'} explains the weights; {back}")


@convert_app.command(name="from-safetensors")
def from_safetensors(directory: Annotated[Positional[Path], arg(metavar="DIR")], out: Directory) -> None:
    """Make a run from what to-safetensors wrote; the weights may have been changed since.

    Args:
        directory: Directory with model.json and model.safetensors.
        out: Directory of the run to write.
    """
    from hma_jax.convert import read_neutral, require_free, write_run

    require_free(out)
    run = read_neutral(directory)
    write_run(run, out)
    _describe(run)
    wrote(
        out,
        about=f"`hma evaluate {_quoted(out)} --preset PRESET --out OUT` evaluates it, with the preset and --out of its study",
    )


@convert_app.command(name="to-stablehlo")
def to_stablehlo(
    run: RunDirectory,
    out: Directory,
    batch: int = 1,
    prompt: Annotated[int | None, arg(help_behavior_hint="(default: 4, or all but the last)")] = None,
    frames: Annotated[int | None, arg(help_behavior_hint="(default: the model's window)")] = None,
    unmask_steps: Annotated[int | None, arg(name="unmask-steps"), _unless(PLAIN.unmask_steps)] = None,
    temperature: Annotated[float | None, _unless(PLAIN.temperature)] = None,
    sampler_steps: Annotated[int | None, arg(name="sampler-steps"), _unless(PLAIN.sampler.steps)] = None,
    sampler: Annotated[SamplerKind | None, _unless(PLAIN.sampler.kind)] = None,
    platforms: tuple[Platform, ...] = ("cpu", "cuda", "tpu"),
    dtype: Dtype = "float32",
    weights: Weights = "auto",
) -> None:
    """Export the generation of frames as a program that runs with JAX only, without this project.

    The program continues a batch of clips. model.json lists its inputs and outputs in order; the
    weights are in model.safetensors.

    Args:
        run: Directory of the training run.
        out: Directory to write: model.stablehlo, model.safetensors and model.json.
        batch: Clips at a time.
        prompt: Number of given frames.
        frames: Total number of frames; those after the prompt are generated. Past the model's window, the window slides
            as `slide` in RUN/decode.json says, by default exact.
        unmask_steps: Unmasking steps per generated frame.
        temperature: 0 takes the most likely tokens or latents, 1 samples from the model's distribution.
        sampler_steps: Steps of the diffusion sampler; no effect on discrete models.
        sampler: The diffusion sampler; dpm++ needs 8 to 12 steps.
        platforms: Platforms that the program can run on.
        dtype: Number format of the computation. In bfloat16 the program reads half the bytes of weights.
        weights: last: the last weights; ema: their moving average; auto: the average if there is one.
    """
    from hma_jax.convert import ProgramConfig, require_free, write_stablehlo
    from hma_jax.training.runs import load_run

    require_free(out)
    decode = _decode(run, temperature, unmask_steps, {"kind": sampler, "steps": sampler_steps})
    loaded = load_run(run, weights)
    frames = loaded.model.frames if frames is None else frames
    prompt = min(ProgramConfig.prompt, frames - 1) if prompt is None else prompt
    config = ProgramConfig(batch, prompt, frames, decode, tuple(platforms), dtype)
    write_stablehlo(loaded, out, config)
    _describe(loaded)
    wrote(out, about=f"{out / 'model.json'} lists the program's inputs and outputs")


def _decode(run: Path, temperature: float | None, unmask_steps: int | None, latents: dict[str, Any]) -> DecodeConfig:
    """How a run fills frames: as in its decode.json, or else `PLAIN`. Arguments that are not None, and values of
    `latents` (for the sampler) that are not None, replace those settings."""
    from hma_jax.simulator.folder import DECODE, change_decode, find_decode

    found = find_decode(run) if (run / DECODE).exists() else PLAIN
    sampler = replace(found.sampler, **{name: x for name, x in latents.items() if x is not None})
    return change_decode(found, temperature, unmask_steps=unmask_steps, sampler=sampler)


def _rates(run: Run) -> tuple[str, list[str]]:
    """(registry entries of the run's robots, at the rates that give their strides; notes on robots without an entry,
    and on those that need more than a rate)."""
    from data_pipelines.registry.toml_file import to_toml

    entries, unknown, other, thinned = [], [], [], []
    for robot in run.table.entries:
        spec = find_spec(robot.name)
        if spec is None:
            unknown.append(robot.name)
        elif spec.action_dim != robot.action_dim:
            other.append(f"{robot.name} ({robot.action_dim} values, {spec.action_dim} here)")
        elif robot.name in THINNED:
            thinned.append(robot.name)
        else:
            entries.append(to_toml(replace(spec, rate=spec.rate_for(robot.stride))))
    swapped = [
        f"note: {name}: the release trained on images with red and blue swapped; for the same, add image_corrections = "
        f'["swap_red_blue"] to its entry in {RATES}'
        for name in run.table.names
        if name in SWAPPED
    ]
    return NAMES_IN_RATES + "\n".join(entries), swapped + [
        f"note: not in {RATES}: {', '.join(names)}, {why}; to use one, write its entry (docs/own_data.md)"
        for names, why in (
            (unknown, "which the registry does not know"),
            (other, "whose actions differ from the registry's"),
            (
                thinned,
                "of whose frames `hma data convert` keeps fewer than the release, so that no rate gives its stride",
            ),
        )
        if names
    ]


def _study_of(run: Run, rates: Path) -> str:
    """The arguments of a study that evaluates a converted run; the user has to fill in some of them."""
    study = get_preset("cpu-continuous" if run.model.diffusion else "paper")
    words = f"--preset {study.name} --registry {_quoted(rates)} --tokenizer TOKENIZER --data DIR --out OUT"
    frames, prompt = run.model.frames, study.eval.prompt_frames
    words += f" --set model.frames={frames}" if frames != study.model.frames else ""
    return words + (f" --set eval.prompt_frames={frames // 2}" if prompt >= frames else "")


def _describe(run: Run) -> None:
    from hma_jax.model.hma import declare_model

    variant = "continuous" if run.model.diffusion else "discrete"
    count = declare_model(run.model, run.table).count()
    say(
        f"{variant} model, width {run.model.width}, {run.model.layers} layers, {count:,} parameters, "
        + (f"{'average' if run.weights == 'ema' else 'last'} weights of step {run.step:,}, " if run.step else "")
        + f"robots: {', '.join(run.table.names)}"
    )


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
