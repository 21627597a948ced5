"""Cases without a model: training masks, windows over a data set, metrics, names and shapes."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np

from data_pipelines.tokens.episode_record import StoredEpisode
from data_pipelines.tokens.import_tokens import LATENT_SCALE
from data_pipelines.tokens.moments import Moments, merge_all
from data_pipelines.tokens.release_folder import open_folder
from data_pipelines.windows.slicer import WindowSlicer
from data_pipelines.windows.windows import train_windows
from hma_jax.config import MaskingConfig, ModelConfig
from hma_jax.convert.official import official_shapes
from hma_jax.convert.official_config import read_model
from hma_jax.convert.pretrained import MAGVIT2, SVD_VAE, tokenizer_shapes
from hma_jax.evaluation import metrics
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.objective.masking import MaskingDraws, corrupt, mask_tokens
from tests.data_pipelines.fakes import OneDataset
from tests.golden.case import Case, Finding

# --- Masks -------------------------------------------------------------------------------------


def check_collators(case: Case) -> None:
    """Recorded random numbers in place of drawn ones; the release draws some for a whole batch."""
    for mode in ("mlm", "prompt"):
        first = case.info["first_masked_frame"] if mode == "prompt" else 1
        _check_discrete(case, mode, first)
        _check_latents(case, mode, first)


_corrupt, _mask_tokens = jax.jit(corrupt, static_argnums=(2, 3)), jax.jit(mask_tokens, static_argnums=3)


def _from_first(recorded: np.ndarray, frames: int) -> np.ndarray:
    """[T, ...]: numbers are recorded from the first masked frame on, earlier ones do not matter."""
    missing = frames - len(recorded)
    return np.concatenate([np.ones((missing, *recorded.shape[1:])), recorded]).astype(np.float32)


def _check_discrete(case: Case, mode: str, first: int) -> None:
    inputs, settings = case.inputs, case.settings["discrete"]
    batch, frames, h, w = inputs["tokens"].shape
    q, v = settings["num_factored_vocabs"], settings["factored_vocab_size"]
    config = ModelConfig(frames=frames, tokens=h * w, factors=q, factor_vocab=v)
    masking = MaskingConfig(
        max_corrupt_rate=settings["max_corrupt_rate"], clean_rate_min=settings["dataloader_mask_ratio_min"]
    )
    got = []
    for b in range(batch):
        uniform, degrade = np.ones(1 + frames - first, np.float32), np.zeros((frames - first, h * w, q))
        if mode == "prompt":
            uniform = inputs["prompt__uniform"]
            degrade = inputs["prompt__frame_r"][:, b].reshape(degrade.shape)
        draws = MaskingDraws(
            u_corrupt=np.float32(inputs[f"{mode}__corrupt_u"]),
            u_replace_TSQ=inputs[f"{mode}__corrupt_r"][b].reshape(frames, h * w, q),
            noise_TSQ=inputs[f"{mode}__random_values"][b].reshape(frames, h * w, q),
            first_masked=np.int32(first),
            u_clean=np.float32(uniform[0]),
            u_decay_T=_from_first(uniform[1:], frames),
            u_degrade_TSQ=_from_first(degrade, frames),
            u_rate_T=_from_first(inputs[f"{mode}__mask_prob_u"][b].ravel(), frames),
            u_mask_TS=_from_first(inputs[f"{mode}__mask_r"][b].reshape(-1, h * w), frames),
        )
        tokens = inputs["tokens"][b].reshape(frames, -1)
        ids = _corrupt(tokens, draws, config, masking)
        masked = _mask_tokens(draws.u_rate_T, draws.u_mask_TS, draws.first_masked, masking)
        got.append(np.where(masked, config.vocab_size, ids).ravel())
    case.check(f"{mode}__input_ids", np.stack(got))
    case.check(f"{mode}__labels", inputs["tokens"].reshape(batch, -1))


def _check_latents(case: Case, mode: str, first: int) -> None:
    inputs = case.inputs
    batch, frames, h, w, _ = inputs["latents"].shape
    masking = MaskingConfig(mask_angle_min=case.settings["continuous"]["dataloader_mask_ratio_min"])
    got = []
    for b in range(batch):
        rate = _from_first(inputs[f"feature_{mode}__mask_prob_u"][b].ravel(), frames)
        cells = _from_first(inputs[f"feature_{mode}__mask_r"][b].reshape(-1, h * w), frames)
        got.append(np.asarray(_mask_tokens(rate, cells, np.int32(first), masking)).reshape(frames, h, w))
    case.check(f"feature_{mode}__masked_tokens_indicator", np.stack(got))


# --- Windows -----------------------------------------------------------------------------------


class OnDisk:
    """A data set in the release's format, its episodes numbered from 0."""

    def __init__(self, path: Path):
        folder = open_folder(path)
        self.actions, self.frames = folder.actions, folder.video.reshape(len(folder.video), -1)
        if folder.channels:
            self.frames = np.moveaxis(folder.video, 1, -1).astype(np.float32) * np.float32(LATENT_SCALE)
        self.firsts, self.ends = folder.bounds[:-1], folder.bounds[1:]
        self.segments = np.repeat(np.arange(len(folder)), self.ends - self.firsts)


def check_windows(case: Case) -> None:
    facts = json.loads((case.folder / "windows.json").read_text())
    items = np.load(case.folder / "items.npz")
    stores = {name: OnDisk(case.folder / name) for name in ("tokens", "latents")}
    data = stores["tokens"]
    for one in facts["window_lists"]:
        _check_starts(case, data, one)
    for key in items:
        _check_item(case, stores, key, items[key])
    episodes = [data.actions[data.segments == segment] for segment in np.unique(data.segments)]
    moments = merge_all(map(Moments.of, episodes), data.actions.shape[1])
    for name, got in (("action_mean", moments.mean), ("action_std", moments.std)):
        case.compare(name, got, facts[name], 1e-5)
    case.compare("episodes", len(data.ends), facts["episodes"], 0)
    case.add(Finding("stride_from_frequency_table", None, note="not followed: our datasets all have a rate"))


def _check_starts(case: Case, data: OnDisk, one: dict[str, Any]) -> None:
    frames, stride = one["window"], one["stride"]
    label = f"starts, window {frames}, stride {stride}"
    if not one["filter_interrupts"] or one["filter_overlaps"]:
        why = "we keep overlapping windows" if one["filter_overlaps"] else "our windows never leave an episode"
        case.add(Finding(label, None, note=f"not followed: {why}"))
        return
    ours = train_windows(
        OneDataset((data.ends - data.firsts).tolist(), hz=2 * stride), "toy", frames, min_real=frames, rate=2.0
    )
    got = set((data.firsts[ours.episode_idx] + ours.start).tolist())
    theirs = set(one["starts"])
    # DIFFERS: their last chunk may run over an episode's end, and they drop the last window of all.
    over = {s for s in theirs if s + frames * stride > data.ends[data.segments[s]]}
    length = (data.ends - data.firsts)[-1]
    last = {len(data.segments) - frames * stride} if length >= frames * stride else set()
    note = "equal but for windows at an episode's end"
    case.add(Finding(label, got == (theirs - over) | last, note=note))
    case.compare(f"{label}: n_action", data.actions.shape[1] * stride, one["n_action"], 0)


def _check_item(case: Case, stores: dict[str, OnDisk], key: str, want: np.ndarray) -> None:
    frames, stride, start = map(int, re.match(r"window(\d+)_stride(\d+)_start(\d+)__", key).groups())
    data = stores["latents" if key.endswith("latents") else "tokens"]
    rows = np.flatnonzero(data.segments == data.segments[start])
    if start + frames * stride > rows[-1] + 1:
        case.add(Finding(key, None, note="not followed: its last chunk leaves the episode"))
        return
    slicer = WindowSlicer(frames, stride, frame_step=1)
    item = StoredEpisode(0, None, data.frames[rows], data.actions[rows], None)
    first = start - rows[0]
    if key.endswith("action_ids"):
        got = slicer.chunks(item.actions, first, width=data.actions.shape[1] * stride)
    else:
        got = slicer.slice_frames(item.tokens, item, first)
    case.compare(key, np.asarray(got).reshape(want.shape), want, 1e-6 if key.endswith("latents") else 0.0)


# --- Metrics -----------------------------------------------------------------------------------


def check_metrics(case: Case) -> None:
    want = json.loads((case.folder / "outputs.json").read_text())
    images = ("ground_truth", "predicted", "predicted_random_actions")
    true, predicted, random = (np.moveaxis(case.inputs[name], -3, -1) for name in images)
    whole = (true.shape[0], -1, *true.shape[3:])  # a clip as one tall image
    last = metrics.psnr(true[:, -1], predicted[:, -1])
    others = metrics.psnr(np.broadcast_to(true[:, -1], random[:, :, -1].shape), random[:, :, -1]).mean(0)
    ssim = metrics.ssim(true, predicted)
    factored = np.moveaxis(case.inputs["factored_logits"], (1, 2), (-1, -2))  # [B, T-1, h, w, Q, V]
    labels = case.inputs["labels"].reshape(len(factored), -1, *factored.shape[2:4])[:, 1:]
    entropy = float(np.mean(jax.jit(metrics.factored_cross_entropy)(factored, labels)))
    batches = case.inputs["batch_losses"], case.inputs["batch_sizes"]
    got = {
        "psnr_last_frame_per_clip": (last, 1e-6),
        "psnr_per_frame": (metrics.psnr(true, predicted), 1e-6),
        "psnr_whole_clip": (metrics.psnr(true.reshape(whole), predicted.reshape(whole)), 1e-6),
        "ssim_list_as_official": (ssim.mean(0), 1e-6),
        "ssim_per_frame": (ssim, 1e-6),
        "delta_psnr_per_clip": (last - others, 1e-6),
        "cross_entropy": (entropy, 1e-5),
        "perplexity": (math.exp(entropy), 1e-5 * math.exp(entropy)),
        "token_accuracy": ((case.inputs["samples"] == labels).mean(), 1e-6),
        "mean_perplexity_over_batches": (metrics.official_perplexity(*batches), 1e-5),
    }
    for name, expected in want.items():
        if name in got:
            case.compare(name, np.asarray(got[name][0], np.float64), np.asarray(expected, np.float64), got[name][1])
        else:
            case.add(Finding(name, False, note="unknown metric"))


# --- Names and shapes --------------------------------------------------------------------------

TOKENIZERS = {"magvit2": MAGVIT2, "svd_vae": SVD_VAE}


def check_key_shapes(case: Case) -> None:
    """Full-size models, of which no array is made."""
    for path in sorted(case.folder.glob("*.json")):
        content = json.loads(path.read_text())
        if path.stem == "parameter_counts":
            _check_counts(case, content)
        elif path.stem in TOKENIZERS:
            source = TOKENIZERS[path.stem]
            declared = source.tokenizer.declare(source.config(content["config"], path.stem))
            _compare_shapes(case, path.stem, tokenizer_shapes(source, declared), content)
        else:
            _compare_shapes(case, path.stem, _model_shapes(path.stem, content), content)


def _model_shapes(label: str, content: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    dim, stride = content["action_dim"], content["stride"]
    table = EmbodimentTable((Embodiment(content["domain"], dim, stride, (0.0,) * dim, (1.0,) * dim),))
    names = {"action_domains": [content["domain"]], "d_actions": [dim * stride]}
    return official_shapes(read_model({**content["config"], **names}, label), table)


def _compare_shapes(case: Case, label: str, got: dict[str, tuple[int, ...]], content: dict[str, Any]) -> None:
    listed = content["shapes"]
    want = {name: tuple(shape) for name, shape in listed.items()}
    wrong = sorted({n for n in got.keys() | want.keys() if got.get(n) != want.get(n)})
    note = f"differ: {', '.join(wrong[:5])}" if wrong else f"{len(want)} names and shapes exact"
    case.add(Finding(label, not wrong and len(got) == content["tensors"], note=note))
    case.compare(f"{label}: parameters", sum(map(math.prod, got.values())), content["parameters"], 0)


def _check_counts(case: Case, counts: dict[str, int]) -> None:
    """Without a domain: what all robots share, counted in a model of one."""
    table = EmbodimentTable((Embodiment("language_table", 2, 1, (0.0,) * 2, (1.0,) * 2),))
    for label, want in counts.items():
        variant, width, domains = re.fullmatch(r"(\w+) d_model=(\d+) domains=(\d)", label).groups()
        settings: dict[str, Any] = {"d_model": int(width), "num_layers": 32, "num_heads": 8, "use_mup": True}
        settings |= {"action_network": "concat+modulate", "qk_norm": False, "num_factored_vocabs": 2}
        settings |= {"action_domains": ["language_table"], "d_actions": [2]}
        if variant == "continuous":
            settings |= {"Diffusion": True, "S": 1024, "patch_size": 2, "qkv_bias": True, "mlp_bias": False}
        leaves = declare_model(read_model(settings, label), table).leaves()
        shared = [spec for spec in leaves.values() if domains == "1" or spec.embodiment_axis is None]
        case.compare(label, sum(spec.size for spec in shared), want, 0)
