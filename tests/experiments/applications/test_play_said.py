"""What the page says in a real Chromium, also to those who do not see it."""

from __future__ import annotations

import pytest

pytest.importorskip("aiohttp", reason="needs the extra `play`")
pytest.importorskip("playwright.async_api", reason="needs the extra `test`")

from experiments.applications.play import recording  # noqa: E402
from experiments.applications.play.server import SESSIONS  # noqa: E402
from tests.experiments.applications.browser import edit_page, frames, opened  # noqa: E402
from tests.experiments.applications.serving import Player, until  # noqa: E402
from tests.experiments.applications.test_play_server import FakeTruth  # noqa: E402


def test_a_page_without_input_says_why_time_stands_still(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.evaluate("state.input -= 61e3")
        await page.wait_for_function("!state.running")
        assert "paused: no input for 60 s" in await page.inner_text("#said")
        for key in ("KeyR", "Backspace"):
            await page.wait_for_timeout(5)
            await page.keyboard.press(key)
            await page.wait_for_function("!state.pending.length")
            assert "paused: no input for 60 s" in await page.inner_text("#said"), "one frame came, it is still paused"
        await page.keyboard.press("ArrowUp")
        await frames(page, 2)
        assert await page.inner_text("#said") == "" and not page.faults

    browsing(test)


def test_a_page_that_was_hidden_says_why_time_stands_still(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        hide = "Object.defineProperty(document, 'hidden', {value: true}); document.dispatchEvent(new Event('visibilitychange'))"
        await page.click("#run")
        await page.evaluate(hide)
        assert await page.inner_text("#said") == "", "who paused it knows why"
        await page.click("#run")
        await page.evaluate(hide)
        await page.wait_for_function("!state.pending.length")
        assert "paused: the page was hidden" in await page.inner_text("#said")
        await page.click("#run")
        await frames(page, 2)
        assert await page.inner_text("#said") == "" and not page.faults

    browsing(test)


def test_what_is_chosen_is_told_without_colours_and_keeps_the_focus(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        pressed = "[...document.querySelectorAll('[aria-pressed=true]')].map(b => b.ariaLabel)"
        assert await page.evaluate(pressed) == ["pusher", "start 1"]
        await page.focus("[data-name=arm]")
        await page.keyboard.press("Enter")
        assert await page.evaluate(pressed) == ["arm", "start 1"]
        await page.focus("[aria-label='start 2']")
        await page.keyboard.press("Enter")
        assert await page.evaluate(pressed) == ["arm", "start 2"]
        assert await page.evaluate("document.activeElement.ariaLabel") == "start 2"
        assert not page.faults

    browsing(test)


def test_frames_say_nothing_again_and_leave_an_error_readable(browsing, monkeypatch):
    edit_page(monkeypatch, "STAYS = 4e3", "STAYS = 1e3")

    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.evaluate("""window.told = []; for (const id of ["status", "said"])
            new MutationObserver(() => told.push(id)).observe($(id), {childList: true, subtree: true})""")
        await frames(page, 5)
        assert await page.evaluate("told") == []
        await page.evaluate("tell({type: 'truth', on: true})")
        await page.wait_for_function("$('said').textContent.includes('no true simulator here')")
        await frames(page, 3)
        assert "no true simulator here" in await page.inner_text("#said")
        await page.wait_for_function("$('said').textContent === ''")
        assert await page.evaluate("told") == ["said", "said"] and not page.faults

    browsing(test)


def test_a_recording_that_is_full_says_so_until_another_begins(browsing, monkeypatch):
    monkeypatch.setattr(recording, "MOST_FRAMES", 4)

    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.click("#record")
        await page.wait_for_selector("text=The recording is full (4 frames)")
        await frames(page, 2)
        assert await page.inner_text("#record") == "Record"
        assert "full (4 frames)" in await page.inner_text("#saved")
        monkeypatch.setattr(recording, "MOST_FRAMES", 100)
        await page.click("#record")
        await page.wait_for_function("state.recording")
        assert "full" not in await page.inner_text("#saved") and not page.faults

    browsing(test)


def test_a_recording_that_ends_with_its_episode_says_so(browsing):
    """Who pressed R for another try drove on, and the try was not recorded."""

    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.click("#robots button[data-name=arm]")
        ended = "the recording ended with its episode; download it before you record again"
        for end, said in (
            ("$('record').click()", ""),  # who ended it knows
            ("begin(state.robot, 1)", ended),
            ("tell({type: 'truth', on: true})", ended),
        ):
            await page.evaluate("say('', 1)")
            await page.click("#record")
            await page.wait_for_function("state.recording")
            await frames(page, 2)
            await page.evaluate(end)
            await page.wait_for_function("!state.recording")
            assert await page.inner_text("#said") == said
        assert not page.faults

    browsing(test, truth=FakeTruth)


def test_an_episode_that_was_lost_with_the_connection_is_not_begun_anew_without_a_word(browsing):
    """Somebody else needed the place, as after a new start of the server; the recording cannot be downloaded either."""

    async def test(browser, address, client):
        page = await opened(browser, address)
        visitors = client.server.app[SESSIONS].visitors
        for recorded in (False, True):
            if recorded:
                await page.click("#record")
                await page.wait_for_function("state.recording")
                await frames(page, 2)
            await page.evaluate("state.socket.onclose = null; state.socket.close()")
            await until(lambda: all(visitor.socket is None for visitor in visitors.values()))
            other = Player(client)
            await other.enter(begin=False)
            await other.socket.close()
            await until(lambda: all(visitor.socket is None for visitor in visitors.values()))
            await page.evaluate("connect()")
            await page.wait_for_function("state.socket.readyState === 1 && state.tries === 0 && !state.pending.length")
            lost = "the episode and its recording were lost" if recorded else "the episode was lost"
            assert f"paused: {lost} with the connection, and a new one began" in await page.inner_text("#said")
            assert await page.inner_text("#record") == "Record" and not await page.is_visible("#saved")
            await page.click("#run")
            await frames(page, 2)
            assert await page.inner_text("#said") == "" and not page.faults

    browsing(test, visitors=1)
