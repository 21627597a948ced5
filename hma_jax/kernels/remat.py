"""What a block keeps for its backward pass.

Values worth keeping are tagged where they are made; `ExecutionConfig.remat` decides which tags are kept. All other
values are computed again. A tag does not change the value.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax.ad_checkpoint import checkpoint_name

from hma_jax.config.execution import Remat
from hma_jax.runtime.sharding import is_split

PRODUCT, COSTLY, INPUT, GATHERED = "product", "costly", "input", "gathered"


def tag_product(x: jax.Array) -> jax.Array:
    """Tags a matrix product, or a sum with one: it is costly to compute, and the backward pass reads it."""
    return checkpoint_name(x, PRODUCT)


def tag_costly(x: jax.Array) -> jax.Array:
    """Tags a result of attention, or the first product of an MLP: the costliest to compute for its size."""
    return checkpoint_name(x, COSTLY)


def tag_block_input(x: jax.Array) -> jax.Array:
    """Tags the input of a block."""
    return checkpoint_name(x, INPUT)


def tag_gathered(w: jax.Array) -> jax.Array:
    """Tags a weight that was gathered from several devices: it is never kept, but gathered again."""
    return checkpoint_name(w, GATHERED)


def checkpointed(block: Callable[..., Any], remat: Remat, scanned: bool) -> Callable[..., Any]:
    """`block` (carry, xs) -> (carry, ys), one of many, which keeps what `remat` says.

    `scanned`: it is the body of a loop, in which XLA cannot merge a second computation with the first.
    """
    policies = jax.checkpoint_policies
    if remat == "none":
        if not is_split():
            return block
        return jax.checkpoint(
            block, prevent_cse=not scanned, policy=policies.save_anything_except_these_names(GATHERED)
        )
    policy = {
        "products": policies.save_from_both_policies(_fused, policies.save_only_these_names(PRODUCT, COSTLY)),
        "attention": policies.save_from_both_policies(_fused, policies.save_only_these_names(COSTLY)),
        "everything": policies.nothing_saveable,
        "offload": policies.save_and_offload_only_these_names(
            names_which_can_be_saved=[],
            names_which_can_be_offloaded=[INPUT],
            offload_src="device",
            offload_dst="pinned_host",
        ),
    }[remat]
    return jax.checkpoint(block, prevent_cse=not scanned, policy=policy)


def _fused(primitive: Any, *_: Any, **__: Any) -> bool:
    """Whether `primitive` is cuDNN's kernel, whose saved values for the gradient carry no tag. JAX traces it under a
    name with a suffix."""
    return primitive.name.startswith("dot_product_attention_fwd")
