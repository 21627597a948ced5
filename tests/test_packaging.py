"""What is installed: one version, and types that checkers of users' code read."""

import ast
import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import hma_jax

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_the_version_is_the_same_wherever_it_stands():
    (cited,) = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    latest = re.search(r"^## (\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1]
    assert PYPROJECT["project"]["version"] == hma_jax.__version__ == cited == latest


def test_checkers_and_editors_see_what_is_offered():
    """They do not run the function by which a name is imported when it is first asked for."""
    offered = {(f"hma_jax.{name}", home) for name, home in hma_jax.PUBLIC.items()}
    (block,) = [node for node in ast.parse(Path(hma_jax.__file__).read_text()).body if isinstance(node, ast.If)]
    seen = {(f"hma_jax.{name.asname}", node.module) for node in block.body for name in node.names}
    assert seen == offered and set(hma_jax.PUBLIC) < set(dir(hma_jax))


def test_every_package_says_that_it_is_typed():
    """Setuptools takes this file into the wheel by itself."""
    packages = [pattern.removesuffix("*") for pattern in PYPROJECT["tool"]["setuptools"]["packages"]["find"]["include"]]
    assert packages and all((ROOT / package / "py.typed").is_file() for package in packages)


def test_every_extra_can_be_installed_with_what_is_pinned():
    """`make install EXTRA=sim` ended without a solution: it needs an earlier NumPy, which the Makefile does not pin."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = {
        canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines) if version
    }
    apart = {
        (extra, one.name)
        for extra, needed in PYPROJECT["project"]["optional-dependencies"].items()
        for one in map(Requirement, needed)
        if (pin := pins.get(canonicalize_name(one.name))) and pin not in one.specifier
    }
    assert apart == {("sim", "numpy")} and "filter sim,$(GIVEN)" in (ROOT / "Makefile").read_text()
