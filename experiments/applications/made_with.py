"""What the results in a directory were made with: none is taken for one of other settings."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from data_pipelines.publishing.files import write_file
from hma_jax.config import require
from hma_jax.config.json import diff

FILE = "settings.json"


def claim(
    out: Path, run: Path, settings: Mapping[str, Any], *, grows: Collection[str] = (), file: str = FILE
) -> None:
    """Makes `out` the directory of what the model of `run` gives with `settings`. Fields that `grows` names say how
    many results there are: with others of these, those that are kept stay what they are.

    Raises ConfigError, naming the differences, where `out` holds what was made otherwise.
    """
    path, said = out / file, described(run, settings)
    if path.exists():
        known = json.loads(path.read_text())
        differences = [line for line in diff(known, said) if line.split(":")[0] not in grows]
        require(
            not differences,
            f"{out} holds results of other settings ({'; '.join(differences)}); choose another --out or remove it",
        )
        return
    write_settings(out, run, settings, file)


def write_settings(out: Path, run: Path, settings: Mapping[str, Any], file: str = FILE) -> None:
    """Where more results have been added."""
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / file, json.dumps(described(run, settings), indent=1) + "\n")


def described(run: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """As it is read again."""
    return json.loads(json.dumps({"run": run.resolve().name, **settings}))
