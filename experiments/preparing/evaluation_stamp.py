"""A stamp beside the results of `hma evaluate`: the model, windows and protocol that they belong to. Other results
replace them only on request."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.preparing.made_from import MadeFrom, dataset_differences, differences, read_stamp
from hma_jax.config import ConfigError, EvalConfig
from hma_jax.config.json import from_dict, identity_of, stable_hash, to_dict

if TYPE_CHECKING:
    from experiments.running.run_trial import PreparedData
    from hma_jax.training.runs import Run

STAMP = "evaluation.made_from.json"

NOISING_STEPS = "noising_steps"
"""What is recorded of a model on latents: the steps of its noising process, with which its loss is to be compared."""

FORMERLY_NAMED = frozenset(
    "weight_cap time_shift recall chain_factors own_past_rounds displaced_past change_weight matrices".split()
)
"""Fields that earlier versions hashed whatever their value. Fields that are added later are not among them."""


def describe_evaluation(trained: Run, names: Sequence[str], prepared: PreparedData, config: EvalConfig) -> MadeFrom:
    """The stamp of an evaluation on the windows of the datasets `names`.

    The step is only recorded, not compared: if a run trains on, later results replace earlier ones. For `hma compare`,
    the planned number of training steps is recorded too, and the seed and `NOISING_STEPS`, which are also part of the
    model's hash.
    """
    chosen = {d.dataset: d.windows for d in prepared.manifest.datasets}
    data = {
        name: {
            "tokens": prepared.store.hash((name,)),
            "windows": len(chosen[name]),
            "chosen": stable_hash(chosen[name]),
        }
        for name in names
    }
    inputs = {
        "model": _hash_model(trained),
        "weights": trained.weights,
        "tokenizer": prepared.tokenizer.identity,
        "frames": prepared.manifest.frames,
        "rate": prepared.manifest.rate,
        "eval": _protocol(to_dict(config)),
        "datasets": sorted(names),
        "data": data,
    }
    recorded = {"step": trained.step}
    if "loader" in trained.provenance:  # a converted model does not record them
        recorded |= {"steps": trained.train.steps, "seed": trained.train.seed}
    if trained.model.diffusion:
        recorded[NOISING_STEPS] = trained.model.diffusion.steps
    return MadeFrom(inputs, recorded)


def _hash_model(trained: Run, named: Collection[str] = ()) -> str:
    """A hash of what a run was trained to be, independent of its number of steps."""
    model, train = (identity_of(config, named) for config in (trained.model, trained.train))
    del train["steps"]
    return stable_hash({"model": model, "train": train, "provenance": trained.provenance})


def require_same_evaluation(place: Path, wanted: MadeFrom, trained: Run) -> None:
    """Raises ConfigError if `place` holds results of an evaluation other than `wanted`, which is that of `trained`."""
    existing = read_stamp(place, STAMP)
    if existing is not None:
        known = existing.inputs | {"eval": _protocol(existing.inputs.get("eval", {}))}
        formers = (FORMERLY_NAMED, FORMERLY_NAMED - {"displaced_past"})  # the first versions did not have this one
        if known.get("model") in [_hash_model(trained, named) for named in formers]:
            known["model"] = wanted.inputs["model"]
        lines = differences(known, wanted.inputs)
    else:
        lines = _differences_of_windows(place, wanted)
    if lines:
        raise ConfigError(
            f"{place}: the existing results are from another evaluation (there -> asked for):\n  "
            + "\n  ".join(lines)
            + (
                "\nNothing was changed. Write the new results elsewhere with --to DIR, or overwrite the existing ones "
                "with --replace."
            )
        )


def _protocol(values: dict[str, Any]) -> dict[str, Any]:
    """The protocol as this version writes it, with the default batch, on which no result depends."""
    return to_dict(replace(from_dict(EvalConfig, values), batch=EvalConfig.batch))


def _differences_of_windows(place: Path, wanted: MadeFrom) -> list[str]:
    """For results of an earlier version, which have no stamp: lines on differences in datasets and in the number of
    windows of each."""
    from hma_jax.evaluation.windows import FILE, WindowTable

    try:
        existing = WindowTable.load(place / FILE)
    except ConfigError:  # none, or no use
        return []
    lines = dataset_differences(sorted(existing.datasets), wanted.inputs["datasets"])
    for name, facts in wanted.inputs["data"].items():
        count = len(existing.of(name))
        if count not in (0, facts["windows"]):
            lines.append(f"windows of {name}: {count} -> {facts['windows']}")
    return lines
