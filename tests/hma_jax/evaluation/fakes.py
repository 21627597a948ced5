"""Frozen windows of the tiny world, and a decoder that turns ids into grey."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import DecodeConfig, EvalConfig, ExecutionConfig, MeshConfig, ModelConfig
from hma_jax.evaluation.evaluate import Evaluation, evaluate
from hma_jax.model.embodiments import EmbodimentTable
from tests.tiny import TABLE, lively_params, model_config, random_batch

SIZE = 8


class GreyTokenizer:
    """Decodes tokens to flat grey images whose level follows their mean: enough for pixel metrics."""

    params = {"scale": np.float32(4.0)}

    def __init__(self, piece: int = 64):
        self.piece = piece

    def decode_uint8_fn(self, params: Any, tokens: jax.Array) -> jax.Array:
        mean = tokens.astype(jnp.float32).reshape(len(tokens), -1).mean(1)
        level = jnp.round(jnp.clip(params["scale"] * mean, 0, 255)).astype(jnp.uint8)
        return jnp.broadcast_to(level[:, None, None, None], (len(tokens), SIZE, SIZE, 3))

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        return np.asarray(jax.jit(self.decode_uint8_fn)(self.params, tokens))


def make_window(number: int, config: ModelConfig, name: str, table: EmbodimentTable = TABLE) -> dict[str, Any]:
    """A row of a batch; the same window whatever `table` has besides. Two windows of one episode."""
    known = EmbodimentTable(tuple(e for e in TABLE.entries if e.name == name))
    row = {key: x[0] for key, x in random_batch(number, config, 1, known).items()}
    actions = np.zeros((config.frames, table.action_width), np.float32)
    actions[:, : known.action_width] = row["actions"]
    images = np.random.default_rng(number).integers(0, 255, (config.frames, SIZE, SIZE, 3))
    return row | {
        "actions": actions,
        "embodiment": np.int32(table.index(name)),
        "images": images.astype(np.uint8),
        "dataset": name,
        "episode": np.int32(number // 2),
        "start": np.int32(number % 2 * 12),
    }


def make_batches(
    config: ModelConfig, names=("pusher", "arm"), batch: int = 4, each: int = 6, table: EmbodimentTable = TABLE
) -> Iterator[dict[str, Any]]:
    """`each` windows per dataset in batches that may hold windows of two, the last padded."""
    rows = [make_window(number, config, name, table) for name in names for number in range(each)]
    for at in range(0, len(rows), batch):
        part = rows[at : at + batch]
        padded = part + part[-1:] * (batch - len(part))
        columns = {key: [row[key] for row in padded] for key in padded[0]}
        dataset = columns.pop("dataset")
        yield {key: np.stack(x) for key, x in columns.items()} | {
            "dataset": dataset, "valid": np.arange(batch) < len(part)
        }  # fmt: skip


def evaluate_on(mesh: MeshConfig, each: int, batch: int) -> tuple[Evaluation, list[int]]:
    """(the tiny model evaluated on a mesh, windows done after each batch): `each` windows of two robots."""
    config, seen = model_config(), []
    evaluation = evaluate(
        lively_params(config)[1],
        config,
        TABLE,
        GreyTokenizer(piece=3),
        make_batches(config, names=("base", "arm"), each=each, batch=batch),
        EvalConfig(prompt_frames=2, random_actions=2, decode=DecodeConfig(2, temperature=0.5)),
        execution=ExecutionConfig(windows_at_once=1, mesh=mesh),
        progress=seen.append,
    )
    return evaluation, seen
