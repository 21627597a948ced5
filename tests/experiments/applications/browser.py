"""A real Chromium, and the page of `hma play` in it."""

from __future__ import annotations

import asyncio
import os
import shutil
from importlib.resources import files
from types import SimpleNamespace

import pytest

CHROMIUM = os.environ.get("PLAYWRIGHT_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
PATIENCE = 60_000
"""Milliseconds that anything may take on a busy machine."""


async def launched(play):
    """A browser: the one that is installed, or playwright's own. Skips the test where there is neither."""
    from playwright.async_api import Error

    try:
        return await play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
    except Error as error:
        pytest.skip(f"no Chromium: install it, or name it in PLAYWRIGHT_CHROMIUM ({str(error).splitlines()[0]})")


@pytest.fixture(scope="module")
def chromium():
    """A loop and the browser in it, for all tests: beginning one takes longer than most of them."""
    playwright = pytest.importorskip("playwright.async_api", reason="needs the extra `test`")
    with asyncio.Runner() as runner:
        play = runner.run(playwright.async_playwright().start())
        try:
            browser = runner.run(launched(play))
            yield runner, browser
            runner.run(browser.close())
        finally:
            runner.run(play.stop())


@pytest.fixture
def browsing(chromium):
    """Runs `test(browser, address, client)` against a server of this process; who came in leaves with it."""
    from tests.experiments.applications.serving import serving

    runner, browser = chromium

    def run(test, **options) -> None:
        async def with_browser(client) -> None:
            try:
                await test(browser, str(client.make_url("/")), client)
            finally:
                for context in browser.contexts:
                    await context.close()

        serving(with_browser, run=runner.run, **options)

    return run


def edit_page(monkeypatch, old: str, new: str) -> None:
    """Servers that begin from now on serve the page with `new` in place of `old`."""
    from experiments.applications.play import server

    page = files("experiments.applications.play").joinpath("page.html").read_text()
    assert old in page
    edited = SimpleNamespace(joinpath=lambda _: SimpleNamespace(read_text=lambda **_: page.replace(old, new)))
    monkeypatch.setattr(server, "files", lambda _: edited)


async def opened(browser, address: str, **how):
    """The page in a new context (a person), an episode under way. Waiting for an expression needs `bypass_csp`."""
    context = await browser.new_context(**{"bypass_csp": True, **how})
    page = await context.new_page()
    page.set_default_timeout(PATIENCE)
    page.faults = []
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    await page.goto(address)
    await page.wait_for_selector("body[data-count]")
    return page


async def count(page) -> int:
    return int(await page.evaluate("document.body.dataset.count"))


async def frames(page, number: int) -> None:
    """Waits for so many more frames of the episode: what the page counts now may be any number."""
    here = await count(page)
    await page.wait_for_function(f"document.body.dataset.count >= {here + number}")
