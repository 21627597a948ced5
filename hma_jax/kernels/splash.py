"""Attention on TPUs by the splash kernel of Pallas, which never writes the weights to memory.

Frames are padded to whole blocks of tokens. The kernel does not partition itself: on a mesh `shard_map` gives each
device its own examples and heads.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.kernels import plain, remat
from hma_jax.runtime.sharding import is_split, partition

BLOCK = 128
"""Tokens per block: as many as a vector register has lanes."""

MIN_TOKENS = 128
"""Frames of fewer tokens are left to `plain`: they would be mostly padding."""


def within(qkv: jax.Array, scale: float) -> jax.Array:
    """As `plain.within`."""
    if qkv.shape[2] < MIN_TOKENS:
        return plain.within(qkv, scale)

    def on_device(qkv: jax.Array) -> jax.Array:
        return _attend(qkv, scale)

    if is_split():
        mesh = jax.sharding.get_abstract_mesh()
        axes = ("B", None, None, None, "H", None)
        whole = partition(axes, qkv.shape, mesh)
        result = jax.sharding.PartitionSpec(*whole[:3], *whole[4:])
        on_device = jax.shard_map(on_device, mesh=mesh, in_specs=(whole,), out_specs=result, check_vma=False)
    return on_device(qkv)


def _attend(qkv: jax.Array, scale: float, interpret: bool = False) -> jax.Array:
    """With `interpret` the kernel is run step by step on any platform, for tests."""
    # Imported here and not with the module, which every process imports: Pallas takes an eighth of that time.
    from jax.experimental.pallas.ops.tpu import splash_attention

    batch, frames, tokens, _, heads, width = qkv.shape
    padded = -(-tokens // BLOCK) * BLOCK
    qkv = jnp.pad(qkv, [(0, 0)] * 2 + [(0, padded - tokens)] + [(0, 0)] * 3)
    q, k, v = (jnp.swapaxes(x.reshape(-1, padded, heads, width), 1, 2) for x in plain.split(qkv))
    visible = np.broadcast_to(np.arange(padded) < tokens, (padded, padded))
    mask = splash_attention.MultiHeadMask([splash_attention.NumpyMask(visible)] * heads)
    sizes = splash_attention.BlockSizes(
        block_q=BLOCK, block_kv=BLOCK, block_kv_compute=BLOCK,
        block_q_dkv=BLOCK, block_kv_dkv=BLOCK, block_kv_dkv_compute=BLOCK,
        block_q_dq=BLOCK, block_kv_dq=BLOCK,
    )  # fmt: skip
    kernel = splash_attention.make_splash_mha(
        mask,
        block_sizes=sizes,
        head_shards=1,
        q_seq_shards=1,
        residual_checkpoint_name=remat.COSTLY,
        interpret=interpret,
    )
    y = jax.vmap(kernel)(q * jnp.asarray(scale, q.dtype), k, v)
    return jnp.swapaxes(y, 1, 2)[:, :tokens].reshape(batch, frames, tokens, heads, width)
