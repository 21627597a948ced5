"""The code is formatted and linted, as pyproject.toml says, and what people read of it is no wider."""

import ast
import io
import re
import subprocess
import sys
import tokenize
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TWICE = re.compile(r"\b(\w+(?: \w+)+),? \1\b|(-[a-z]+)\2|\w([a-z]{2,})\3\3")
"""Words that follow themselves, or an ending that does: what is left of replacing them again and again."""


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


def shadowed_imports(tree: ast.Module) -> list[tuple[int, str]]:
    """(line of a function, name) of each parameter or local variable that hides what the module imports."""
    imports = (node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom))
    imported = {alias.asname or alias.name.split(".")[0] for node in imports for alias in node.names}
    found = []
    for function in (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.Lambda)):
        names = {n.arg for n in ast.walk(function) if isinstance(n, ast.arg)}
        names |= {n.id for n in ast.walk(function) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        found += [(function.lineno, name) for name in sorted(names & imported)]
    return found


def test_no_variable_of_the_core_hides_an_import():
    text = "from a import robots\ndef f(robots): pass\ndef g():\n    robots = 1\ndef h(): return robots\n"
    assert shadowed_imports(ast.parse(text)) == [(2, "robots"), (3, "robots")]
    hidden = [
        f"{path.relative_to(ROOT)}:{line}: rename the variable {name!r}, which hides an import"
        for path in sorted((ROOT / "hma_jax").rglob("*.py"))
        for line, name in shadowed_imports(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not hidden, "\n".join(hidden)


NO_SUBJECT = {"Of", "Those", "Whose"}
"""Words that speak of something said before; a docstring has nothing before it where an editor shows it alone."""


def test_docstrings_name_what_they_are_of():
    found = []
    for path in (p for f in ("hma_jax", "data_pipelines", "experiments") for p in sorted((ROOT / f).rglob("*.py"))):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                if node.value.value.split(None, 1)[:1] and node.value.value.split(None, 1)[0] in NO_SUBJECT:
                    found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not found, f"begin these docstrings with what they are of: {', '.join(found)}"


LETTERS = re.compile(r"[a-z][a-z0-9_]*_([A-Za-z]{1,6})")


def dimension_letters(tree: ast.Module) -> set[tuple[str, str]]:
    """(name, capital) of names of arrays: `actions_BTU` has B, T and U."""
    names = {getattr(n, kind, None) for n in ast.walk(tree) for kind in ("id", "arg", "attr")}
    suffixes = {name: match[1] for name in names if isinstance(name, str) and (match := LETTERS.fullmatch(name))}
    return {(name, letter) for name, suffix in suffixes.items() for letter in suffix if letter.isupper()}


def test_dimension_letters_are_those_of_the_glossary():
    """It is in the docstring of `hma_jax`."""
    assert dimension_letters(ast.parse("x_BnC[y_rT], zero_one")) == {("x_BnC", "B"), ("x_BnC", "C"), ("y_rT", "T")}
    core = ROOT / "hma_jax"
    glossary = ast.get_docstring(ast.parse((core / "__init__.py").read_text(encoding="utf-8")), clean=False)
    known = {
        letter for line in glossary.split("\n") if line.startswith("    ") for letter in re.findall(r"\b[A-Z]\b", line)
    }
    unknown = [
        f"{path.relative_to(ROOT)}: {name}: the glossary has no {letter}"
        for path in sorted(core.rglob("*.py"))
        for name, letter in sorted(dimension_letters(ast.parse(path.read_text(encoding="utf-8"))))
        if letter not in known
    ]
    assert not unknown, "\n".join(unknown)


def texts(tree: ast.AST) -> list[tuple[int, str]]:
    """(line, text) of every text of a program but docstrings; what an f-string inserts is left out."""
    docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            found.append((node.lineno, "".join(p.value if isinstance(p, ast.Constant) else "{}" for p in node.values)))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            found.append((node.lineno, node.value))
    return found


def test_nothing_that_is_printed_says_its_words_twice():
    for text in (
        "not little-endian-endian",
        "nested too deeplylyly",
        "which is 4, which is 4",
        "cost of the cost of the",
    ):
        assert TWICE.search(text)
    files = [p for f in ("hma_jax", "data_pipelines", "experiments") for p in sorted((ROOT / f).rglob("*.py"))]
    twice = [
        f"{path.relative_to(ROOT)}:{line}: {found[0]!r}"
        for path in files
        for line, text in texts(ast.parse(path.read_text(encoding="utf-8")))
        if (found := TWICE.search(text))
    ]
    assert not twice, "; ".join(twice)
