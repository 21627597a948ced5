"""Reference cases: numbers made by running the official PyTorch release (HMA, Apache-2.0).

A case is a folder: settings, inputs, expected outputs with their tolerances, a README. Models are
read by the same conversion as users' checkpoints.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.convert import read_official
from hma_jax.convert.table import official_parts, to_official
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.model.params import Declared, Params
from hma_jax.training.runs import Run

RTOL = 1e-4


@dataclass(frozen=True)
class Finding:
    """How one output compares. `error` is the largest absolute one, `allowed` the absolute tolerance.

    Not `good` and not bad (None): a remark on what is not compared, and why.
    """

    output: str
    good: bool | None
    error: float | None = None
    allowed: float | None = None
    note: str = ""

    def __str__(self) -> str:
        numbers = "" if self.error is None else f"  max error {self.error:.2e}"
        if self.allowed is not None:
            numbers += f"  atol {self.allowed:.0e}"
        verdict = {True: "ok  ", False: "FAIL", None: "note"}[self.good]
        return f"  {verdict} {self.output}{numbers}{'  ' + self.note if self.note else ''}"


class Case:
    """One folder, and what has been found about its outputs."""

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self.name = self.folder.resolve().name
        self.info: dict[str, Any] = self._json("case.json")
        self.settings: dict[str, Any] = self._json("config.json")
        self.inputs, self.outputs = self._arrays("inputs.npz"), self._arrays("outputs.npz")
        self.findings: list[Finding] = []
        self.checked: set[str] = set()

    def _json(self, name: str) -> dict[str, Any]:
        path = self.folder / name
        return json.loads(path.read_text()) if path.exists() else {}

    def _arrays(self, name: str) -> dict[str, np.ndarray]:
        path = self.folder / name
        return dict(np.load(path)) if path.exists() else {}

    # --- The model -----------------------------------------------------------------------------

    @cached_property
    def run(self) -> Run:
        return read_official(self.folder)

    @property
    def table(self) -> EmbodimentTable:
        return self.run.table

    @cached_property
    def declared(self) -> Declared:
        return declare_model(self.run.model, self.table)

    @cached_property
    def params(self) -> Params:
        return jax.tree.map(jnp.asarray, self.run.params)

    @property
    def domains(self) -> list[str]:
        return self.info["domains"]

    def actions(self, name: str) -> np.ndarray:
        """Recorded chunks `actions__NAME`, padded to U."""
        actions = self.inputs[f"actions__{name}"]
        missing = self.table.action_width - actions.shape[-1]
        return np.pad(actions, ((0, 0), (0, 0), (0, missing)))

    def robot(self, name: str, batch: int) -> np.ndarray:
        return np.full(batch, self.table.index(name), np.int32)

    def official(self, params: Params) -> dict[str, np.ndarray]:
        """Official name -> array of parameters, or of gradients."""
        return to_official(params, official_parts(self.run.model, self.table, self.declared.leaves()))

    # --- Comparing -----------------------------------------------------------------------------

    def check(self, output: str, got: Any, via: str = "") -> None:
        """|got - want| <= atol + rtol |want| with the case's own tolerance; integers exactly.

        What the case does not have is not compared; what it has and nobody checked is `unchecked`.
        """
        if output not in self.outputs:
            return
        tolerance = self.info.get("tolerance", {}).get(output, {"atol": 0.0, "rtol": RTOL})
        self.checked.add(output)
        self.compare(output, got, self.outputs[output], tolerance["atol"], tolerance["rtol"], via)

    def compare(self, label: str, got: Any, want: Any, atol: float, rtol: float = 0.0, via: str = "") -> None:
        label = f"{label} ({via})" if via else label
        got, want = np.asarray(got), np.asarray(want)
        if got.shape != want.shape:
            self.add(Finding(label, False, note=f"shape {got.shape}, expected {want.shape}"))
            return
        if want.dtype.kind in "iub":
            wrong = int((got.astype(np.int64) != want.astype(np.int64)).sum())
            note = f"{wrong} of {want.size} differ" if wrong else "exact"
            self.add(Finding(label, wrong == 0, note=note))
            return
        error = np.abs(np.asarray(got, np.float64) - np.asarray(want, np.float64))
        good = bool((error <= atol + rtol * np.abs(want)).all())  # False for nan
        self.add(Finding(label, good, float(error.max(initial=0.0)), atol))

    def add(self, finding: Finding) -> None:
        self.findings.append(finding)

    def check_group(self, prefix: str, got: dict[str, np.ndarray]) -> None:
        """All outputs `PREFIX::NAME` against got[NAME]; those of one prefix make one line while good."""
        names = [key for key in self.outputs if key.startswith(f"{prefix}::")]
        before = len(self.findings)
        for key in names:
            name = key.removeprefix(f"{prefix}::")
            if name in got:
                self.check(key, got[name])
        added = self.findings[before:]
        if added and all(f.good for f in added):
            worst = max(added, key=lambda f: f.error or 0.0)
            del self.findings[before:]
            note = f"largest: {worst.output}"
            self.add(Finding(f"{prefix}::* ({len(added)})", True, worst.error, worst.allowed, note))

    def check_zero(self, arrays: dict[str, np.ndarray], names: Iterable[str]) -> None:
        """Gradients of parameters that the release says have no influence."""
        wrong = [n for n in names if n not in arrays or np.any(arrays[n] != 0)]
        note = f"not zero: {', '.join(wrong[:5])}" if wrong else "zero gradient"
        self.add(Finding("unused_parameters", not wrong, note=note))

    def unchecked(self) -> list[str]:
        return sorted(set(self.outputs) - self.checked)


def norms(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {n: np.sqrt(np.sum(np.square(x, dtype=np.float64))).astype(np.float32) for n, x in arrays.items()}
