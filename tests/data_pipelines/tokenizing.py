"""`tokenize_dataset` at 2 Hz, with the fields of HeldOut by name: most tests are about neither."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from data_pipelines.registry import FRAME_RATE
from data_pipelines.sampling.splits import HeldOut
from data_pipelines.tokens import tokenize_job
from data_pipelines.tokens.manifest import Manifest


def tokenize_dataset(*arguments: Any, rate: float | None = FRAME_RATE, **options: Any) -> Manifest | None:
    amounts = {field.name: options.pop(field.name) for field in fields(HeldOut) if field.name in options}
    return tokenize_job.tokenize_dataset(*arguments, held_out=HeldOut(**amounts), rate=rate, **options)
