"""README.md and docs/: every command parses, those of a moment run, and every path that is mentioned exists.

Commands stand in blocks marked `sh` and in backticks. One in backticks may leave out what it needs (`hma evaluate`),
write several at once (`hma bench generate|train`) and end in `...`.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib.util
import itertools
import re
import shlex
import shutil
import subprocess
import textwrap
import tomllib
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path

import pytest
from tyro.extras import SubcommandApp

from experiments.cli import main as program
from experiments.presets import PRESETS, get_preset
from experiments.user_input.override import override
from tests.experiments.programs import command_of, run_program

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "experiments" / "results").glob("*/findings.md")),
]
EXTRAS = list(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:(?<=\n\n)|\A)((?: {4}.*\n)+)")
INLINE = re.compile(r"(?<!`)`((?:hma|make|python -m)\b[^`]*)`(?!`)")
STARTS = ("hma", "make", "pip", "python")
TOP = ("hma_jax/", "data_pipelines/", "experiments/", "tests/", "docs/", ".ci/")
MENTIONED = re.compile(r"(?<!`)`([^`\s]+)`|\]\(([^)\s]+)\)")

QUICK = (
    "hma data list open-x",
    "hma bench report experiments/results/bench/cpu",
    "python -m experiments.sweeps.width --preset cpu --dry-run",
)
"""Of the documented commands, those that take a moment and need no data; tests run them."""

IN_OUT = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
"""The arguments that decide what a command makes in --out."""
IN_OUT.add_argument("--out")
IN_OUT.add_argument("--preset", default="cpu")
for name in ("--data", "--mixture", "--tokenizer"):
    IN_OUT.add_argument(name, nargs="*", default=())
IN_OUT.add_argument("--set", action="append", default=[])


def blocks(page: str) -> Iterator[str]:
    """Commands of the blocks of a page, fenced or indented, one by one: comments, prompts and what a shell does around
    them left out."""
    indented = [("", textwrap.dedent(text)) for text in INDENTED.findall(BLOCK.sub("", page))]
    for language, text in BLOCK.findall(page) + indented:
        if language not in ("", "sh"):
            continue
        known: dict[str, str] = {}
        for line in text.replace("\\\n", " ").splitlines():
            line = re.sub(r"\s#.*", "", line).strip().removeprefix("$ ")
            for name, value in known.items():
                line = re.sub(rf"\${name}\b", value, line)
            if assigned := re.fullmatch(r"(\w+)=(?:'(.*)'|\"(.*)\"|(\S+))|for (\w+) in (\S+).*", line):
                name, *values = filter(None, assigned.groups())
                known[name] = values[0]
                continue
            for command in re.split(r"&&|;|\|(?!\S)", line):
                words = re.sub(r"^(?:do\s+|[A-Z_]+=\S*\s+)+", "", command.strip())
                if words.startswith(STARTS):
                    yield words


def inline(page: str) -> Iterator[str]:
    """Commands in backticks, with alternatives written out."""
    for found in INLINE.findall(BLOCK.sub("", page)):
        parts = [word.split("|") for word in shlex.split(found)]
        yield from (shlex.join(choice) for choice in itertools.product(*parts))


def commands(kind) -> list[str]:
    return sorted({command for page in PAGES for command in kind(page.read_text())})


# --- What a command line says ----------------------------------------------------------------


def recorder(calls: list[dict]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Makes of a command one that only adds its arguments to `calls`."""

    def change(function):
        @functools.wraps(function)
        def record(**arguments):
            calls.append(arguments)

        return record

    return change


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """What the commands of `hma` were called with; none of them does anything."""
    calls: list[dict] = []
    record = recorder(calls)

    def record_all(app: SubcommandApp) -> None:
        for spec in app._subcommands.values():
            if isinstance(spec.target, SubcommandApp):
                record_all(spec.target)
            else:
                monkeypatch.setattr(spec, "target", record(spec.target))

    record_all(program.app)
    return calls


def complaint(command: str, calls: list[dict], capsys, *, whole: bool) -> str | None:
    """What is wrong with a documented command. `whole`: it must say everything that it needs."""
    words = shlex.split(command)
    match words:
        case ["hma", *arguments]:
            return _complaint_of_hma(arguments, calls, capsys, whole)
        case ["make", *rest]:
            targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
            unknown = [word for word in rest if "=" not in word and word not in targets]
            return f"the Makefile has no target {', '.join(unknown)}" if unknown else None
        case ["pip", "install", *rest]:
            unknown = set(re.findall(r"[\w-]+", "".join(re.findall(r"\[(.+?)\]", " ".join(rest))))) - set(EXTRAS)
            return f"no extra {', '.join(unknown)}" if unknown else None
        case ["python", "-m", module, *arguments]:
            return _complaint_of_module(module, arguments, calls, capsys, whole)
    return "no command that this test knows"


def _complaint_of_hma(arguments: list[str], calls: list[dict], capsys, whole: bool) -> str | None:
    if arguments[-1:] == ["..."]:
        arguments = [*arguments[:-1], "x"] if arguments[-2:-1] and arguments[-2].startswith("-") else arguments[:-1]
    arguments = [word.removesuffix("...") for word in arguments if word != "..."]
    if not whole and not any(word.startswith("-") for word in arguments):  # it is only mentioned, perhaps with its RUN
        words = list(itertools.takewhile(lambda word: re.fullmatch(r"[a-z][a-z-]*", word), arguments))
        with pytest.raises(SystemExit) as end:
            program.main([*words, "--help"])
        capsys.readouterr()
        return "there is no such command" if end.value.code else None
    calls.clear()
    if said := _refusal(lambda: program.main(arguments), capsys, whole):
        return said
    given = calls[-1].get("arguments") if calls else None
    if given is not None and given.set:
        with contextlib.suppress(SystemExit):  # of --set help
            override(get_preset(given.preset or "cpu"), list(given.set))  # raises ConfigError
    return None


def _refusal(run: Callable[[], int | None], capsys, whole: bool) -> str | None:
    """What a program said that refused its arguments; None if it took them, or misses some and need not be `whole`."""
    try:
        code = run()
    except SystemExit as end:
        code = end.code
    said = " ".join(re.sub(r"[│╭╮╰╯─]", " ", capsys.readouterr().err).split())
    missing = "equired" in said and "nrecognized" not in said and "invalid" not in said.lower()
    return said if code and (whole or not missing) else None


def _complaint_of_module(module: str, arguments: list[str], calls: list[dict], capsys, whole: bool) -> str | None:
    if module == "pytest":
        missing = [word for word in arguments if not word.startswith("-") and not (ROOT / word).exists()]
        return f"no {', '.join(missing)}" if missing else None
    found = importlib.util.find_spec(module)
    if found is not None and found.submodule_search_locations:
        found = importlib.util.find_spec(f"{module}.__main__")
    if found is None or found.origin is None:
        return f"no module {module}"
    text = Path(found.origin).read_text()
    if axis := re.search(r'run_sweep\("(\w+)"\)', text):
        return _complaint_of_hma(["sweep", axis[1], *arguments], calls, capsys, True)
    if command_of(Path(found.origin)):
        return _refusal(lambda: run_program(module, arguments, recorder(calls)), capsys, whole)
    unknown = [word for word in arguments if word.startswith("--") and f'"{word}"' not in text]
    return f"{module} does not take {', '.join(unknown)}" if unknown else None


def test_every_command_in_a_block_parses(parsed, capsys):
    found = commands(blocks)
    assert len(found) > 20
    wrong = {command: what for command in found if (what := complaint(command, parsed, capsys, whole=True))}
    assert not wrong, "\n".join(f"{command}: {what}" for command, what in wrong.items())


def test_every_command_in_backticks_parses(parsed, capsys):
    found = commands(inline)
    assert len(found) > 50
    wrong = {command: what for command in found if (what := complaint(command, parsed, capsys, whole=False))}
    assert not wrong, "\n".join(f"{command}: {what}" for command, what in wrong.items())


@pytest.mark.parametrize(
    ("command", "wrong"),
    [
        ("hma train --preset accelerator --mesh 4 2 1", None),
        ("hma trian --preset accelerator", "trian"),
        ("hma train --presets accelerator", "--presets"),
        ("hma train --preset gpu", "gpu"),
        ("hma evaluate", "equired"),
        ("make study PRESET=smoke", None),
        ("make stduy", "stduy"),
        ("pip install -e '.[cuda]'", None),
        ("pip install -e '.[cudda]'", "cudda"),
        ("pip install -e '.[cuda,test-s4]'", "test-s4"),
        ("python -m tests.stress.tokenize_kills --kills 3", None),
        ("python -m tests.stress.tokenize_kills --kill 3", "--kill"),
        ("python -m tests.stress.nothing", "no module"),
        ("python -m experiments.sweeps.width --dry-runs", "--dry-runs"),
        ("python -m experiments.applications.endurance RUN --drives behaviour extremes", None),
        ("python -m experiments.applications.endurance RUN --drives fast", "fast"),
        ("python -m experiments.applications.detector", "equired"),
    ],
)
def test_what_is_wrong_is_found(command, wrong, parsed, capsys):
    said = complaint(command, parsed, capsys, whole=True)
    assert (said is None) if wrong is None else (said and wrong in said), said


@pytest.mark.skipif(shutil.which("make") is None, reason="no make here")
@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ("", "install .\n"),
        (",".join(EXTRAS), f"install '.[{','.join(EXTRAS)}]'\n"),
        ("cuda convert", None),
        ("cudda", None),
    ],
)
def test_make_install_takes_the_extras_that_there_are(extra, said, tmp_path):
    words = ["make", "-n", "install", f"EXTRA={extra}", f"VENV={tmp_path}"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    if said is None:
        assert done.returncode and f"EXTRA is '{extra}': give any of {' '.join(EXTRAS)}, separated" in done.stderr
    else:
        assert not done.returncode and said in done.stdout


@pytest.mark.skipif(shutil.which("make") is None, reason="no make here")
def test_make_study_runs_one_trial_at_a_time_where_trials_have_an_accelerator(tmp_path):
    """Two shared a GPU, each with less than half of its memory, and could not share a TPU chip."""
    expected = {(name, ""): 1 if study.for_accelerators else 2 for name, study in PRESETS.items()}
    expected |= {("cpu", "cuda"): 1, ("cpu", "convert,tpu"): 1, ("cpu", "slurm"): 2}
    for (preset, extra), workers in expected.items():
        words = ["make", "-n", "study", f"PRESET={preset}", f"EXTRA={extra}", f"VENV={tmp_path}"]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
        assert f"hma study --preset {preset} --out runs/study --workers {workers}\n" in done.stdout


def test_blocks_are_read_as_a_shell_does():
    page = (
        "```sh\nW='--preset cpu'\nhma tokenize $W && hma train $W   # both\nfor m in base xl; do\n"
        "  hma bench train --model $m \\\n    --batch 8\ndone\nJAX_PLATFORMS=cpu python -m pytest x\n```\n"
    )
    assert list(blocks(page)) == [
        "hma tokenize --preset cpu", "hma train --preset cpu", "hma bench train --model base      --batch 8",
        "python -m pytest x",
    ]  # fmt: skip


def contents(command: str) -> tuple[str, Hashable] | None:
    """(--out, what its contents are made from) of a command that is refused where --out holds something else: a shipped
    model, or the tokenizer, tokens and windows of a study."""
    match shlex.split(command):
        case ["python", "-m", "experiments.applications.ship", run, *words]:
            return IN_OUT.parse_known_args(words)[0].out, run
        case ["hma", "tokenize" | "train" | "adapt" | "evaluate" | "study" | "sweep", *words]:
            given = IN_OUT.parse_known_args(words)[0]
            settings = {word for word in given.set if word.startswith(("tokenizer.", "store.", "suite.", "rate="))}
            return given.out, (given.preset, *map(frozenset, (given.data, given.mixture, given.tokenizer, settings)))
    return None


def contradictions(page: str) -> list[str]:
    """Commands in the blocks of a page that are refused after those before them, since --out holds something else."""
    held: dict[str | None, Hashable] = {}
    found = [(command, made) for command in blocks(page) if (made := contents(command)) and made[0]]
    return [command for command, (out, inputs) in found if held.setdefault(out, inputs) != inputs]


def test_commands_of_a_page_can_be_given_one_after_the_other():
    wrong = [f"{page.name}: {command}" for page in PAGES for command in contradictions(page.read_text())]
    assert not wrong, "\n".join(wrong)


def test_another_content_of_one_directory_is_found():
    page = "```sh\nhma tokenize --out runs/a --data x y\nhma train --data y x --out runs/a --run m\n{}\n```\n"
    for more in ("--data x", "--data x y --preset paper", "--data x y --tokenizer t", "--data x y --set rate=5"):
        assert contradictions(page.format(f"hma train --out runs/a {more}")), more
    ships = "python -m experiments.applications.ship {} --out runs/s --temperature 0\n"
    assert contradictions(page.format(ships.format("runs/m") + ships.format("runs/n")))
    assert not contradictions(page.format(ships.format("runs/m") * 2 + "hma train --out runs/b --data x"))


@pytest.mark.parametrize("command", QUICK)
def test_a_documented_command_of_a_moment_runs(command, monkeypatch, capsys):
    assert command in commands(inline), "it is documented no longer"
    monkeypatch.chdir(ROOT)
    words = shlex.split(command)
    arguments = words[1:] if words[0] == "hma" else ["sweep", words[2].split(".")[-1], *words[3:]]
    assert program.main(arguments) == 0
    assert capsys.readouterr().out.count("\n") > 3


# --- Paths -----------------------------------------------------------------------------------


def paths(page: Path) -> Iterator[tuple[str, Path]]:
    """(as it is written, what it must be) of every path of the project that a page mentions."""
    for quoted, link in MENTIONED.findall(BLOCK.sub("", page.read_text())):
        if link and "://" not in link:
            yield link, (page if link[0] == "#" else page.parent / link.split("#")[0])
        elif quoted.startswith(TOP):
            yield quoted, ROOT / quoted.removesuffix("/").split("::")[0]


def anchors(page: Path) -> set[str]:
    """What `#...` may name in a page of Markdown: its headings, in lower case, without signs, spaces as dashes."""
    headings = re.findall(r"^#+ (.*)$", BLOCK.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_heading_that_is_linked_exists():
    linked = [
        (page.name, link, target, link.partition("#")[2])
        for page in PAGES
        for link, target in paths(page)
        if "#" in link and target.suffix == ".md"
    ]
    wrong = [f"{page}: {link}" for page, link, target, anchor in linked if anchor not in anchors(target)]
    assert not wrong, "\n".join(wrong)
    assert len(linked) > 5


def test_every_path_that_is_mentioned_exists():
    wrong = [
        f"{page.name}: {name}"
        for page in PAGES
        for name, place in paths(page)
        if not place.exists() and not list(ROOT.glob(str(place.relative_to(ROOT)) if ROOT in place.parents else "-"))
    ]
    assert not wrong, "\n".join(wrong)
    assert sum(len(list(paths(page))) for page in PAGES) > 30
