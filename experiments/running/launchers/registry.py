"""The launchers by name, and the launcher that the options of the command line describe."""

from __future__ import annotations

import importlib
import importlib.util
import json
import typing
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from experiments.running.launchers.base import Launcher
from hma_jax.config import ConfigError, require
from hma_jax.config.json import from_dict
from hma_jax.runtime.cores import usable_cores

LAUNCHERS = {
    "local": "experiments.running.launchers.local:LocalLauncher",
    "slurm": "experiments.running.launchers.slurm:SlurmLauncher",
    "ray": "experiments.running.launchers.ray:RayLauncher",
}
"""Module and class of each; imported when it is used."""


@dataclass(frozen=True)
class LauncherOptions:
    """The launcher's options on the command line. Raises ConfigError for an unknown launcher or setting."""

    name: str = "local"
    workers: int | None = None  # trials at a time
    settings: tuple[str, ...] = ()  # 'key=value'

    def __post_init__(self):
        self._parsed()

    def _parsed(self) -> tuple[type[Launcher], Any]:
        kind = launcher_class(self.name)
        return kind, parse_settings(self.name, kind.Settings, self.settings)

    @property
    def at_once(self) -> int | None:
        """Trials at a time; None: as many as the cluster has room for (`Launcher.limit`)."""
        kind, settings = self._parsed()
        return kind.limit(self.workers, settings)

    def share(self) -> float | None:
        """How many accelerators each trial gets (`Launcher.share`)."""
        kind, settings = self._parsed()
        return kind.share(self.workers, settings)

    def cores_each(self) -> float:
        """The share of a core that each trial gets if more trials than there are cores run on this machine's CPU;
        otherwise 1."""
        if self.name != "local" or self.share() is not None:
            return 1.0
        return min(usable_cores() / (self.at_once or 1), 1.0)

    def require_installed(self) -> None:
        """Raises ConfigError without the package that the launcher works through."""
        needs = launcher_class(self.name).needs
        installed = not needs or importlib.util.find_spec(needs) is not None
        require(installed, f"--launcher {self.name} needs {needs}: pip install 'hma-jax[{self.name}]'")

    def launcher(self, root: Path) -> Launcher:
        """The launcher for the study in `root`. Raises ConfigError if it cannot work."""
        self.require_installed()
        kind, settings = self._parsed()
        return kind(root, self.workers, settings)


def launcher_class(name: str) -> type[Launcher]:
    require(name in LAUNCHERS, f"--launcher {name}: choose one of {', '.join(LAUNCHERS)}")
    module, _, attribute = LAUNCHERS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)


def parse_settings(name: str, kind: type, settings: Sequence[str]) -> Any:
    """An instance of `kind` from 'key=value' strings; a key whose value is a list may be given several times."""
    hints, known = typing.get_type_hints(kind), ", ".join(f.name for f in fields(kind)) or "none"
    values: dict[str, Any] = {}
    for setting in settings:
        key, separator, text = setting.partition("=")
        flag = f"--launcher-set {setting}"
        require(bool(separator), f"{flag}: write it as key=value; the {name} launcher has {known}")
        require(key in hints, f"{flag}: the {name} launcher has no such setting; it has {known}")
        if typing.get_origin(hints[key]) is tuple:
            values[key] = [*values.get(key, ()), text]
        elif str in (hints[key], *typing.get_args(hints[key])):
            values[key] = text
        else:
            try:
                values[key] = json.loads(text)
            except ValueError:
                raise ConfigError(f"{flag}: expected a number") from None
    return from_dict(kind, values, f"--launcher-set of {name}")
