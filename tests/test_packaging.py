"""What is installed: one version, and types that checkers of users' code read."""

import re
import tomllib
from pathlib import Path

import hma_jax

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_the_version_is_the_same_wherever_it_stands():
    (cited,) = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    latest = re.search(r"^## (\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[1]
    assert PYPROJECT["project"]["version"] == hma_jax.__version__ == cited == latest


def test_every_package_says_that_it_is_typed():
    """Setuptools takes this file into the wheel by itself."""
    packages = [pattern.removesuffix("*") for pattern in PYPROJECT["tool"]["setuptools"]["packages"]["find"]["include"]]
    assert packages and all((ROOT / package / "py.typed").is_file() for package in packages)
