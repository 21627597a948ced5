"""The code is formatted and linted, as pyproject.toml says, and what people read of it is no wider."""

import ast
import io
import subprocess
import sys
import tokenize
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("command", [("check",), ("format", "--check")], ids=" ".join)
def test_ruff_has_nothing_to_say(command):
    """`ruff format .` and `ruff check --fix .` mend most of it."""
    found = subprocess.run(
        [sys.executable, "-m", "ruff", *command, "--no-cache", "."], cwd=ROOT, capture_output=True, text=True
    )
    assert found.returncode == 0, found.stdout + found.stderr


def lines_to_read(text: str) -> set[int]:
    """Numbers of the lines of docstrings and comments, which the formatter leaves as wide as they are."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    found = {t.start[0] for t in tokens if t.type == tokenize.COMMENT and not t.string.startswith("# fmt:")}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            found |= set(range(node.lineno, node.end_lineno + 1))
    return found


def test_docstrings_and_comments_are_no_wider_than_the_code():
    most, wide = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["ruff"]["line-length"], []
    files = [p for f in ("hma_jax", "data_pipelines", "experiments", "tests") for p in sorted((ROOT / f).rglob("*.py"))]
    for path in (p for p in files if ROOT / "tests" / "golden" not in p.parents):
        text = path.read_text(encoding="utf-8")
        if beyond := {n for n, line in enumerate(text.split("\n"), 1) if len(line) > most}:
            wide += [f"{path.relative_to(ROOT)}:{n}" for n in sorted(beyond & lines_to_read(text))]
    assert not wide, f"break these lines at {most} characters: {', '.join(wide)}"
