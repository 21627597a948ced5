"""Simulators by package, behind one interface (`episode.Simulator`).

Every module knows one package. Import nothing from here before `packages.prepare_process`.
"""

from __future__ import annotations

import importlib

from data_pipelines.simulators.episode import Simulator
from data_pipelines.simulators.spec import SimSpec


def open_simulator(spec: SimSpec, size: int) -> Simulator:
    """A simulator of `spec` that draws frames of `size` x `size`; close it after use."""
    backend = importlib.import_module(f"data_pipelines.simulators.backends.{spec.backend}_backend")
    return backend.Backend(spec, size)
