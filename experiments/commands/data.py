"""What `hma data convert` and `hma data import-tokens` do. Each says what it wrote, and what is next."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.commands.study import wrote
from experiments.progress import console, step
from experiments.setting import command
from hma_jax.config import require

if TYPE_CHECKING:
    from data_pipelines.sources.units import Source
    from data_pipelines.sources.settings import (
        Ego4dSettings,
        EgoExo4dSettings,
        EpicKitchensSettings,
        LeRobotSettings,
        RobomimicSettings,
    )
    from data_pipelines.registry import DatasetSpec
    from experiments.cli.data import To


def robomimic(path: Path, to: To, settings: RobomimicSettings) -> None:
    from data_pipelines.sources.robomimic import RobomimicSource

    source = RobomimicSource(path, settings)
    _convert(source, to, f"robomimic_{source.task}")


def lerobot(root: Path, to: To, settings: LeRobotSettings) -> None:
    from data_pipelines.sources.lerobot import LeRobotSource

    _convert(LeRobotSource(root, settings), to, root.absolute().name)


def epic_kitchens(frames: Path, detections: Path, to: To, settings: EpicKitchensSettings) -> None:
    from data_pipelines.sources.human.epic_kitchens import NAME, EpicKitchensSource

    _convert(EpicKitchensSource(frames, detections, settings), to, NAME)


def ego4d(annotations: Path, videos: Path, to: To, settings: Ego4dSettings) -> None:
    from data_pipelines.sources.human.ego4d import NAME, Ego4dSource

    _convert(Ego4dSource(annotations, videos, settings), to, NAME)


def egoexo4d(root: Path, to: To, settings: EgoExo4dSettings) -> None:
    from data_pipelines.sources.human.egoexo4d import NAME, EgoExo4dSource

    _convert(EgoExo4dSource(root, settings), to, NAME)


def _convert(source: Source, to: To, default_name: str) -> None:
    from data_pipelines.convert.write import convert

    name = to.name or re.sub(r"[^a-z0-9_]+", "_", default_name.lower()).strip("_")
    with step(f"convert {len(source.units)} to {name}") as update:
        done = convert(
            source,
            to.out,
            name,
            skip_damaged=to.skip_damaged,
            progress=lambda units, total, unit: update(units, total, unit),
        )
    _say(f"{done.episodes:,} episodes at {done.spec.hz:g} Hz in {done.shards} shards")
    for reason, count in done.left_out.items():
        _say(f"left out {count:,} x: {reason}")
    inspect = command("data inspect", done.directory, "--hz", f"{done.spec.hz:g}")
    _say(
        "to read it, unless an entry of this name is known: add `--entry FILE.toml` to the next command and give "
        "that file to all others with --registry; or add this to data_pipelines/registry/own.py:"
    )
    _say(f"    {entry(done.spec)}")
    wrote(done.directory, then=inspect)


def entry(spec: DatasetSpec) -> str:
    """The registry entry as it is written there."""
    keys, dims = (
        f"({', '.join(map(repr, v))},)".replace("'", '"') for v in (spec.action_keys, spec.action_dims)
    )
    return (
        f'DatasetSpec("{spec.name}", image_key="{spec.image_key}", action_keys={keys}, '
        f"action_dims={dims}, hz={spec.hz:g}),"
    )


def import_tokens(
    folders: Sequence[Path],
    store: Path,
    name: str | None,
    hz: float | None,
    patch: int,
    frame_step: int | None,
    tokenizer: Path | None,
) -> None:
    from data_pipelines.tokens.import_tokens import import_tokens as import_pair
    from data_pipelines.tokens.import_tokens import pair_folders

    pairs = pair_folders(folders)
    require(name is None or len(pairs) == 1, f"--name can be given for one dataset, not for {len(pairs)}")
    decoder = None
    if tokenizer is not None:
        from hma_jax.tokenizers.io import load_tokenizer

        decoder = load_tokenizer(tokenizer)
    for stem, train, val in pairs:
        with step(f"import {stem}") as update:
            manifest = import_pair(
                train,
                val,
                store,
                name=name,
                hz=hz,
                patch=patch,
                frame_step=frame_step,
                tokenizer=decoder,
                progress=update,
            )
        facts, spec = manifest.tokenizer, manifest.spec
        what = f"latents of {facts.channels} values" if facts.channels else f"ids of {facts.vocab_size:,}"
        _say(
            f"{spec.name}: {len(manifest.train.episodes):,} + {len(manifest.val.episodes):,} episodes, "
            f"{facts.tokens} tokens per frame, {what}, by {facts.identity}; "
            f"{spec.hz:g} Hz, stride {spec.stride}"
        )
        wrote(store / spec.name)
    if tokenizer is None:
        _say(
            "note: without --tokenizer there are no frames, so evaluation in pixels cannot use these datasets"
        )


def _say(line: str) -> None:
    console.print(line, markup=False, soft_wrap=True)
