"""From which dataset each example is drawn, as a pure function of (seed, position): stratified sampling in blocks.

The number of draws of each dataset before a block follows from the weights and the block's number alone. The
difference between two such counts is what the block holds, in an order shuffled by a hash of (seed, block). So every
draw of a dataset has a running number, and two things follow that independent draws lack: its shuffled order visits
each window once per epoch, and counts deviate from their expectation by a few at most, which matters for datasets of
small weight. Finding any position requires computing one block.
DIFFERS: the release draws datasets and windows with replacement, the same in every epoch (reference section 4.3).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_pipelines.sampling.order import hash64, stream_seed

BLOCK = 512
"""Draws per block: several batches of most sizes, so that batches vary nearly as much as with independent draws."""

_BITS = 48
"""Bits of a share as a fixed-point number: weights are exact to 1e-14, and all arithmetic is in integers."""


class Draws:
    """The draws of datasets with `weights` (float [D], sum 1), in blocks."""

    def __init__(self, weights: Sequence[float], seed: int | str):
        rest = np.cumsum(np.asarray(weights, np.float64)[::-1])[::-1]  # weight of a dataset and those after it
        nothing = np.zeros(len(rest))  # if no weight remains, earlier datasets take all draws
        shares = np.minimum(np.divide(weights, rest, out=nothing, where=rest > 0), 1.0)
        shares[-1] = 1.0
        self._shares = [round(float(share) * (1 << _BITS)) for share in shares]
        self._seed = stream_seed("mixture", seed)
        offsets = hash64(np.arange(len(shares)), stream_seed("mixture", seed, "rounding"))
        self._offsets = [int(offset) >> (64 - _BITS) for offset in offsets]

    def counts(self, block: int) -> np.ndarray:
        """int64 [D]: draws of each dataset before `block`; their sum is block x BLOCK.

        Each dataset takes its share of the draws that the datasets before it left over, rounded with an offset of its
        own. Neither number ever decreases from block to block, so no block has a negative count.
        """
        left, counts = block * BLOCK, []
        for share, offset in zip(self._shares, self._offsets, strict=True):
            counts.append((left * share + offset) >> _BITS)
            left -= counts[-1]
        return np.asarray(counts, np.int64)

    def at(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(dataset, number of the draw within it), both int64 like `positions`, int64 [N]."""
        blocks, slots = np.divmod(np.asarray(positions, np.int64), BLOCK)
        dataset, number = np.empty_like(blocks), np.empty_like(blocks)
        for block in np.unique(blocks).tolist():
            here = blocks == block
            datasets, numbers = self._block(block)
            dataset[here], number[here] = datasets[slots[here]], numbers[slots[here]]
        return dataset, number

    def _block(self, block: int) -> tuple[np.ndarray, np.ndarray]:
        """(dataset, number of the draw within it) for all positions of a block."""
        before = self.counts(block)
        here = self.counts(block + 1) - before
        shuffled = np.argsort(hash64(np.arange(BLOCK), hash64(block, self._seed)), kind="stable")
        dataset = np.repeat(np.arange(len(here)), here)[shuffled]
        by_dataset = np.argsort(dataset, kind="stable")
        first = before - np.concatenate([[0], np.cumsum(here)[:-1]])
        number = np.empty(BLOCK, np.int64)
        number[by_dataset] = np.arange(BLOCK) + first[dataset[by_dataset]]
        return dataset, number
