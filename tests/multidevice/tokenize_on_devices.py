"""Encodes and decodes noise with small tokenizers on all devices; prints a JSON line of digests."""

import hashlib
import json

import jax
import numpy as np

from tests.hma_jax.pretrained import MAGVIT2_SMALL, PIXELS_SMALL, VAE_SMALL, make, noise


def digest(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def main() -> None:
    found = {}
    for config in (MAGVIT2_SMALL, PIXELS_SMALL):
        tokenizer = make(config, piece=2)
        tokens = tokenizer.encode(noise(19))
        found[config.kind] = [digest(tokens), digest(tokenizer.decode(tokens))]
    latents = np.linspace(-1, 1, 19 * 256).reshape(19, 16, 16)
    found["latents"] = digest(make(VAE_SMALL, piece=2).decode(latents))
    print(json.dumps({"devices": jax.device_count(), "at_once": tokenizer.at_once, **found}))


if __name__ == "__main__":
    main()
