"""Which sources a program runs, found by reading imports, and a hash of each that no comment changes.

The closure of a program is what Python imports to run it: its root modules, what these import anywhere, including
inside functions, and what the imported modules import in turn at import time. Only modules of this project count;
versions of other packages are recorded separately (`machine`). Imports inside functions of other modules are not
followed: `imported_modules` finds them once they have happened.
"""

from __future__ import annotations

import ast
import hashlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path

from hma_jax.config.json import stable_hash

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("hma_jax", "data_pipelines", "experiments")

Closure = Mapping[str, str]
"""Hash of each module, by its name."""


def closure_hash(closure: Closure) -> str:
    """One hash for the whole closure."""
    return stable_hash(dict(closure))


def trace(roots: Iterable[str], root: Path = ROOT) -> dict[str, str]:
    """The closure of the modules `roots`, read from the files under `root` as they are now.

    Raises ValueError for a root that is not a module there, SyntaxError for a file that is not Python.
    """
    roots = tuple(roots)
    strangers = [name for name in roots if _file(name, root) is None]
    if strangers:
        raise ValueError(f"{root}: no module {', '.join(strangers)}")
    found: dict[str, str] = {}
    waiting, seen = list(roots), set()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        path = _file(name, root)
        if path is None:
            continue
        source = _read(path.read_bytes())
        found[name] = source.hash
        waiting += (*_parents(name), *(source.anywhere if name in roots else source.at_import))
    return dict(sorted(found.items()))


def imported_modules() -> dict[str, str]:
    """The modules of this project that this process has imported so far, as their files are now."""
    names = [name for name in sys.modules if name.split(".")[0] in PACKAGES]
    files = {name: _file(name, ROOT) for name in sorted(names)}
    return {name: _read(path.read_bytes()).hash for name, path in files.items() if path is not None}


def changed(old: Closure, new: Closure) -> list[str]:
    """Names of the modules in both that differ; modules that only one has are not compared."""
    return [name for name in sorted(old.keys() & new.keys()) if old[name] != new[name]]


# --- Reading a file ---------------------------------------------------------------------------


class _Source:
    """What is known about a file's text."""

    def __init__(self, text: bytes):
        tree = ast.parse(text)
        self.hash = _hash(tree)
        self.at_import = tuple(_imports(tree, functions=False))
        self.anywhere = tuple(_imports(tree, functions=True))


_read = lru_cache(maxsize=1024)(_Source)


def _file(name: str, root: Path) -> Path | None:
    """The file of a module of this project; None for other modules, and for a name inside a module."""
    if name.split(".")[0] not in PACKAGES:
        return None
    path = root.joinpath(*name.split("."))
    inits = path / "__init__.py"
    if inits.is_file():
        return inits
    path = path.with_name(path.name + ".py")
    return path if path.is_file() else None


def _parents(name: str) -> Iterator[str]:
    """The packages that Python imports before a module."""
    while "." in name:
        name = name.rsplit(".", 1)[0]
        yield name


def _imports(tree: ast.AST, functions: bool) -> Iterator[str]:
    """Names that may be modules; with `functions`, also those that functions import. Imports for type checkers are left
    out."""
    for node in _statements(tree):
        match node:
            case ast.Import(names=names):
                yield from (alias.name for alias in names)
            case ast.ImportFrom(module=str(module), names=names, level=0):
                yield module
                yield from (f"{module}.{alias.name}" for alias in names)
            case ast.ImportFrom():
                raise ValueError(f"line {node.lineno}: relative imports are not followed; name the module in full")
            case ast.FunctionDef() | ast.AsyncFunctionDef() if not functions:
                pass
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                yield from _imports(ast.Module(node.orelse, []), functions)
            case _:
                yield from _imports(node, functions)


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """The statements inside a statement; expressions contain none."""
    for field in ("body", "orelse", "finalbody", "handlers", "cases"):
        inside = getattr(node, field, ())
        yield from inside if isinstance(inside, list) else ()  # a lambda's body, or that of `a if b else c`, is none


def _hash(tree: ast.AST) -> str:
    """Hash of what a file means: equal for files that differ only in comments, docstrings or layout, and the same under
    every version of Python that reads the file to the same syntax tree."""
    pieces: list[str] = []
    _write(tree, pieces)
    return hashlib.sha256("".join(pieces).encode()).hexdigest()[:16]


def _write(node: object, pieces: list[str]) -> None:
    """A syntax tree as text. Empty fields are left out: later versions of Python have fields that earlier ones lack."""
    if isinstance(node, ast.AST):
        pieces.append(f"({type(node).__name__}")
        for name in node._fields:
            value = getattr(node, name, None)
            if isinstance(value, list):
                value = [item for item in value if not _is_text_alone(item)]
            if value not in (None, []) or isinstance(node, ast.Constant) and name == "value":
                pieces.append(f" {name}=")
                _write(value, pieces)
        pieces.append(")")
    elif isinstance(node, list):
        pieces.append("[")
        for item in node:
            _write(item, pieces)
            pieces.append(",")
        pieces.append("]")
    else:
        pieces.append(repr(node))


def _is_text_alone(node: object) -> bool:
    """Whether a node is a docstring (of a module, class, function or attribute): a string that is a statement does
    nothing."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
