from __future__ import annotations

import functools
import locale
from collections.abc import Iterator

import pytest

from data_pipelines.suite.simulator import suite_starts
from experiments import simulators
from hma_jax.simulator.starts import Start
from tests.experiments.applications.browser import browsing, chromium  # noqa: F401  fixtures
from tests.hma_jax.simulator.compiled import shared_programs  # noqa: F401  a fixture


@functools.cache
def simulated(*what: object, **how: object) -> tuple[Start, ...]:
    starts = tuple(suite_starts(*what, **how))
    for start in starts:
        start.images.flags.writeable = start.actions.flags.writeable = False  # other tests are given them, too
    return starts


@pytest.fixture(autouse=True)
def shared_starts() -> Iterator[None]:
    """The suite's held-out episodes are simulated once: most tests begin at the same ones."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulators, "suite_starts", lambda *what, **how: list(simulated(*what, **how)))
        yield


@pytest.fixture
def ascii_locale() -> Iterator[None]:
    """Files are read and written as ASCII where no encoding is given, as in some clusters' shells."""
    before = locale.setlocale(locale.LC_CTYPE)
    locale.setlocale(locale.LC_CTYPE, "C")
    yield
    locale.setlocale(locale.LC_CTYPE, before)
