"""Configurations as earlier versions wrote them, in today's fields."""

from __future__ import annotations

from typing import Any

from hma_jax.config.execution import FORMER_FIELDS

EXECUTION = {
    "compute_dtype": ("dtype", {}),
    "remat": ("remat", {True: "everything", False: "products"}),
    "attention": ("attention", {"by_frame": "auto", "whole": "plain"}),
    "accumulate": ("accumulate", {}),
}
"""What was said of the model or its training and is execution today: the field, and its values in today's words."""

DECODING = ("unmask_steps", "sampler")
"""Fields of `eval` that are of `eval.decode` today."""


def modernise(config: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """(a trial's or study's fields as they are called today, what it said of its execution).

    Fields that came later are left to their defaults. Raises KeyError or TypeError for what is neither.
    """
    today = {**config, **{name: {**config[name]} for name in ("model", "train", "eval")}}
    said = {key: today[name].pop(key) for name, keys in FORMER_FIELDS.items() for key in keys if key in today[name]}
    fields = {key: EXECUTION[key] for key in said}
    execution = {field: words.get(said[key], said[key]) for key, (field, words) in fields.items()}
    decoding = {key: today["eval"].pop(key) for key in DECODING if key in today["eval"]}
    if decoding:
        today["eval"]["decode"] = today["eval"].get("decode", {}) | decoding
    return today, execution
