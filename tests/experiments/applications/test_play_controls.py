"""The page's keys, pads, sliders and gamepads in a real Chromium, by hand and by keyboard alone."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("aiohttp", reason="needs the extra `play`")
pytest.importorskip("playwright.async_api", reason="needs the extra `test`")

from experiments.applications.play.server import SESSIONS  # noqa: E402
from tests.experiments.applications.browser import edit_page, frames, opened  # noqa: E402
from tests.experiments.applications.serving import until  # noqa: E402

PUSH = 2.1  # what a key asks of the pusher, whose rest is 0


def executed(client) -> list[list[float]]:
    """The actions of every frame from now on, as they are made."""
    simulator, made = client.server.app[SESSIONS].simulator, []
    step = simulator.step

    def stepped(actions):
        made.extend(np.asarray(a)[0].tolist() for a in actions if a is not None)
        return step(actions)

    simulator.step = stepped
    return made


async def drives_arm(page) -> None:
    await page.click("#robots button[data-name=arm]")
    await page.wait_for_function("document.querySelectorAll('.slider').length == 7")
    await frames(page, 1)


def test_a_tap_between_two_frames_is_made_in_the_next_one(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        made = executed(client)
        for tap in (
            "for (const kind of ['keydown', 'keyup']) dispatchEvent(new KeyboardEvent(kind, {code: 'ArrowRight'}))",
            "document.querySelector('[data-key=ArrowRight]').click()",  # as assistive technology does
        ):
            await page.evaluate(tap)
            await frames(page, 4)
            assert [a for a in made if any(a)] == [pytest.approx([PUSH, 0])], made
            made.clear()
        await page.select_option("#rate", "2")
        await frames(page, 1)
        await page.click("[data-key=ArrowRight]")
        await frames(page, 3)
        assert pytest.approx([PUSH, 0]) in made
        assert not page.faults

    browsing(test)


def test_a_tap_before_a_pause_is_forgotten(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        made = executed(client)
        await page.evaluate("""for (const [kind, code] of [['keydown', 'ArrowRight'], ['keyup', 'ArrowRight'],
            ['keydown', 'Space'], ['keyup', 'Space']]) dispatchEvent(new KeyboardEvent(kind, {code}))""")
        await page.wait_for_function("!state.pending.length")
        await page.click("#run")
        await frames(page, 3)
        assert not any(map(any, made)) and not page.faults

    browsing(test)


def test_every_dimension_is_set_by_the_keyboard_and_stays_until_its_slider_is_left(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await drives_arm(page)
        made = executed(client)
        await page.focus("#dimension6")
        low, high = await page.evaluate("[state.robot.low[6], state.robot.high[6]]")
        for key, least in (("ArrowRight", 0.005), ("PageUp", 0.05), ("End", 0.499)):
            await page.keyboard.press(key)
            await frames(page, 2)
            made.clear()
            await frames(page, 2)
            assert made and all(a[:6] == pytest.approx([0.5] * 6, abs=0.01) for a in made), "it moves the others"
            assert all(a[6] - 0.5 >= least * (high - low) for a in made), (key, made)
        await page.keyboard.down("KeyD")
        await frames(page, 3)
        assert made[-1][2] > 0.6 and made[-1][6] > 0.79, "letters drive on"
        await page.keyboard.up("KeyD")
        await page.keyboard.press("Tab")
        await frames(page, 3)
        assert made[-1] == pytest.approx([0.5] * 7, abs=0.01) and not page.faults

    browsing(test)


def test_what_a_pointer_has_moved_or_pressed_leaves_the_keys_to_the_robot(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await drives_arm(page)
        made = executed(client)
        box = await page.locator("#dimension3").bounding_box()
        await page.mouse.move(box["x"] + box["width"] * 0.9, box["y"] + box["height"] / 2)
        await page.mouse.down()
        await frames(page, 2)
        await page.mouse.move(box["x"] + box["width"] * 0.8, box["y"] - 200)
        await page.mouse.up()
        await page.keyboard.down("ArrowRight")
        await frames(page, 3)
        assert made[-1] == pytest.approx([0.71] + [0.5] * 6, abs=0.01)
        await page.keyboard.up("ArrowRight")
        await page.click("#back")
        await page.keyboard.press("Space")
        await frames(page, 2)
        assert await page.inner_text("#run") == "Pause" and not page.faults

    browsing(test)


def test_a_button_that_has_the_focus_is_pressed_by_space_and_keeps_it(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.focus("#record")
        await page.keyboard.press("Space")
        await page.wait_for_function("state.recording")
        assert await page.inner_text("#run") == "Pause" and await page.evaluate("document.activeElement.id") == "record"
        made = executed(client)
        await page.focus("[data-key=ArrowRight]")
        await page.keyboard.press("Enter")
        await frames(page, 3)
        assert [a for a in made if any(a)] == [pytest.approx([PUSH, 0])], made
        await page.focus("#dimension0")
        await page.keyboard.press("Space")
        assert await page.inner_text("#run") == "Resume", "a slider has no use for it"
        assert not page.faults

    browsing(test)


def test_a_stick_that_drifts_does_not_keep_an_abandoned_page_going(browsing, monkeypatch):
    edit_page(monkeypatch, "IDLE = 60e3", "IDLE = 1e3")

    async def test(browser, address, client):
        page = await opened(browser, address)
        made = executed(client)
        await page.evaluate("pad = {mapping: 'standard', axes: [0.2, 0, 0, 0]}; navigator.getGamepads = () => [pad]")
        await page.evaluate("setInterval(() => { pad.axes[0] = 0.15 + 0.06 * Math.random(); })")
        await until(lambda: any(map(any, made)))
        await page.wait_for_function("!state.running")
        await page.evaluate("pad.axes[1] = 0.9")
        await page.wait_for_function("state.running")
        await page.wait_for_timeout(1500)
        assert await page.evaluate("state.running") and not page.faults, "it is held, as a key may be"

    browsing(test)


def test_only_the_first_button_of_a_pointer_presses_and_takes_the_focus(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        made = executed(client)
        await page.click("#back", button="right")
        await page.click("[data-key=ArrowRight]", button="middle")
        await frames(page, 3)
        assert not any(map(any, made))
        assert await page.evaluate("document.activeElement") == await page.evaluate("document.body")
        await page.keyboard.press("Space")
        assert await page.inner_text("#run") == "Resume", "it pauses"
        await page.keyboard.press("Space")
        await frames(page, 2)
        assert not page.faults

    browsing(test)


def test_a_slider_that_a_pointer_holds_keeps_the_page_going(browsing, monkeypatch):
    """As a key or a stick that is held does."""
    edit_page(monkeypatch, "IDLE = 60e3", "IDLE = 1e3")

    async def test(browser, address, client):
        page = await opened(browser, address)
        box = await page.locator("#dimension0").bounding_box()
        await page.mouse.move(box["x"] + box["width"] * 0.9, box["y"] + box["height"] / 2)
        await page.mouse.down()
        await page.wait_for_timeout(2500)
        assert await page.evaluate("state.running")
        await page.mouse.up()
        await page.wait_for_function("!state.running")
        await page.focus("#dimension0")
        await page.keyboard.press("ArrowRight")
        await page.wait_for_function("state.running")
        await page.wait_for_function("!state.running")  # by the keyboard it may stay set on an abandoned page
        assert not page.faults

    browsing(test)
