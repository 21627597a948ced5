"""Shared by all tests: a persistent compilation cache, so that re-runs start fast, and fast compilation."""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import os
import shutil
import signal
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import pytest

CACHE = Path(__file__).parent.parent / ".jax_cache"
# Environment, not jax.config: child processes of the tests must find it too.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
# However small: thousands of programs that take less than a tenth of a second are most of what is compiled, and many
# tests, in this process and in others, compile the same ones.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Tiny programs run once or twice: compiling them well costs more than it saves. Tests marked `exact` are run
# again without this (`make test`): what is promised to be equal has to be so as users compile it.
FAST_COMPILATION = [
    "--xla_backend_optimization_level=0",
    "--xla_cpu_parallel_codegen_split_count=1",  # the other core has tests of its own
]
# Later ones end the process at a flag that they do not know.
if tuple(map(int, version("jaxlib").split(".")[:3])) < (0, 11, 1):
    FAST_COMPILATION.append("--xla_cpu_use_fusion_emitters=false")  # half the time of the compiler
os.environ.setdefault("XLA_FLAGS", " ".join(FAST_COMPILATION))
# Of each operation's origin one line: a tenth of the time.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "1")
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background job, whose children would not hear Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)
if "HMA_CACHE_DIR" not in os.environ:  # not the user's
    os.environ["HMA_CACHE_DIR"] = tempfile.mkdtemp(prefix="hma-cache-")
    atexit.register(shutil.rmtree, os.environ["HMA_CACHE_DIR"], ignore_errors=True)


def pytest_report_header() -> str:
    return f"XLA_FLAGS: {os.environ['XLA_FLAGS'] or 'none, as users compile'}"


LONG = ("tests/integration/test_kill.py", "tests/experiments/test_whole_study.py")
"""They start processes one after another; begun last, they would be waited for alone."""


def pytest_collection() -> None:
    """Rewriting the assertions of all test files is two thirds of collecting in a fresh clone, and is kept on disk.
    Workers collect in one order, so each would rewrite all of them: it imports a share of its own first."""
    count = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 1))
    if count == 1:
        return
    tests = Path(__file__).parent
    own = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw"))
    for file in sorted(tests.rglob("test_*.py"))[own::count]:
        with contextlib.suppress(Exception, pytest.skip.Exception):  # collection says it
            importlib.import_module(".".join(file.relative_to(tests.parent).with_suffix("").parts))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: not item.nodeid.startswith(LONG))


def pytest_sessionfinish() -> None:
    gc.freeze()  # five looks through all objects follow, of which none is needed any more


@pytest.fixture(autouse=True)
def no_entries_of_other_tests():
    """What a test registers is for the rest of the process: here for the rest of the test."""
    table = "data_pipelines.registry.table"
    kept = dict(sys.modules[table]._registered) if table in sys.modules else {}
    yield
    if table in sys.modules:
        sys.modules[table]._registered.clear()
        sys.modules[table]._registered.update(kept)


KEPT = {
    "hma_jax.model.hma": "declare_model",
    "hma_jax.tokenizers.autoencoder": "declare_tokenizer",
    "hma_jax.tokenizers.train": "_jitted_step",
    "hma_jax.training.state": "_jitted_zeros",
    "hma_jax.training.train": "_jitted_step",
    "hma_jax.training.validation": "_jitted_sums",
}
"""What a process remembers: declarations, and what it has traced of steps and held-out losses."""


PROGRAM = ("hma_jax", "jax", "jaxlib", "flax", "optax", "numpy")
"""Packages whose parts are in a traced step."""


class Replacing(pytest.MonkeyPatch):
    """Where a part of the program is replaced, no step that was traced before is used, and none is left to other
    tests."""

    replaced = False

    def setattr(self, target, *args, **kwargs) -> None:
        name = (
            target
            if isinstance(target, str)
            else getattr(target, "__module__", None) or getattr(target, "__name__", "")
        )
        self._replacing(name.split(".")[0] in PROGRAM)
        super().setattr(target, *args, **kwargs)

    def setitem(self, dic, name, value) -> None:
        self._replacing(dic is not sys.modules)  # a dictionary does not say whose it is
        super().setitem(dic, name, value)

    def undo(self) -> None:
        super().undo()
        if self.replaced:
            self.replaced = False
            forget_programs()

    def _replacing(self, part: bool) -> None:
        if part and not self.replaced:
            self.replaced = True
            forget_programs()


@pytest.fixture
def hangup_heard():
    """SIGHUP as it is by default, which it is not where the tests themselves run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def monkeypatch():
    with Replacing.context() as patch:
        yield patch


def forget_programs() -> None:
    for module, name in KEPT.items():
        if module in sys.modules:
            getattr(sys.modules[module], name).cache_clear()
