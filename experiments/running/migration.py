"""Migrates configurations that earlier versions wrote to today's fields."""

from __future__ import annotations

from typing import Any

from hma_jax.config.execution import FORMER_FIELDS

EXECUTION = {
    "compute_dtype": ("dtype", {}),
    "remat": ("remat", {True: "everything", False: "products"}),
    "attention": ("attention", {"by_frame": "auto", "whole": "plain"}),
    "accumulate": ("accumulate", {}),
}
"""Former fields of the model or its training that are fields of the execution today: the field, and today's names for
its former values."""

DECODING = ("unmask_steps", "sampler")
"""Former fields of `eval` that are fields of `eval.decode` today."""


def migrate(config: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """(a trial's or study's fields under today's names, the fields of its execution that were among them).

    Fields that were added later keep their defaults. Raises KeyError or TypeError for anything that is neither a trial
    nor a study.
    """
    today = {**config, **{name: {**config[name]} for name in ("model", "train", "eval")}}
    former = {key: today[name].pop(key) for name, keys in FORMER_FIELDS.items() for key in keys if key in today[name]}
    fields = {key: EXECUTION[key] for key in former}
    execution = {field: words.get(former[key], former[key]) for key, (field, words) in fields.items()}
    decoding = {key: today["eval"].pop(key) for key in DECODING if key in today["eval"]}
    if decoding:
        today["eval"]["decode"] = today["eval"].get("decode", {}) | decoding
    return today, execution
