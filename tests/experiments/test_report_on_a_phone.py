"""Tables of a study's page in a real Chromium as narrow as a phone: a reader sees results, and of what."""

from __future__ import annotations

import pytest

from experiments.presets import CPU_FULL
from experiments.report.style import CSS
from experiments.report.sweeps import AxisStatistics, describe
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


@pytest.mark.parametrize("plan", [plan_width, plan_conditioning])
def test_a_table_on_a_phone_shows_results_and_keeps_what_they_are_of(plan, chromium):  # noqa: F811
    """The first column after the heading was of parameters, and scrolling took the heading away."""
    sweep, (runner, browser) = plan(CPU_FULL), chromium
    rows = rows_of(sweep, lambda _: {"cross_entropy": 4.1, "perplexity": 75.0, "delta_psnr": 0.5, "psnr": 20.0})

    async def look() -> list[dict[str, list[float]]]:
        page = await browser.new_page(viewport={"width": 390, "height": 800})
        try:
            said = describe(sweep, rows, [], AxisStatistics())
            await page.set_content(f"<!doctype html><style>{CSS}</style><main>{said}</main>")
            return await page.evaluate(WHERE)
        finally:
            await page.close()

    tables = runner.run(look())
    assert tables and any(at["scrolled"] > 0 for at in tables)
    for at in tables:
        assert min(*at["first"], *at["heading"]) >= 0, at
