"""Compares generated trajectories with the recordings whose actions they replay."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_pipelines.sources.rlds.dataset import RldsDataset
from experiments.analysis.intervals import Interval, interval_of
from experiments.applications.generating.source import ACTION, IMAGE
from experiments.applications.generating.trajectories import Trajectories
from experiments.applications.play.recording import encode_video
from experiments.tables import write_table
from experiments.terminal.progress import Update
from hma_jax.evaluation.metrics import psnr
from hma_jax.evaluation.statistics import mean_and_sem
from hma_jax.runtime.files import write_file

ORIGIN_KEY = "episode_metadata/file_path"


class Pair(NamedTuple):
    """One generated episode and its recording, uint8 [M, H, W, 3] each."""

    number: int  # of the recording
    generated: np.ndarray
    recorded: np.ndarray


def read_pairs(directory: Path, recorded: Trajectories) -> Iterator[Pair]:
    """In the order in which they were written."""
    source = RldsDataset(directory)
    for i in range(len(source)):
        origin = source.record(i, [ORIGIN_KEY])[ORIGIN_KEY][0].decode()
        number = int(re.search(r"/(\d+)/seed \d+$", origin)[1])
        images = np.stack(source.episode(i, IMAGE, (ACTION,)).images)
        yield Pair(number, images, recorded[number].images)


def psnr_of(pair: Pair, given: int) -> np.ndarray:
    """dB of every frame after the `given` ones, [M - given]."""
    return np.asarray(psnr(pair.generated[given:], pair.recorded[given:]))


class Comparison(NamedTuple):
    """PSNR against the recording, the mean of every episode's frames, with its interval over episodes."""

    generated: Interval
    still: Interval  # of the last given frame, kept


def compare(
    directory: Path, recorded: Trajectories, given: int, clips: int, rate: float, progress: Update | None = None
) -> Comparison:
    """Writes `psnr.csv` and the first `clips` episodes as MP4 beside `directory`: recording left, model right.
    Clips that are there are removed: they may be of a dataset that was removed."""
    rows, home, total = [], directory.parent, len(RldsDataset(directory))
    for clip in (home / "clips").glob("*.mp4"):
        clip.unlink()
    for i, pair in enumerate(read_pairs(directory, recorded)):
        still = np.broadcast_to(pair.recorded[given - 1], pair.recorded.shape)
        rows.append((pair.number, psnr_of(pair, given), psnr_of(pair._replace(generated=still), given)))
        if i < clips:
            clip = home / "clips" / f"{pair.number:05d}.mp4"
            clip.parent.mkdir(exist_ok=True)
            write_file(clip, encode_video(np.concatenate([pair.recorded, pair.generated], axis=2), rate))
        if progress:
            progress(i + 1, total, "compared")
    lines = [
        [number, given + t, f"{a:.3f}", f"{b:.3f}"]
        for number, generated, still_psnr in rows
        for t, (a, b) in enumerate(zip(generated, still_psnr, strict=True))
    ]
    write_table(home / "psnr.csv", ["episode", "frame", "psnr", "psnr_still"], lines)
    means = np.array([[generated.mean(), still_psnr.mean()] for _, generated, still_psnr in rows])
    return Comparison(*(interval_of(mean_and_sem(column, np.arange(len(column)))) for column in means.T))
