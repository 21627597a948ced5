"""Question: how well does a tokenizer reconstruct the suite, and what moves in it?
Command: python -m experiments.suite.tokenizer RUN [--out FILE]
Cost: about half a minute of one core, after `hma tokenizer train --preset cpu --out RUN`.

Pairs of frames half a second apart, from the validation split of every robot in RUN/suite: PSNR of the later frame, and
of those of its pixels that changed noticeably.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import Positional, arg

from data_pipelines.registry import DatasetSpec, get_spec
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.images import fit_image
from experiments.analysis.explained_share import EXPLAINED
from experiments.suite import COMMITTED
from experiments.tables import write_table
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of
from hma_jax.tokenizers.io import load_tokenizer

OUT = EXPLAINED.with_name("tokenizer.csv")
PAIRS = 48
"""Per robot, spread evenly over its validation episodes."""

CHANGED = 12
"""A pixel counts as changed from this difference on, in grey levels of any channel."""


def frame_pairs(spec: DatasetSpec, directory: Path, size: int) -> np.ndarray:
    """uint8 [N, 2, size, size, 3]: an earlier frame and the next at the model's rate."""
    source, pairs = RldsDataset(directory, spec.val_split), []
    for i in range(len(source)):
        count = max(PAIRS // len(source), 1)

        def choose(steps: int, count: int = count) -> list[int]:
            starts = np.linspace(0, max(steps - 1 - spec.stride, 0), count).astype(int)
            return [int(min(t, steps - 1)) for start in starts for t in (start, start + spec.stride)]

        frames = [fit_image(f, size) for f in source.frames(i, spec.image_key, choose)]
        pairs.append(np.stack(frames).reshape(-1, 2, size, size, 3))
    return np.concatenate(pairs)


def quality(decoded: np.ndarray, pairs: np.ndarray) -> tuple[float, float, float]:
    """(mean PSNR of frames, PSNR of all changed pixels together, their share) of later frames decoded [N, H, W, 3]."""
    error = (decoded.astype(np.float64) - pairs[:, 1]) ** 2
    changed = np.abs(pairs[:, 1].astype(int) - pairs[:, 0]).max(-1) > CHANGED
    frames = 10 * np.log10(255**2 / np.maximum(error.mean((1, 2, 3)), 1e-6))
    return float(frames.mean()), float(10 * np.log10(255**2 / error[changed].mean())), float(changed.mean())


def measure_run(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    out: Annotated[Path, arg(metavar="FILE", help_behavior_hint=COMMITTED)] = OUT,
) -> None:
    """Measures the tokenizer of a run and writes a table.

    Args:
        run: Directory with the tokenizer and the suite's recordings.
        out: The table.
    """
    tokenizer, rows = load_tokenizer(run / "tokenizer"), []
    for directory in sorted((run / "suite").iterdir()):
        pairs = frame_pairs(get_spec(directory.name), directory, tokenizer.image_size)
        decoded = tokenizer.reconstruct(pairs[:, 1])
        rows.append([directory.name, *quality(decoded, pairs)])
    rows.append(["mean", *np.mean([row[1:] for row in rows], 0)])
    cells = [[name, *(f"{value:.3f}" for value in values)] for name, *values in rows]
    write_table(out, ["robot", "psnr", "psnr_changed", "changed"], cells)
    print(
        f"{rows[-1][1]:.2f} dB on held-out frames, {rows[-1][2]:.2f} dB on the {rows[-1][3]:.0%} of pixels that change"
    )


def main() -> None:
    run_module(measure_run, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main, resumes=False))
