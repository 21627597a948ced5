"""Applies the protocol to a trained model: batches in, a table of windows out.

One compiled call per batch predicts, decodes and compares. The batch is split over the devices of the mesh, which
compute some windows at a time (`execution.windows_at_once`). Only numbers per window are returned; those of one batch
are read while the devices work on the next.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import jax
import numpy as np
from einops import rearrange
from jax.sharding import Mesh, PartitionSpec

from hma_jax.config import EvalConfig, ExecutionConfig, MaskingSetting, MeshConfig, ModelConfig, require
from hma_jax.evaluation.images import Decoder, Sample, ToImages, image_metrics, make_clips
from hma_jax.evaluation.lpips import load_lpips
from hma_jax.evaluation.parts import Part, Parts
from hma_jax.evaluation.protocol import Predicted, make_predictor
from hma_jax.evaluation.summary import Summary, summarise
from hma_jax.evaluation.windows import WindowTable, join
from hma_jax.model.embodiments import ActionUnits, EmbodimentTable
from hma_jax.model.given import require_known
from hma_jax.model.hma import declare_model
from hma_jax.model.params import Params, inference_params, require_params
from hma_jax.runtime.audit import param_shardings
from hma_jax.runtime.mesh import make_mesh, mesh_sizes
from hma_jax.runtime.processes import broadcast_from_writer, compiled_by_all
from hma_jax.runtime.rows import lay_out, split_rows
from hma_jax.runtime.sharding import BATCH, batch_sharding, batch_ways, constrain, replicated

T = TypeVar("T")

REQUIRED_ARRAYS = ("tokens", "actions", "embodiment", "episode", "start", "images")
"""Arrays of a batch that go to the devices."""

STATISTICS = ("action_mean", "action_std")
"""Further arrays, by default made from the table's statistics."""

OPTIONAL_ARRAYS = ("real", "other_actions", "other_valid", "other_images", "other_seen")
"""Further arrays, where a batch has them."""

WHOLE = 1 / 8
"""Parameters that take at most this share of a device's memory are not split along `fsdp` (`evaluation_mesh`)."""

MetricParams = tuple[Params, Params | None]
"""Parameters that metrics need: those of the tokenizer, which decodes tokens to images, and those of `lpips`, where it
is configured."""


@dataclass(frozen=True)
class Evaluation:
    """Every window's numbers, their means with errors, and a few clips to look at."""

    windows: WindowTable = field(repr=False)
    summary: Summary
    samples: dict[str, dict[str, np.ndarray]] = field(
        repr=False
    )  # {dataset: {kind: uint8 [n, T, H, W, 3]}}, see `images.make_clips`


def evaluate(
    params: Params,
    model: ModelConfig,
    table: EmbodimentTable,
    tokenizer: Decoder,
    batches: Iterable[dict[str, Any]],
    config: EvalConfig,
    *,
    setting: MaskingSetting = "forward",
    execution: ExecutionConfig = ExecutionConfig(),
    samples_per_dataset: int = 1,
    progress: Callable[[int], None] | None = None,
    parts: Parts | None = None,
) -> Evaluation:
    """Applies the protocol to `batches`, equal in shape.

    A batch holds `protocol.Batch`, images (uint8 [B, T, H, W, 3], recorded), dataset (the name of each row's dataset)
    and valid (bool [B]: rows that are not padding); all batches have the same optional arrays. `setting` is what the
    model was trained for. `progress` is called with the number of windows done so far. Batches that are in `parts` are
    not measured again, and the results of the others are added to it. With several processes (`runtime.processes`) all
    call this with the same batches, and each gets the whole result; `parts` is then not used. A model that was trained
    only for actions has no metrics of frames and no samples. Raises ConfigError if there is no window, for incomplete
    batches, unknown ids or robots and parameters of another model, for a model whose predictions are not finite, or as
    `make_predictor` and `lpips.load_lpips`.
    """
    # The robots' statistics are not constants of the program, so that models trained on other episodes share it.
    known, means, stds = table.standardised(), *table.statistics()
    declared = declare_model(model, known, execution)
    require_params(declared, params, "these parameters are not those of the model")
    params = inference_params(declared, params, execution.dtype)  # once, and not in every pass
    execution = replace(execution, mesh=evaluation_mesh(execution.mesh, params))
    mesh = make_mesh(execution.mesh)
    evaluator = make_evaluator(model, known, config, setting, execution, tokenizer.decode_uint8_fn, tokenizer.piece)
    weights = lay_out(params, param_shardings(declared, mesh, execution.mesh))
    metric_params = (tokenizer.params, load_lpips() if config.lpips else None)
    metric_params, units = lay_out((metric_params, table.scale()), replicated(mesh))

    if jax.process_count() > 1:  # processes would have to agree on what each finds on its disk
        parts = None

    def dispatched() -> Iterator[tuple[dict[str, Any], Part | tuple[dict[str, jax.Array], Predicted | None]]]:
        compiled = None
        for n, batch in enumerate(batches):
            if parts is not None and (part := parts.read(n)) is not None:
                yield batch, part
                continue
            missing = [name for name in (*REQUIRED_ARRAYS, "dataset", "valid") if name not in batch]
            require(not missing, f"a batch to evaluate lacks {', '.join(missing)}")
            require_known(model, table, *(np.asarray(batch[name]) for name in ("tokens", "actions", "embodiment")))
            groups, rows = plan_groups(len(batch["valid"]), execution.windows_at_once, batch_ways(mesh))
            _check_lengths(batch, config, setting)
            robots = np.asarray(batch["embodiment"])
            given = {"action_mean": means[robots], "action_std": stds[robots]} | batch
            arrays = (*REQUIRED_ARRAYS, *STATISTICS, *(name for name in OPTIONAL_ARRAYS if name in batch))
            on_devices = _put({name: given[name] for name in arrays}, groups * rows, mesh)
            with jax.set_mesh(mesh):
                if compiled is None:
                    compiled = compiled_by_all("evaluation", evaluator, weights, metric_params, units, on_devices)
                found = compiled(weights, metric_params, units, on_devices)
            yield batch, found

    tables: list[WindowTable] = []
    samples: dict[str, list[Sample]] = {}
    for n, (batch, found) in enumerate(one_ahead(dispatched())):
        if isinstance(found, Part):
            part = found
        else:
            left = {name: samples_per_dataset - len(samples.get(name, ())) for name in set(batch["dataset"])}
            part = Part(_rows_of(batch, found[0]), _samples(batch, found[1], left))
            if parts is not None:
                parts.add(n, part)
        tables.append(part.windows)
        for name, sample in part.samples:
            samples.setdefault(name, []).append(sample)
        if progress is not None:
            progress(sum(map(len, tables)))
    windows = join(tables)
    require(len(windows) > 0, "the evaluation has no windows: all rows of its batches are padding")
    return Evaluation(windows, summarise(windows, config.perplexity_group), make_clips(tokenizer, samples))


def evaluation_mesh(config: MeshConfig, params: Params) -> MeshConfig:
    """The mesh to evaluate on: that of `config`, but with the devices of `fsdp` moved to `data` if each device can hold
    all parameters, because with `fsdp` every layer gathers its parameters again in every pass over a frame. Both meshes
    split the windows in the same way. All processes call this."""
    data, fsdp, tensor = mesh_sizes(config, jax.device_count())
    size = sum(x.nbytes for x in jax.tree.leaves(params)) / tensor
    device = jax.local_devices()[0]
    unknown = math.inf if device.platform == "cpu" else 0  # CPUs do not say, nor do GPUs with some of XLA's allocators
    memory = (device.memory_stats() or {}).get("bytes_limit", unknown)
    whole = broadcast_from_writer("evaluation_mesh", "whole" if size <= WHOLE * memory else "")
    return replace(config, data=data * fsdp, fsdp=1, tensor=tensor) if whole else config


@functools.lru_cache(maxsize=4)  # a second evaluation of the same shapes compiles nothing
def make_evaluator(
    model: ModelConfig,
    table: EmbodimentTable,
    config: EvalConfig,
    setting: MaskingSetting,
    execution: ExecutionConfig,
    to_images: ToImages,
    piece: int,
) -> Callable[[Params, MetricParams, ActionUnits, dict[str, jax.Array]], tuple[dict[str, jax.Array], Predicted | None]]:
    """A jitted f(parameters, MetricParams, ActionUnits, batch with images) -> (metrics {name: [B]}, Predicted).

    Runs under `jax.set_mesh`. `plan_groups` says how many of the B windows are in memory at a time; B is a multiple of
    that. Raises ConfigError as `make_predictor`.
    """
    mesh = make_mesh(execution.mesh)
    predict = make_predictor(model, table, config, setting, execution)

    def compare(
        metric_params: MetricParams, predicted: Predicted, recorded: tuple[jax.Array, jax.Array | None, Any]
    ) -> dict[str, jax.Array]:
        (decoder_params, lpips_params), (images, real, others) = metric_params, recorded
        return image_metrics(to_images, piece, decoder_params, predicted, images, config, real, others, lpips_params)

    def evaluate_group(params: Params, metric_params: MetricParams, units: ActionUnits, batch: dict[str, jax.Array]):
        batch = {name: constrain(x, ("B", *(None,) * (x.ndim - 1))) for name, x in batch.items()}
        metrics, predicted = predict(params, batch, units)
        if predicted is None:
            return metrics, None
        others = (batch["other_images"], batch["other_seen"]) if "other_images" in batch else None
        recorded = batch["images"], batch.get("real"), others
        compared = _on_each_device(compare, mesh)(metric_params, predicted, recorded)
        return metrics | compared | {"finite": metrics["finite"] & compared["finite"]}, predicted

    def evaluate_batch(params: Params, metric_params: MetricParams, units: ActionUnits, batch: dict[str, jax.Array]):
        groups, _ = plan_groups(len(batch["tokens"]), execution.windows_at_once, batch_ways(mesh))
        return in_groups(lambda rows: evaluate_group(params, metric_params, units, rows), batch, groups)

    return jax.jit(evaluate_batch, out_shardings=replicated(mesh))


def _check_lengths(batch: dict[str, Any], config: EvalConfig, setting: MaskingSetting) -> None:
    """Raises ConfigError for a window without a frame to compare or, for a model that predicts no frames, without an
    action."""
    if "real" not in batch:
        return
    least = config.first_predicted + (setting != "policy")  # with "policy" the last chunk follows the last frame
    real = np.where(batch["valid"], np.sum(batch["real"], axis=1), least)
    row = int(np.argmin(real))
    if config.context == "generated":
        what = f"eval.prompt_frames {config.prompt_frames}"
        advice = "freeze windows for this prompt, or use a shorter one"
    else:
        what, advice = "eval.context recorded", "freeze windows of at least 2 frames"
    require(
        real[row] >= least,
        f"a window of {batch['dataset'][row]} has {real[row]} frames, so with {what} there is nothing to predict; "
        f"{advice}",
    )


def _samples(
    batch: dict[str, Any], predicted: Predicted | None, left: dict[str, int]
) -> tuple[tuple[str, Sample], ...]:
    """The first windows of each dataset, at most as many as are `left` to take; none for a model that predicts no
    frames."""
    found = []
    for row in np.flatnonzero(batch["valid"]).tolist() if predicted is not None else ():
        name = str(batch["dataset"][row])
        if left[name] > 0:
            left[name] -= 1
            found.append((name, _sample(batch, predicted, row)))
    return tuple(found)


def _sample(batch: dict[str, Any], predicted: Predicted, row: int) -> Sample:
    """One window of a batch on the host, with its padding frames replaced by its last real frame."""
    real = batch["real"][row] if "real" in batch else np.ones(len(batch["images"][row]), bool)

    def held(clips: Any) -> np.ndarray:
        # The whole array is fetched: a row picked on the devices would wait for the next batch.
        return hold_last_frame(np.asarray(clips)[row], real)

    random = None if predicted.random is None else held(predicted.random)
    sample = Sample(held(batch["images"]), held(predicted.tokens), random)
    if predicted.other is None or not batch["other_seen"][row]:
        return sample
    return sample._replace(other=held(predicted.other), other_images=held(batch["other_images"]))


def hold_last_frame(clip: np.ndarray, real: np.ndarray) -> np.ndarray:
    """The last n frames of a window of len(real) frames, [n, ...], with padding replaced by the last real frame."""
    first = len(real) - len(clip)
    return clip[np.minimum(np.arange(len(clip)), int(real.sum()) - 1 - first)]


def plan_groups(rows: int, at_once: int, ways: int) -> tuple[int, int]:
    """(groups, rows of each group): groups of at most `at_once` rows per device that hold `rows` rows with few left
    over."""
    groups = -(-rows // (at_once * ways))
    return groups, -(-rows // (groups * ways)) * ways


def in_groups(function: Callable[[Any], Any], batch: Any, groups: int) -> Any:
    """`function`, which maps rows to rows, over groups of a batch's rows (`split_rows`), one group after the other."""
    if groups == 1:
        return function(batch)
    found = jax.lax.map(function, split_rows(batch, groups))
    return jax.tree.map(lambda x: rearrange(x, "g b ... -> (b g) ..."), found)


def one_ahead(items: Iterable[T]) -> Iterator[T]:
    """The same items, each yielded after the next one was dispatched."""
    waiting: list[T] = []
    for item in items:
        waiting.append(item)
        if len(waiting) == 2:
            yield waiting.pop(0)
    yield from waiting


def _on_each_device(function: Callable[..., Any], mesh: Mesh) -> Callable[..., Any]:
    """`function` (parameters, rows, rows) -> rows, applied by every device to its own rows.

    The compiler would not split loops over pieces of a batch by itself.
    """
    if batch_ways(mesh) == 1:
        return function
    whole, rows = PartitionSpec(), PartitionSpec(BATCH)
    return jax.shard_map(function, mesh=mesh, in_specs=(whole, rows, rows), out_specs=rows)


def _put(batch: dict[str, np.ndarray], rows: int, mesh: Mesh) -> dict[str, jax.Array]:
    """A batch, which is the same in every process, split over the devices; its last row is repeated up to `rows`
    rows."""
    sharding = batch_sharding(mesh)

    def put(x: np.ndarray) -> jax.Array:
        padded = np.concatenate([x, np.repeat(x[-1:], rows - len(x), axis=0)])
        return jax.make_array_from_callback(padded.shape, sharding, lambda index: padded[index])

    return {name: put(np.asarray(x)) for name, x in batch.items()}


def _rows_of(batch: dict[str, Any], found: dict[str, jax.Array]) -> WindowTable:
    """The windows of a batch, without its padding. Waits for the devices. Raises ConfigError."""
    valid = np.flatnonzero(batch["valid"])
    columns = {name: np.asarray(x)[valid] for name, x in found.items()}
    dataset = np.asarray(batch["dataset"], str)[valid]
    finite = columns.pop("finite")
    require(
        bool(finite.all()),
        f"predictions are not finite ({', '.join(sorted(set(dataset[~finite])))}); did the model diverge?",
    )
    episode, start = (np.asarray(batch[name], np.int64)[valid] for name in ("episode", "start"))
    real = batch.get("real", np.ones(np.shape(batch["tokens"])[:2], bool))
    frames = np.sum(real, axis=1, dtype=np.int64)[valid]
    return WindowTable(dataset, episode, start, frames, {m: np.asarray(x, np.float64) for m, x in columns.items()})
