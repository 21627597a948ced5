"""Cases of the pretrained tokenizers: encoders, quantisation and decoders, channels first there."""

from __future__ import annotations

import re

import jax
import numpy as np

from hma_jax.convert import read_magvit2, read_svd_vae
from hma_jax.convert.pretrained import SVD_VAE, read_tensors, tokenizer_params
from hma_jax.model.params import declare
from hma_jax.tokenizers.network import to_pixels
from hma_jax.tokenizers.quantizer import ids_to_codes, latents_to_ids, nearest_code
from hma_jax.tokenizers.svd_vae import VideoDecoder
from tests.golden.case import Case, Finding

SINGLE_PIXELS = 1e-3
"""Share of all values that may be off by one grey level, where rounding decides."""


_to_pixels, _nearest_code, _latents_to_ids = map(jax.jit, (to_pixels, nearest_code, latents_to_ids))
_ids_to_codes = jax.jit(ids_to_codes, static_argnums=1)


def channels_first(x: jax.Array) -> np.ndarray:
    return np.moveaxis(np.asarray(x), -1, 1)


def channels_last(x: np.ndarray) -> np.ndarray:
    return np.moveaxis(x, 1, -1)


def check_pixels(case: Case, output: str, images: jax.Array) -> None:
    """As released, grey levels are truncated; in single pixels one level of difference is allowed."""
    if output not in case.outputs:
        return
    case.checked.add(output)
    got, want = channels_first(_to_pixels(images)).astype(np.uint8), case.outputs[output]
    if got.shape != want.shape:
        case.add(Finding(output, False, note=f"shape {got.shape}, expected {want.shape}"))
        return
    error = np.abs(got.astype(int) - want.astype(int))
    off = int((error > 0).sum())
    good = bool(error.max(initial=0) <= 1 and off <= max(1, SINGLE_PIXELS * error.size))
    case.add(Finding(output, good, note=f"{off} of {want.size} differ, by {error.max(initial=0)} at most"))


# --- MAGVIT2 -----------------------------------------------------------------------------------


def one_token(case: Case, levels: str) -> int:
    """Pixels along one side of a token, by the settings' list of `levels`: an image size that always suits.

    A tokenizer is for one size of images, but its network takes those of every size, and a case may have several.
    """
    return 2 ** (len(case.settings[levels]) - 1)


def check_magvit2(case: Case) -> None:
    tokenizer = read_magvit2(case.folder, image_size=one_token(case, "ch_mult"))
    network = tokenizer.declare(tokenizer.config)
    encode = jax.jit(lambda params, images: network.merge(params).encoder(images))
    decode = jax.jit(lambda params, codes: network.merge(params).decoder(codes))

    indices = {}
    for name, values in case.inputs.items():
        if values.dtype.kind != "f":
            indices[name] = values.astype(np.int32)
            continue
        z = encode(tokenizer.params, channels_last(values))
        case.check(f"pre_quantised__{name}", channels_first(z))
        case.check(f"quantised__{name}", channels_first(_nearest_code(z)))
        indices[name] = _latents_to_ids(z)
        case.check(f"indices__{name}", indices[name])
    for name, ids in indices.items():
        codes = _ids_to_codes(ids, tokenizer.config.bits)
        case.check(f"latent_from_indices__{name}", channels_first(codes))
        if {f"decoded__{name}", f"decoded_uint8__{name}"} & case.outputs.keys():
            images = decode(tokenizer.params, codes)
            case.check(f"decoded__{name}", channels_first(images))
            check_pixels(case, f"decoded_uint8__{name}", images)


# --- The VAE of Stable Video Diffusion -----------------------------------------------------------


def check_vae(case: Case) -> None:
    tokenizer = read_svd_vae(case.folder, image_size=one_token(case, "block_out_channels"), patch=1)
    network = tokenizer.declare(tokenizer.config)
    moments = jax.jit(lambda params, images: network.merge(params).moments(images))
    for name, values in case.inputs.items():
        if name.startswith("images"):
            suffix = name.removeprefix("images")
            mean, log_variance = moments(tokenizer.params, channels_last(values))
            got = {"mean": mean, "mode": mean, "logvar": log_variance, "std": np.exp(0.5 * np.asarray(log_variance))}
            for output, value in got.items():
                case.check(f"{output}{suffix}", channels_first(value))
    _check_clips(case, network, tokenizer.params)


def check_vae_decoder(case: Case) -> None:
    """The case has no encoder."""
    config = SVD_VAE.config(case.settings, case.name, patch=1)
    network = declare(lambda: VideoDecoder(config))
    params = tokenizer_params(SVD_VAE, network, read_tensors(case.folder), case.name)
    _check_clips(case, network, params)


def _check_clips(case: Case, network, params) -> None:
    decode = jax.jit(lambda params, latents, frames: network.merge(params).decode(latents, frames), static_argnums=2)
    done = {}
    for output in case.outputs:
        match = re.fullmatch(r"decoded(_uint8)?(_\w+?)?_num_frames(\d+)", output)
        if match is None:
            continue
        kind, suffix, frames = match[1], match[2] or "", int(match[3])
        if (suffix, frames) not in done:
            latents = channels_last(case.inputs[f"latents{suffix}"])
            done[suffix, frames] = decode(params, latents, frames)
        if kind:
            check_pixels(case, output, done[suffix, frames])
        else:
            case.check(output, channels_first(done[suffix, frames]))
