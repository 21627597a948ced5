"""Imports token folders of the official release into a token store.

Owns what the folders do not say: the true rate, which split a folder is, and an identity for a tokenizer that is not
available. Folders hold no raw frames; the tokenizer that made the tokens, if it is given, decodes the validation
frames that evaluation compares with.

DIFFERS: the release multiplies latents by 0.18215 when it loads them; here they are stored so, in
half precision as everywhere, which rounds them by at most one part in 2048.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.names import NAME_RULE, is_dataset_name, quote
from data_pipelines.registry import DatasetSpec, find_spec
from data_pipelines.tokens.dataset_writer import PART_SIZE, Progress, cut_parts, write_dataset
from data_pipelines.tokens.episode_record import StoredEpisode, token_dtype
from data_pipelines.tokens.manifest import JobSettings, Manifest, SplitFacts, TokenizerFacts
from data_pipelines.tokens.part_files import Part, PartItem
from data_pipelines.tokens.release_folder import FACTOR_VOCAB, ReleaseFolder, open_folder
from hma_jax.config import SvdVaeConfig, require
from hma_jax.config.json import diff

if TYPE_CHECKING:
    from hma_jax.tokenizers.base import Tokenizer

LATENT_SCALE = SvdVaeConfig().scale
"""Scales the latents of the Stable Video Diffusion autoencoder to about unit standard deviation."""

PIXELS = {"magvit": 16, "temporalvae": 8}
"""Encoder type -> pixels per cell, along one side."""

IMAGE_SIZE = 256
"""Side of the release's images in pixels, used for an unknown encoder."""


def import_tokens(
    train: str | Path,
    val: str | Path,
    store_root: str | Path,
    *,
    name: str | None = None,
    hz: float | None = None,
    patch: int = 2,
    frame_step: int | None = None,
    tokenizer: Tokenizer | None = None,
    progress: Progress | None = None,
) -> Manifest:
    """Reads a pair of folders into `<store_root>/<name>` and returns the manifest.

    The rate is `hz`, or else that of the registry's entry `name`; the folders' own rate is not used, since the
    release's table is wrong for many. Latents become tokens of `patch` x `patch` cells. `frame_step`: one of this many
    native frames is stored; by default the stride (the 2 Hz frames). With `tokenizer`, which must be the one that made
    the tokens, validation frames are decoded and kept. A dataset that the store already has, made from the same folders
    in the same way, is left as it is. Raises ConfigError for folders that do not belong together or a store that cannot
    be written, DataError for damaged ones.
    """
    folders = {"train": open_folder(train), "val": open_folder(val)}
    plan = _plan(folders, name, hz, patch, frame_step, tokenizer)
    decode = None if tokenizer is None else tokenizer.decode
    episodes = [(split, e) for split, folder in folders.items() for e in range(len(folder))]

    def make(part: Part) -> Iterator[PartItem]:
        for number in part.episodes:
            split, episode = episodes[number]
            yield split, _episode(folders[split], episode, number, plan, patch, decode if split == "val" else None)

    frame_bytes = folders["train"].video[0].nbytes
    sizes = [int(n) * frame_bytes for folder in folders.values() for n in np.diff(folder.bounds)]
    return write_dataset(store_root, plan, cut_parts(sizes, PART_SIZE), make, progress=progress)


def _plan(
    folders: dict[str, ReleaseFolder],
    name: str | None,
    hz: float | None,
    patch: int,
    frame_step: int | None,
    tokenizer: Tokenizer | None,
) -> Manifest:
    train, val = folders["train"], folders["val"]
    facts = [_facts(folder, patch) for folder in folders.values()]
    changes = diff(facts[0], facts[1]) + diff(train.actions.shape[1], val.actions.shape[1], "action_dim")
    require(not changes, f"{train.path} and {val.path} do not belong together: {'; '.join(changes)}")
    if tokenizer is not None:
        own = ("identity", "image_size", "factors", "factor_vocab")
        decoder = replace(facts[0], **{field: getattr(tokenizer, field) for field in own})
        for field in ("grid", "tokens", "vocab_size", "channels"):
            have, want = getattr(tokenizer, field), getattr(decoder, field)
            require(
                have == want,
                f"{train.path}: its tokens have {field} {want}, but the tokenizer makes {have}; give the tokenizer "
                f"that made them (latents are joined with --patch {patch})",
            )
        facts[0] = decoder
    if name is None and not is_dataset_name(train.name):
        raise DataError(
            f"{train.path / 'metadata.json'}: name is {quote(train.name)}; {NAME_RULE}. Give another name with --name."
        )
    name = name or train.name
    known = find_spec(name)
    rate = known.hz if hz is None and known is not None else hz
    require(
        rate is not None,
        f"{name!r} is not in the registry, so its rate is unknown: give --hz, the native frames per second "
        f"(metadata.json says {train.metadata.get('hz')!r}, but this comes from a table that is wrong for many "
        "datasets)",
    )
    # The origin of these frames is unknown here, so the keys say only what they are.
    spec = DatasetSpec(name, "video", ("actions",), (train.actions.shape[1],), float(rate))
    frame_step = spec.stride if frame_step is None else frame_step
    require(
        frame_step >= 1 and spec.stride % frame_step == 0,
        f"{name!r}: frame_step {frame_step} does not divide the stride {spec.stride}",
    )
    return Manifest(
        spec=spec,
        tokenizer=facts[0],
        settings=JobSettings(
            val_fraction=0.0,
            min_val=0,
            max_val=0,
            keep_frames="none" if tokenizer is None else "val",
            frame_step=frame_step,
        ),
        source=_fingerprint(folders),
        source_version="release" if tokenizer is None else "release, frames decoded",
        action_mean=(),
        action_std=(),
        train=SplitFacts(),
        val=SplitFacts(),
    )


def _facts(folder: ReleaseFolder, patch: int) -> TokenizerFacts:
    """Ids of a vocabulary that is not a power of 512 have one factor. Raises ConfigError for a grid that the patch does
    not divide."""
    side, vocab = folder.video.shape[-1], folder.vocab_size
    pixels = PIXELS.get(str(folder.metadata.get("encoder_type")))
    image_size = side * pixels if pixels else IMAGE_SIZE
    if folder.channels:
        require(patch >= 1 and side % patch == 0, f"{folder.path}: patch {patch} does not divide the grid {side}")
        grid = side // patch
        return TokenizerFacts(folder.encoder, image_size, grid, grid**2, 0, 0, 0, patch**2 * folder.channels)
    factors = round(np.log(vocab) / np.log(FACTOR_VOCAB))
    factors, entries = (factors, FACTOR_VOCAB) if FACTOR_VOCAB**factors == vocab else (1, vocab)
    return TokenizerFacts(folder.encoder, image_size, side, side**2, vocab, factors, entries)


def _episode(
    folder: ReleaseFolder,
    episode: int,
    number: int,
    plan: Manifest,
    patch: int,
    decode: Callable[[np.ndarray], np.ndarray] | None,
) -> StoredEpisode:
    """Episode `episode` of a folder, as number `number` of the dataset. Raises DataError for values out of range."""
    start, stop = folder.bounds[episode : episode + 2]
    tokens = _tokens(folder, start, stop, plan.frame_step, patch)
    actions = np.asarray(folder.actions[start:stop])
    if not np.isfinite(actions).all():
        frame = int(start + np.flatnonzero(~np.isfinite(actions).all(axis=1))[0])
        raise DataError(f"{folder.path}/actions: not finite at frame {frame}: {folder.actions[frame].tolist()}.")
    wide = tokens.astype(np.float32 if folder.channels else np.int32)
    return StoredEpisode(number, None, tokens, actions, None if decode is None else decode(wide))


def _tokens(folder: ReleaseFolder, start: int, stop: int, step: int, patch: int) -> np.ndarray:
    """Every `step`-th frame of an episode: ids [F, S], or scaled latents [F, S, patch^2 C]."""
    part = np.asarray(folder.video[start:stop:step])
    if not folder.channels:
        wrong = part[(part < 0) | (part >= folder.vocab_size)]
        if len(wrong):
            raise DataError(
                f"{folder.path / 'video.bin'}: id {wrong[0]} in frames {start} to {stop - 1}, but vocab_size is "
                f"{folder.vocab_size}. Download the folder again."
            )
        return part.reshape(len(part), -1).astype(token_dtype(folder.vocab_size))
    if not np.isfinite(part).all():
        raise DataError(f"{folder.path / 'video.bin'}: latents of frames {start} to {stop - 1} are not finite.")
    frames, channels, side, _ = part.shape
    grid = side // patch
    # In the order in which the models read a patch: cells row by row, channels of a cell together.
    cells = part.reshape(frames, channels, grid, patch, grid, patch).transpose(0, 2, 4, 3, 5, 1)
    scaled = cells.astype(np.float32) * np.float32(LATENT_SCALE)
    return scaled.reshape(frames, grid**2, patch**2 * channels).astype(np.float16)


def _fingerprint(folders: dict[str, ReleaseFolder]) -> str:
    """Hash over metadata, actions and episodes, and a sample of the tokens, which may be large."""
    digest = hashlib.sha256()
    for folder in folders.values():
        digest.update(repr(sorted(folder.metadata.items())).encode())
        digest.update(folder.bounds.astype("<i8").tobytes() + np.ascontiguousarray(folder.actions, "<f4").tobytes())
        digest.update(np.ascontiguousarray(folder.video[:: max(len(folder.video) // 64, 1)]).tobytes())
    return digest.hexdigest()[:16]


def pair_folders(folders: Sequence[Path]) -> list[tuple[str, Path, Path]]:
    """(name, train, val) of folders called `<name>_train` and `<name>_val`. Raises ConfigError if one of a pair is
    missing."""
    stems: dict[Path, dict[str, Path]] = {}
    for folder in folders:
        stem, _, split = folder.name.rpartition("_")
        require(
            split in ("train", "val") and bool(stem),
            f"{folder}: the folder's name must end in _train or _val",
        )
        stems.setdefault(folder.with_name(stem), {})[split] = folder
    pairs = []
    for stem, found in stems.items():
        mates = {split: found.get(split, stem.with_name(f"{stem.name}_{split}")) for split in ("train", "val")}
        missing = [str(mate) for mate in mates.values() if not mate.is_dir()]
        require(not missing, f"{', '.join(missing)}: no such folder; a dataset is a pair of _train and _val")
        pairs.append((stem.name, mates["train"], mates["val"]))
    return pairs
