"""From which dataset each example is drawn, as a pure function of (seed, position).

Draws come in blocks. How often a dataset was drawn before a block is known without looking at any block:
the block's number, times its length, is shared out by the weights. Between two such counts lies what the
block holds, in an order that a hash of (seed, block) shuffles. So the i-th draw of a dataset ever is
numbered i: its order visits every window once per epoch, which independent draws of every position would
not, and counts never stray from their shares by more than a few, which matters for datasets of small weight.
Any position costs one block, whatever came before it.
DIFFERS: the release draws datasets and windows with replacement, the same in every epoch (reference section 4.3).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_pipelines.sampling.order import hash64, stream_seed

BLOCK = 512
"""Draws of a block: several batches of most sizes, so that what a batch holds varies nearly as in free draws."""

_BITS = 48
"""Of a share, a fixed-point number: weights are exact to 1e-14, in integers."""


class Draws:
    """The draws of datasets with `weights` (float [D], sum 1), in blocks."""

    def __init__(self, weights: Sequence[float], seed: int | str):
        rest = np.cumsum(np.asarray(weights, np.float64)[::-1])[::-1]  # of a dataset and those after it
        nothing = np.zeros(len(rest))  # where no weight is left: those before take all there is
        shares = np.minimum(np.divide(weights, rest, out=nothing, where=rest > 0), 1.0)
        shares[-1] = 1.0
        self._shares = [round(float(share) * (1 << _BITS)) for share in shares]
        self._seed = stream_seed("mixture", seed)
        offsets = hash64(np.arange(len(shares)), stream_seed("mixture", seed, "rounding"))
        self._offsets = [int(offset) >> (64 - _BITS) for offset in offsets]

    def counts(self, block: int) -> np.ndarray:
        """int64 [D]: draws of each dataset before `block`; their sum is block x BLOCK.

        Each dataset takes its share of what those before it left, rounded at a point of its own. Neither
        what it takes nor what it leaves ever shrinks, so that no block asks for less than nothing.
        """
        left, counts = block * BLOCK, []
        for share, offset in zip(self._shares, self._offsets, strict=True):
            counts.append((left * share + offset) >> _BITS)
            left -= counts[-1]
        return np.asarray(counts, np.int64)

    def at(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(dataset, which of its draws this is), both int64 like `positions`, int64 [N]."""
        blocks, slots = np.divmod(np.asarray(positions, np.int64), BLOCK)
        dataset, number = np.empty_like(blocks), np.empty_like(blocks)
        for block in np.unique(blocks).tolist():
            here = blocks == block
            datasets, numbers = self._block(block)
            dataset[here], number[here] = datasets[slots[here]], numbers[slots[here]]
        return dataset, number

    def _block(self, block: int) -> tuple[np.ndarray, np.ndarray]:
        """The same for all positions of a block."""
        before = self.counts(block)
        here = self.counts(block + 1) - before
        shuffled = np.argsort(hash64(np.arange(BLOCK), hash64(block, self._seed)), kind="stable")
        dataset = np.repeat(np.arange(len(here)), here)[shuffled]
        by_dataset = np.argsort(dataset, kind="stable")
        first = before - np.concatenate([[0], np.cumsum(here)[:-1]])
        number = np.empty(BLOCK, np.int64)
        number[by_dataset] = np.arange(BLOCK) + first[dataset[by_dataset]]
        return dataset, number
