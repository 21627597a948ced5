"""What a trial's numbers depend on besides the trial itself: data, tokenizer and sources.

The data's hashes come from `pipeline`, which prepares it; that of the sources is made here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from hma_jax.config.json import stable_hash


@dataclass(frozen=True)
class Provenance:
    """An identity for each of them; a trial with another one is another trial."""

    store: str  # hash of the token store
    manifest: str  # hash of the evaluation manifest
    tokenizer: str  # identity of the tokenizer
    code: str  # hash of the sources


@cache
def source_hash(paths: tuple[str, ...] = ("hma_jax", "data_pipelines", "experiments/trial.py")) -> str:
    """Hash of the sources under `paths`, folders or files; by default those that a trial runs.

    Plots, reports and the command line are left out of these: changing them re-runs nothing.
    """
    root = Path(__file__).resolve().parent.parent
    files = [p for path in paths for p in (sorted((root / path).rglob("*.py")) or [root / path])]
    return stable_hash([[p.relative_to(root).as_posix(), p.read_text()] for p in files])
