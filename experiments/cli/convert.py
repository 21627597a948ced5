"""`hma convert`: arguments and help. What the commands do is in `commands.convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg
from tyro.extras import SubcommandApp

from experiments.commands import convert as commands
from hma_jax.config import Weights
from hma_jax.config.evaluation import SamplerKind

convert_app = SubcommandApp()

HELP = (
    "Checkpoints to and from other formats. A RUN is the directory of a training run of this project. "
    "Nothing that exists is overwritten, and an output appears whole or not at all."
)

Platform = Literal["cpu", "cuda", "rocm", "tpu"]


@convert_app.command(name="from-official")
def from_official(checkpoint: Positional[Path], out: Path) -> None:
    """Make a run of a checkpoint of the official PyTorch release, discrete or continuous.

    Every tensor must be there, with the shape that config.json asks for. PyTorch is not needed, and
    no code of the checkpoint is run. The run can be evaluated, trained on, and converted further.

    Args:
        checkpoint: Directory with config.json and model.safetensors (or pytorch_model.bin, model.bin).
        out: The run to write.
    """
    commands.from_official(checkpoint, out)


@convert_app.command(name="to-official")
def to_official(run: Positional[Path], out: Path, weights: Weights = "auto") -> None:
    """Write a run as a checkpoint that the official PyTorch release loads.

    What came from the release and was not trained since goes back byte for byte. Anything else is
    written so that the release's from_pretrained loads it and computes the same: muP that the release
    cannot hold (continuous models of another width than 256, other attention scales) is folded into the
    weights, which a note says. Models that it cannot compute are refused by the field that it lacks.

    Args:
        run: Directory of the training run.
        out: Directory to write: config.json and model.safetensors.
        weights: The last weights, their moving average, or the average where there is one.
    """
    commands.to_official(run, out, weights)


@convert_app.command(name="to-safetensors")
def to_safetensors(run: Positional[Path], out: Path, weights: Weights = "auto") -> None:
    """Write a run's weights for any framework, with a JSON description of every array.

    Args:
        run: Directory of the training run.
        out: Directory to write: model.json and model.safetensors.
        weights: The last weights, their moving average, or the average where there is one.
    """
    commands.to_safetensors(run, out, weights)


@convert_app.command(name="from-safetensors")
def from_safetensors(directory: Positional[Path], out: Path) -> None:
    """Make a run of what to-safetensors wrote, perhaps with weights changed in between.

    Args:
        directory: Directory with model.json and model.safetensors.
        out: The run to write.
    """
    commands.from_safetensors(directory, out)


@convert_app.command(name="to-stablehlo")
def to_stablehlo(
    run: Positional[Path],
    out: Path,
    batch: int = 1,
    prompt: int = 4,
    frames: int = 5,
    unmask_steps: Annotated[int, arg(name="unmask-steps")] = 2,
    temperature: float = 0.0,
    sampler_steps: Annotated[int, arg(name="sampler-steps")] = 100,
    sampler: SamplerKind = "ddpm",
    platforms: tuple[Platform, ...] = ("cpu", "cuda", "tpu"),
    weights: Weights = "auto",
) -> None:
    """Write generation as a program that runs with JAX alone, without this project.

    The program continues a batch of clips: model.json lists its inputs and outputs in order, the
    weights lie beside it.

    Args:
        run: Directory of the training run.
        out: Directory to write: model.stablehlo, model.safetensors and model.json.
        batch: Clips at a time.
        prompt: Frames that are given.
        frames: Frames in all; those after the prompt are generated.
        unmask_steps: Passes over each new frame.
        temperature: 0 takes what is most likely, 1 draws as the model says.
        sampler_steps: Steps of the diffusion sampler; of no effect on discrete models.
        sampler: The diffusion sampler; dpm++ needs 10 to 12 steps.
        platforms: Where the program can run.
        weights: The last weights, their moving average, or the average where there is one.
    """
    commands.to_stablehlo(
        run,
        out,
        batch=batch,
        prompt=prompt,
        frames=frames,
        unmask_steps=unmask_steps,
        temperature=temperature,
        sampler_steps=sampler_steps,
        sampler=sampler,
        platforms=platforms,
        weights=weights,
    )
