"""Predicted tokens as images, compared with the recorded ones: decoding and comparison run on the device that made
them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import EvalConfig, require
from hma_jax.evaluation.controllability import counterfactual
from hma_jax.evaluation.lpips import lpips
from hma_jax.evaluation.metrics import difference, last_frames, mean_over_frames, psnr, ssim
from hma_jax.evaluation.protocol import Predicted
from hma_jax.model.params import Params

ToImages = Callable[[Params, jax.Array], jax.Array]
"""Pure: (parameters, ids [B, S] or latents [B, S, C]) -> uint8 [B, height, width, 3]."""


class Decoder(Protocol):
    """The half of a tokenizer that evaluation needs (`tokenizers.base.Tokenizer`)."""

    @property
    def params(self) -> Params: ...
    @property
    def piece(self) -> int:
        """Images that a device decodes at a time."""
        ...

    def decode_uint8_fn(self, params: Params, tokens: jax.Array) -> jax.Array:
        """Pure: ids [B, S] or latents [B, S, C] -> uint8 [B, height, width, 3]."""
        ...

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """The same on the host."""
        ...


def image_metrics(
    to_images: ToImages,
    piece: int,
    params: Params,
    predicted: Predicted,
    images: jax.Array,
    config: EvalConfig,
    real_BT: jax.Array | None = None,
    others: tuple[jax.Array, jax.Array] | None = None,
    lpips_params: Params | None = None,
) -> dict[str, jax.Array]:
    """Metrics per window [B], over the frames that are `real_BT` (None: all are). `images` are the recorded ones, uint8
    [B, T, height, width, 3]. `others` are other_images and other_seen of a batch that has them. `lpips_params` are from
    `lpips.load_lpips`, where images are judged by LPIPS too.

    `finite`, bool [B], says whether the tokens are finite: images of latents that are not finite mean nothing.
    """
    made, draws = predicted.tokens.shape[1], predicted.random_last.shape[1]
    under_others = [] if predicted.other is None else [predicted.other]
    tokens = jnp.concatenate([predicted.tokens, predicted.random_last, *under_others], axis=1)
    decoded = decode_in_pieces(to_images, piece, params, tokens.reshape(-1, *tokens.shape[2:]))
    decoded = decoded.reshape(*tokens.shape[:2], *decoded.shape[1:])
    require(
        decoded.shape[2:] == images.shape[2:],
        f"the tokenizer decodes images of shape {decoded.shape[2:]}, but the recorded ones have {images.shape[2:]}; "
        "evaluate with the tokenizer that made the token store",
    )
    shown, random_last, other = jnp.split(decoded, (made, made + draws), axis=1)
    first = config.first_predicted
    future, last = images[:, first:], last_frames(images, real_BT)
    real = None if real_BT is None else real_BT[:, first:]
    # What copying predicts: the last image that the model was given.
    before = images[:, first - 1 : -1] if config.context == "recorded" else images[:, first - 1 : first]
    # Images under recorded and random actions are in one array, so that equal images get equal numbers, to the last
    # bit.
    made_last = jnp.concatenate([last_frames(shown, real)[:, None], random_last], axis=1)
    of_last = jax.lax.optimization_barrier(psnr(made_last, jnp.broadcast_to(last[:, None], made_last.shape)))
    psnr_last, psnr_random = of_last[:, 0], of_last[:, 1:]
    copied = jnp.broadcast_to(before, future.shape)
    found = {
        "psnr": mean_over_frames(psnr(shown, future), real),
        "psnr_last": psnr_last,
        "psnr_random": psnr_random.mean(1),
        "delta_psnr": difference(psnr_last[:, None], psnr_random).mean(1),
        "psnr_copy": mean_over_frames(psnr(copied, future), real),
        "ssim": mean_over_frames(ssim(shown, future), real),
        "finite": _finite(tokens[:, :made], real) & _finite(predicted.random_last, None),
    }
    if lpips_params is not None:
        for name, of_frames in zip(("lpips", "lpips_copy"), lpips(lpips_params, [shown, before], future), strict=True):
            found[name] = mean_over_frames(of_frames, real)
    if predicted.other is not None:
        truth, seen = others
        found["finite"] &= _finite(predicted.other, real)
        found |= counterfactual(shown, other, truth[:, first:], before, seen, real)
    return found


def _finite(tokens: jax.Array, real_BT: jax.Array | None) -> jax.Array:
    """bool [B]: whether all tokens of real frames are finite."""
    finite = jnp.isfinite(tokens).all(tuple(range(2, tokens.ndim)))
    return (finite if real_BT is None else finite | ~real_BT).all(1)


def decode_in_pieces(to_images: ToImages, piece: int, params: Params, tokens: jax.Array) -> jax.Array:
    """Images of tokens [n, ...], decoded `piece` at a time, so that memory does not grow with n."""
    count = len(tokens)
    if count <= piece:
        return to_images(params, tokens)
    missing = -count % piece
    padded = jnp.pad(tokens, [(0, missing)] + [(0, 0)] * (tokens.ndim - 1), mode="edge")  # as `in_pieces`
    images = jax.lax.map(lambda x: to_images(params, x), padded.reshape(-1, piece, *tokens.shape[1:]))
    return images.reshape(-1, *images.shape[2:])[:count]


class Sample(NamedTuple):
    """A window to look at, on the host."""

    images: np.ndarray  # recorded, uint8 [T, height, width, 3]
    tokens: np.ndarray  # predicted under the recorded actions, of the last n frames [n, S (, C)]
    random: np.ndarray | None  # under random actions
    other: np.ndarray | None = None  # under another episode's actions
    other_images: np.ndarray | None = None  # the true images under those


def make_clips(decoder: Decoder, samples: Mapping[str, Sequence[Sample]]) -> dict[str, dict[str, np.ndarray]]:
    """{dataset: {true, predicted and, where made, random, other, other_true: uint8 [samples, T, height, width, 3]}}.

    A predicted clip begins with the recorded images up to its first predicted one.
    """
    tokens = [x for own in samples.values() for s in own for x in (s.tokens, s.random, s.other) if x is not None]
    if not tokens:
        return {}
    decoded = decoder.decode(np.concatenate(tokens))  # in one call: decoders take many images at a time
    pieces = iter(np.split(decoded, np.cumsum([len(x) for x in tokens])[:-1]))
    clips: dict[str, dict[str, list[np.ndarray]]] = {}
    for name, own in samples.items():
        for sample in own:
            kinds = clips.setdefault(name, {"true": [], "predicted": [], "random": [], "other": [], "other_true": []})
            kinds["true"].append(sample.images)
            if sample.other_images is not None:
                kinds["other_true"].append(sample.other_images)
            for kind, made in (("predicted", sample.tokens), ("random", sample.random), ("other", sample.other)):
                if made is not None:
                    given = sample.images[: len(sample.images) - len(made)]
                    kinds[kind].append(np.concatenate([given, next(pieces)]))
    return {name: {kind: np.stack(x) for kind, x in kinds.items() if x} for name, kinds in clips.items()}
