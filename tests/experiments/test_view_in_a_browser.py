"""The page of `hma data view` in a real Chromium."""

from __future__ import annotations

from experiments.report.data_page import PAGE_CSS
from experiments.report.style import CSS
from tests.experiments.applications.browser import chromium  # noqa: F401  a fixture


def test_a_warning_does_not_look_worse_than_an_error(chromium):  # noqa: F811
    """All of its text was as red as only the title of an error is."""
    runner, browser = chromium

    async def colours() -> list[str]:
        page = await browser.new_page()
        try:
            issues = "".join(f"<p class={severity}><b>title</b>: text</p>" for severity in ("warning", "error"))
            await page.set_content(f"<!doctype html><style>{CSS}{PAGE_CSS}</style><main>{issues}</main>")
            of_all = "all => all.map(one => getComputedStyle(one).color)"
            return [*await page.eval_on_selector_all("p", of_all), *await page.eval_on_selector_all("b", of_all)]
        finally:
            await page.close()

    warning, error, warning_title, error_title = runner.run(colours())
    assert warning == error == warning_title != error_title
