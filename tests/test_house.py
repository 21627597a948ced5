"""Who may import whom, and that there are no circles (docs/development.md, "Map of the code")."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("hma_jax", "data_pipelines", "experiments")
MAY_IMPORT = {
    "hma_jax": {"hma_jax"},
    "data_pipelines": {"hma_jax", "data_pipelines"},
    "experiments": {"hma_jax", "data_pipelines", "experiments"},
}


def modules() -> dict[str, Path]:
    """'hma_jax.model.hma' -> its file, for every module of the three packages."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def imports_of(path: Path) -> Iterator[str]:
    """Every module of ours that a file imports, wherever it does, for type checkers too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] in PACKAGES)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports are not used here"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                if whole in MODULES:
                    yield whole
                elif node.module in MODULES:
                    yield node.module


@functools.cache
def graph_of_imports() -> dict[str, set[str]]:
    """Not when this file is imported, as every worker does: to read all files takes seconds."""
    return {name: set(imports_of(path)) - {name} for name, path in MODULES.items()}


def find_circle(graph: dict[str, set[str]]) -> list[str]:
    """The names along one circle of `graph`; empty without any."""
    done: set[str] = set()

    def visit(name: str, trail: list[str]) -> list[str]:
        if name in trail:
            return [*trail[trail.index(name) :], name]
        if name in done:
            return []
        for other in sorted(graph.get(name, ())):
            if circle := visit(other, [*trail, name]):
                return circle
        done.add(name)
        return []

    for name in sorted(graph):
        if circle := visit(name, []):
            return circle
    return []


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_imports_only_those_below_it(package: str):
    for name, imported in graph_of_imports().items():
        if name.split(".")[0] == package:
            strangers = {other for other in imported if other.split(".")[0] not in MAY_IMPORT[package]}
            assert not strangers, f"{name} imports {', '.join(sorted(strangers))}"


def test_nothing_but_the_command_line_imports_it():
    for name, imported in graph_of_imports().items():
        if not name.startswith("experiments.cli"):
            assert not [other for other in imported if other.startswith("experiments.cli")], name


@pytest.mark.parametrize("package", PACKAGES)
def test_no_files_of_a_package_import_each_other_in_a_circle(package: str):
    """What is imported in functions, or for type checkers alone, counts too."""
    own = {name: imported for name, imported in graph_of_imports().items() if name.split(".")[0] == package}
    circle = find_circle(own)
    assert not circle, " -> ".join(circle)


def folders_of(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """The same between folders: 'hma_jax.model' -> those that its files import."""

    def folder(name: str) -> str:
        return ".".join(name.split(".")[:2])

    folders: dict[str, set[str]] = {}
    for name, imported in graph.items():
        folders.setdefault(folder(name), set()).update({folder(other) for other in imported} - {folder(name)})
    return folders


@pytest.mark.parametrize("package", ["hma_jax", "experiments"])
def test_no_folders_of_a_package_import_each_other_in_a_circle(package: str):
    """What is a file of the package itself counts as a folder."""
    own = {name: imported for name, imported in graph_of_imports().items() if name.startswith(f"{package}.")}
    circle = find_circle(folders_of(own))
    assert not circle, " -> ".join(circle)


def test_the_way_of_data_into_batches_has_no_circle_of_folders():
    """tokens -> windows -> loading, all of them above sampling."""
    way = {f"data_pipelines.{name}" for name in ("sampling", "tokens", "windows", "loading")}
    imports = {folder: below & way for folder, below in folders_of(graph_of_imports()).items() if folder in way}
    assert set(imports) == way and not imports["data_pipelines.sampling"]
    circle = find_circle(imports)
    assert not circle, " -> ".join(circle)


def test_circles_are_found():
    assert find_circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert find_circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
