"""A stamp beside the results of `hma evaluate`: the model, windows and protocol that they belong to. Other results
replace them only on request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.preparing.made_from import MadeFrom, differences, read_stamp
from hma_jax.config import ConfigError, EvalConfig, require
from hma_jax.config.json import from_dict, identity_of, stable_hash, to_dict

if TYPE_CHECKING:
    from experiments.running.run_trial import PreparedData
    from hma_jax.training.runs import Run

STAMP = "evaluation.made_from.json"

UNFINISHED = ".evaluation.tmp"
"""The directory in `place` in which the files of an evaluation are written before they are moved there."""

NOISING_STEPS = "noising_steps"
"""What is recorded of a model on latents: the steps of its noising process, with which its loss is to be compared."""


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


def _hash_model(trained: Run) -> str:
    """A hash of what a run was trained to be, independent of its number of steps."""
    model, train = (identity_of(config) for config in (trained.model, trained.train))
    del train["steps"]
    return stable_hash({"model": model, "train": train, "provenance": trained.provenance})


def require_same_evaluation(place: Path, wanted: MadeFrom) -> None:
    """Raises ConfigError if `place` holds results of an evaluation other than `wanted`, or results that do not say what
    they are of."""
    from hma_jax.evaluation.windows import FILE

    existing = read_stamp(place, STAMP) or read_stamp(place / UNFINISHED, STAMP)
    if existing is None:
        require(
            not (place / FILE).exists(),
            f"{place} holds results ({FILE}), but {STAMP}, which says of which model and evaluation they are, is missing "
            "or damaged. Nothing was changed. Write the new results elsewhere with --to DIR, or overwrite the existing "
            "ones with --replace.",
        )
        return
    known = existing.inputs | {"eval": _protocol(existing.inputs.get("eval", {}))}
    if lines := differences(known, wanted.inputs):
        raise ConfigError(
            f"{place}: the existing results are from another evaluation (there -> asked for):\n  "
            + "\n  ".join(lines)
            + "\nNothing was changed. Write the new results elsewhere with --to DIR, or overwrite the existing ones with "
            "--replace."
        )


def _protocol(values: dict[str, Any]) -> dict[str, Any]:
    """The protocol as this version writes it, with the default batch, on which no result depends."""
    return to_dict(replace(from_dict(EvalConfig, values), batch=EvalConfig.batch))
