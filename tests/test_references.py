"""What comments and pages point at exists: sections of docs/reference.md, of the paper, and names of the code.

Citations have one form: `reference section 1.4`, `reference sections 2.4 and 2.5`, `reference appendix A`, and
`paper section 3.5` for the paper. Another work is named before a comma ("Tensor Programs V, appendix D.1").
Pointers are dotted names in backticks, `hma_jax.model.hma` or, inside a package, `params.Declared`; what counts as
one is said in `pointers`.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("hma_jax", "data_pipelines", "experiments")
REFERENCE = ROOT / "docs" / "reference.md"
PAPER = {*"1234567", *(f"3.{i}" for i in range(1, 6)), "4.1", "4.2", *(f"5.{i}" for i in range(1, 5))}
"""The sections of arXiv 2502.04296."""

GAP = r"(?:[ \t]+|[ \t]*\n[\s#]*)"  # between words; the second may stand on a comment's next line
SECTION, APPENDIX = r"[0-9]+(?:\.[0-9]+)*", r"[A-Z](?:\.[0-9]+)*"


def _listed(number: str) -> str:
    return rf"({number}(?:(?:,|{GAP}and|{GAP}to){GAP}{number})*)\b"


CITATION = re.compile(rf"\b(?:[Ss]ections?{GAP}{_listed(SECTION)}|[Aa]ppendi(?:x|ces){GAP}{_listed(APPENDIX)})")
SHORT = re.compile(rf"\breference,?{GAP}[0-9A-Z]\.[0-9]", re.IGNORECASE)


def files(*suffixes: str) -> list[Path]:
    """Every file of ours with one of the suffixes, this one apart: it holds examples."""
    folders = [ROOT / name for name in (*PACKAGES, "tests", "docs")]
    found = [p for folder in folders for s in suffixes for p in folder.rglob(f"*{s}")]
    return sorted({*found, *(p for s in suffixes for p in ROOT.glob(f"*{s}"))} - {Path(__file__)})


def sections(page: str) -> set[str]:
    """Numbers of a page's headings ("## 1.4 The block", "## Appendix A. ...") and of "* **B.1 ...**" items."""
    headings = re.findall(rf"^#+ (?:Appendix )?({SECTION}|{APPENDIX})[. ]", page, re.MULTILINE)
    return {*headings, *re.findall(r"^\* \*\*([A-Z]\.[0-9]+) ", page, re.MULTILINE)}


def wrong_citations(text: str, ours: set[str], bare: set[str] | None = None) -> Iterator[tuple[int, str]]:
    """(line, complaint) of each citation of `text` that has another form or no section to point at.

    `bare` are the sections of the page itself, where it may leave out which work it cites.
    """
    for match in SHORT.finditer(text):
        yield _line(text, match), f"{match[0]!r}: write 'reference section ...'"
    for match in CITATION.finditer(text):
        before = re.search(rf"(\S+){GAP}$", text[: match.start()])
        word = before[1].lower().lstrip("(`'\"*[") if before else ""
        known = {"reference": ours, "paper": PAPER}.get(word, bare)
        if known is None and word.endswith(",") and word not in ("reference,", "paper,"):
            continue  # of another work, named before the comma
        if known is None:
            yield _line(text, match), f"{match[0]!r}: which work? Write 'reference section' or 'paper section'"
            continue
        missing = [n for n in re.findall(rf"{SECTION}|\b{APPENDIX}", match[1] or match[2]) if n not in known]
        if missing:
            yield _line(text, match), f"{match[0]!r}: there is no section {', '.join(missing)}"


def _line(text: str, match: re.Match[str]) -> int:
    return text.count("\n", 0, match.start()) + 1


def test_every_cited_section_exists():
    ours = sections(REFERENCE.read_text())
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {what}"
        for path in files(".py", ".md")
        for line, what in wrong_citations(path.read_text(), ours, bare=ours if path == REFERENCE else None)
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("see reference section 1.2", None),
        ("Reference sections 1.2 and\n    # 3.4.", "no section 3.4"),
        ("(reference appendix B)", None),
        ("(reference appendix B.2)", "no section B.2"),
        ("(reference\n        section 9.9)", "no section 9.9"),
        ("`paper section 3.5`", None),
        ("paper section 3.9", "no section 3.9"),
        ("(section 1.2)", "which work"),
        ("the paper's section 3.1", "which work"),
        ("reference, appendix B", "which work"),
        ("(reference 1.2)", "write 'reference section"),
        ("Tensor Programs V, appendix D.1", None),
        ("nothing in this section is measured", None),
        ("name=1,  # section 1.2", "which work"),
    ],
)
def test_forms_of_citations(text: str, complaint: str | None):
    found = [what for _, what in wrong_citations(text, {"1.2", "B"})]
    assert (complaint in found[0]) if complaint else not found


# --- Names of the code --------------------------------------------------------------------------

DOTTED = re.compile(r"(?<!`)`([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(?:\(\))?`")
WORD = re.compile(r"(?<!`)`([a-z_]\w*)(?:\(\))?`")
FILE_SUFFIXES = {"bin", "ckpt", "csv", "html", "json", "jsonl", "md", "npz", "pkl", "png", "proto", "py",
                 "safetensors", "stablehlo", "toml", "txt"}  # fmt: skip


class Package:
    """The names that a package defines, read off its text; nothing is imported."""

    def __init__(self, name: str):
        self.modules: dict[tuple[str, ...], set[str]] = {}  # ("hma_jax", "model", "hma") -> what it defines
        self.classes: dict[str, set[str]] = defaultdict(set)
        self.annotations: dict[str, dict[str, str]] = defaultdict(dict)  # of a class's fields
        self.words: set[str] = set()  # all that occur in code
        for path in sorted((ROOT / name).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            tree = parsed(path)
            self.modules[parts[:-1] if parts[-1] == "__init__" else parts] = set(_defined(tree.body))
            self.words |= words_of(tree) | set(parts)
            for node in nodes(tree):
                if isinstance(node, ast.ClassDef):
                    attributes = (n for n in ast.walk(node) if isinstance(n, ast.Attribute))
                    own = {n.attr for n in attributes if isinstance(n.ctx, ast.Store)}
                    self.classes[node.name] |= {*_defined(node.body), *own}
                    fields = (n for n in node.body if isinstance(n, ast.AnnAssign))
                    self.annotations[node.name] |= {n.target.id: ast.unparse(n.annotation) for n in fields}
        self.places = {part for module in self.modules for part in module} | set(self.classes)

    def has(self, parts: tuple[str, ...]) -> bool:
        """Whether a dotted name, from any folder on, is a module, or something that one or a class defines."""
        for end in range(1, len(parts) + 1):
            for module, names in self.modules.items():
                if module[-end:] == parts[:end] and self._inside(names, parts[end:]):
                    return True
        return parts[0] in self.classes and self._inside(self.classes[parts[0]], parts[1:])

    def _inside(self, names: set[str], rest: tuple[str, ...]) -> bool:
        if not rest:
            return True
        return rest[0] in names and (rest[0] not in self.classes or self._inside(self.classes[rest[0]], rest[1:]))


@cache
def package(name: str) -> Package:
    return Package(name)


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def nodes(tree: ast.Module) -> tuple[ast.AST, ...]:
    """All of a file's; to walk over it takes longer than to parse it."""
    return tuple(ast.walk(tree))


def _defined(body: list[ast.stmt]) -> Iterator[str]:
    """Names that statements define, imported ones among them."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from (alias.asname or alias.name for alias in node.names)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name))


@cache
def identifiers(tree: ast.Module) -> frozenset[str]:
    """Of variables, arguments and attributes."""
    names = (getattr(node, kind, None) for node in nodes(tree) for kind in ("id", "arg", "attr"))
    return frozenset(name for name in names if isinstance(name, str))


def words_of(tree: ast.Module) -> set[str]:
    """Identifiers, names of functions and classes, words of strings, and "piece*" or "*piece" for those of
    f-strings; docstrings apart."""
    found = set(identifiers(tree))
    docstrings = {id(n.value) for n in nodes(tree) if isinstance(n, ast.Expr)}
    for node in nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.JoinedStr):
            pieces = [n.value for n in node.values if isinstance(n, ast.Constant)]
            found.update(mark for piece in pieces for mark in (f"{piece}*", f"*{piece}"))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            found.update(re.findall(r"\w+", node.value))
    return found


def is_setting(parts: tuple[str, ...]) -> bool | None:
    """Whether `model.width`, `train.masking.setting` is a field of a configuration; None: starts like none."""
    core = package("hma_jax")
    cls = next((c for c in core.annotations if c.endswith("Config") and c[:-6].lower() == parts[0]), None)
    if cls is None:
        return None
    for name in parts[1:]:
        if name not in core.classes.get(cls, ()):
            return False
        cls = next(iter(re.findall(r"\w+Config", core.annotations[cls].get(name, ""))), "")
    return True


def broken_pointers(
    text: str, home: str | None = None, code: frozenset[str] = frozenset()
) -> Iterator[tuple[int, str]]:
    """(line, name) of dotted names in backticks that look like names of ours and are none.

    They do if they begin with a package; or with a section of the configuration (`model.width`); or, in a
    file of package `home`, with a folder, module or class of it. File names are left out, and so are
    attributes of variables, whose two names are identifiers in the file's `code`.
    """
    for match in DOTTED.finditer(text):
        parts = tuple(match[1].split("."))
        if parts[-1] in FILE_SUFFIXES:
            continue
        if parts[0] in PACKAGES:
            good = package(parts[0]).has(parts)
        elif set(parts[:2]) <= code:
            continue
        else:
            setting = is_setting(parts)
            if setting is None and not (home and parts[0] in package(home).places):
                continue
            good = setting or any(package(name).has(parts) for name in ([home] if home else PACKAGES))
        if not good:
            yield _line(text, match), match[1]


def test_every_dotted_name_in_backticks_exists():
    wrong = []
    for path in files(".py", ".md"):
        first = path.relative_to(ROOT).parts[0]
        code = identifiers(parsed(path)) if path.suffix == ".py" else frozenset()
        found = broken_pointers(path.read_text(), first if first in PACKAGES else None, code)
        wrong += [f"{path.relative_to(ROOT)}:{line}: `{name}` does not exist (moved?)" for line, name in found]
    assert not wrong, "\n".join(wrong)


def occurs(word: str, words: set[str]) -> bool:
    """Among `words`, whole or as an f-string puts it together: f"ema_{name}" makes `ema_loss`."""
    cuts = [(word[:i], word[i:]) for i in range(1, len(word))]
    return word in words or any((f"{a}*" in words and b in words) or (f"*{b}" in words and a in words) for a, b in cuts)


def test_every_word_in_backticks_of_the_core_occurs_in_its_code():
    """A module that was renamed, a function that is gone: `word` then occurs in comments only.

    Names of the official release are those in backticks on the page about it.
    """
    theirs = " ".join(re.findall(r"`[^`\n]+`", REFERENCE.read_text()))
    known = package("hma_jax").words | set(re.findall(r"\w+", theirs))
    wrong = []
    for path in (ROOT / "hma_jax").rglob("*.py"):
        text = path.read_text()
        gone = [match for match in WORD.finditer(text) if not occurs(match[1], known)]
        wrong += [f"{path.relative_to(ROOT)}:{_line(text, match)}: no code has {match[0]}" for match in gone]
    assert not wrong, "\n".join([*wrong, "a name of the official release must stand in docs/reference.md"])


@pytest.mark.parametrize(
    ("text", "good"),
    [
        ("`hma_jax.model.hma`", True),
        ("`hma_jax.model.hma.HMA.align`", True),
        ("`hma_jax.model.nothing`", False),
        ("`params.Declared`", True),
        ("`model.params.Declared.init()`", True),
        ("`params.Declared.nothing`", False),
        ("`model.nothing`", False),
        ("`model.width`", True),
        ("`train.masking.setting`", True),
        ("`train.masking.nothing`", False),
        ("`Declared.nothing`", False),
        ("`jax.nothing`", True),
        ("`model.safetensors`", True),
    ],
)
def test_what_counts_as_a_name_of_ours(text: str, good: bool):
    assert good == (not list(broken_pointers(text, "hma_jax")))


def test_what_occurs_in_code():
    words = words_of(ast.parse("""def f(loss):\n    "`gone`"\n    return {f"ema_{name}": loss for name in loss}"""))
    assert all(occurs(word, words) for word in ("f", "loss", "ema_loss"))
    assert not any(occurs(word, words) for word in ("gone", "ema", "f_loss"))
