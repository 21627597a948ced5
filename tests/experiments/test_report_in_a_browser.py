"""Tables of a study's page in a real Chromium, on a phone and on a desk: a reader sees results, and of what."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.analysis.fits import Coefficient, PowerFit
from experiments.analysis.scaling import Curve, CurveFit
from experiments.presets import CPU_FULL
from experiments.report.fits import describe_fits
from experiments.report.pieces import section, table
from experiments.report.style import CSS
from experiments.report.sweeps import describe
from experiments.sweeps.conditioning import plan as plan_conditioning
from experiments.sweeps.width import plan as plan_width
from tests.experiments.applications.browser import chromium  # noqa: F401  a fixture
from tests.experiments.test_report_figures import rows_of

WHERE = """() => [...document.querySelectorAll(".scroll")].map(box => {
    const edge = cell => { const at = cell.getBoundingClientRect(), own = box.getBoundingClientRect();
                           return [at.left - own.left, own.right - at.right]; };
    const line = box.querySelector("tbody tr"), first = edge(line.querySelector("td"));
    box.scrollLeft = box.scrollWidth;
    return {first, scrolled: box.scrollLeft, heading: edge(line.querySelector("th"))};
})"""
"""Of each table: how far within its box the first result lies at first, and the heading of a line at the end."""


HIDDEN = """() => [...document.querySelectorAll(".scroll")].flatMap(box => [...box.querySelectorAll("thead th")]
    .filter(cell => cell.getBoundingClientRect().right > box.getBoundingClientRect().right + 1)
    .map(cell => cell.textContent))"""
"""Headings of columns that lie outside their box before it is scrolled."""

WIDER = "() => document.documentElement.scrollWidth - innerWidth"
"""By how much the page is wider than the window."""


def look(chromium, width: int, content: str, *expressions: str) -> Any:  # noqa: F811
    """What `expressions` are, of a page of that content in a window of `width`; of a single one itself."""
    runner, browser = chromium

    async def evaluate() -> list[Any]:
        page = await browser.new_page(viewport={"width": width, "height": 800})
        try:
            await page.set_content(f"<!doctype html><style>{CSS}</style><main>{content}</main>")
            return [await page.evaluate(expression) for expression in expressions]
        finally:
            await page.close()

    found = runner.run(evaluate())
    return found[0] if len(expressions) == 1 else found


@pytest.mark.parametrize("plan", [plan_width, plan_conditioning])
def test_a_table_on_a_phone_shows_results_and_keeps_what_they_are_of(plan, chromium):  # noqa: F811
    """The first column after the heading was of parameters, and scrolling took the heading away."""
    sweep = plan(CPU_FULL)
    rows = rows_of(sweep, lambda _: {"cross_entropy": 4.1, "perplexity": 75.0, "delta_psnr": 0.5, "psnr": 20.0})

    tables = look(chromium, 390, describe(sweep, rows), WHERE)
    assert tables and any(at["scrolled"] > 0 for at in tables)
    for at in tables:
        assert min(*at["first"], *at["heading"]) >= 0, at


def test_every_column_of_the_fits_is_in_view_on_a_desk(chromium):  # noqa: F811
    """Why a fit is doubtful stood outside the view, and beside its squeezed column the table was empty."""
    names = ("E", "A", "alpha", "B", "beta")
    fit = PowerFit(
        ("trunk parameters", "windows seen"), ("t",), coefficients=tuple(Coefficient(n, 0.629, 0.556, 0.68) for n in names),
        doubts=("where it varies least, 4 of 8 points have one seed, whose scatter it takes from the others",) * 3,
    )  # fmt: skip
    refused = PowerFit(("trajectories of each new robot",), ("t",), refused="the loss does not fall from end to end")
    fits = [
        CurveFit(Curve(name, fit.axes, ()), SimpleNamespace(value=np.array([3.0, 4.0])), fit)
        for name, fit in (("joint", fit), ("fewshot-after 40 robots, everything trained", refused))
    ]
    assert look(chromium, 1280, section("Fits", describe_fits(fits, None, [], "")), HIDDEN) == []


def test_a_wide_table_uses_the_window_that_it_has(chromium):  # noqa: F811
    """It was cut where the text ends, with half of the window empty beside it."""
    wide = section("Robots", table([f"measure {i}" for i in range(11)], [["0.000 ± 0.000"] * 11]))
    (at_1920, wider), (at_1280, wider_there) = (look(chromium, width, wide, HIDDEN, WIDER) for width in (1920, 1280))
    assert at_1920 == [] and at_1280  # where something is cut, the box scrolls, and not the page
    assert max(wider, wider_there) <= 0
