"""The page in a real Chromium: what a visitor sees and does."""

from __future__ import annotations

import base64
import io
import json
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("aiohttp", reason="needs the extra `play`")
pytest.importorskip("playwright.async_api", reason="needs the extra `test`")

from PIL import Image  # noqa: E402

from experiments.applications.play import sessions  # noqa: E402
from experiments.applications.play.server import SESSIONS  # noqa: E402
from tests.experiments.applications.browser import PATIENCE, count, edit_page, frames, opened  # noqa: E402
from tests.experiments.applications.serving import SECONDS, until  # noqa: E402
from tests.experiments.applications.test_play_server import FakeTruth  # noqa: E402


async def picture(page) -> np.ndarray:
    data = await page.get_attribute("#seen", "src")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.split(",")[1]))), np.int16)


async def actions(client) -> list[list[float]]:
    """The chunks of every visitor's newest frame."""
    simulator = client.server.app[SESSIONS].simulator
    return [e.chunks[-1].tolist() for e in simulator._episodes if e is not None and e.chunks]


def test_keys_move_the_robot_and_letting_go_stops_it(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.keyboard.down("ArrowRight")
        await frames(page, 3)
        pressed = (await actions(client))[0][:2]
        assert pressed[0] > 1 and pressed[1] == 0, pressed
        await page.keyboard.up("ArrowRight")
        await page.keyboard.down("KeyS")
        await frames(page, 3)
        pressed = (await actions(client))[0][:2]
        assert pressed[0] == 0 and pressed[1] < 0, pressed
        await page.keyboard.down("Meta")
        await frames(page, 3)
        assert (await actions(client))[0][:2] == [0, 0], "macOS does not tell that S is let go"
        await page.keyboard.up("Meta")
        await page.click("#run")
        await page.wait_for_timeout(300)
        before = await count(page)
        await page.wait_for_timeout(500)
        assert await count(page) == before, "time goes on while it is paused"
        assert not page.faults

    browsing(test)


def test_a_gamepad_drives_by_axes_that_are_known_and_neither_it_nor_a_held_key_ends_a_pause(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.click("#robots button[data-name=arm]")
        await page.evaluate("navigator.getGamepads = () => [window.pad]")
        for mapping, trigger in (("", 0.5), ("standard", 0.29)):
            await page.evaluate(f"pad = {{mapping: '{mapping}', axes: [1, 0, -1, 0]}}")
            await frames(page, 3)
            assert (await actions(client))[0][:4] == pytest.approx([0.71, 0.5, trigger, 0.5], abs=0.01)
        await page.keyboard.down("ArrowRight")
        await page.click("#run")
        await page.keyboard.down("ArrowRight")  # it repeats
        await page.wait_for_timeout(300)
        assert await page.inner_text("#run") == "Resume"
        await page.keyboard.up("ArrowRight")
        await page.evaluate("pad.axes = [0, 0, 0, 0]")
        await page.wait_for_function("!state.sticks[0]")
        await page.evaluate("pad.axes = [1, 0, 0, 0]")
        await page.wait_for_function("state.running")
        assert not page.faults

    browsing(test)


def test_keys_drive_once_the_rate_is_chosen(browsing):
    """And do not choose another one."""

    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.focus("#rate")
        await page.select_option("#rate", "15")
        await page.keyboard.down("ArrowRight")
        await frames(page, 3)
        pressed = (await actions(client))[0][:2]
        assert pressed[0] > 1 and pressed[1] == 0, pressed
        assert await page.input_value("#rate") == "15" and not page.faults

    browsing(test)


def test_the_robots_own_rate_can_be_chosen_where_it_is_known(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        own = page.locator("#own")
        assert await own.is_disabled() and await page.input_value("#rate") == "8", "the fakes do not know it"
        for hz, rate, chosen in ((6, "3", "8"), (5, "2.5", "2.5"), (0, "0", "8")):
            await page.evaluate(f"Object.assign(state.robot, {{hz: {hz}, stride: 2}}); begin(state.robot, 0)")
            assert await page.input_value("#rate") == chosen
            assert await own.get_attribute("value") == rate and await own.is_disabled() == (not hz)
            if hz:
                assert await own.text_content() == f"{rate} (real time)"
                await page.evaluate("own.selected = true")
        await frames(page, 3)
        assert not page.faults

    browsing(test)


def test_a_slider_sets_its_dimension_and_rewinding_goes_back(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address, has_touch=True)
        await page.click("#robots button[data-name=arm]")
        await page.wait_for_function("document.querySelectorAll('.slider').length == 7")
        box = await page.locator("#dimension3").bounding_box()
        await page.mouse.move(box["x"] + box["width"] * 0.9, box["y"] + box["height"] / 2)
        await page.mouse.down()
        await frames(page, 4)
        action = (await actions(client))[0][:7]
        assert action[3] > 0.7 and action[2] == pytest.approx(0.5, abs=0.01), action
        await page.mouse.up()
        finger = await page.context.new_cdp_session(page)
        for kind, share in (("touchStart", 0.9), ("touchMove", 0.8)):
            place = [{"x": box["x"] + box["width"] * share, "y": box["y"] + box["height"] / 2}]
            await finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": place})
        await page.wait_for_function("state.drag.size")
        await finger.send("Input.dispatchTouchEvent", {"type": "touchCancel", "touchPoints": []})
        await page.wait_for_function("!state.drag.size")
        for ends in ("letGo()", "begin(state.robot, 0)"):
            await page.evaluate(f"state.drag.set(2, 0.9); {ends}")
            assert await page.evaluate("state.drag.size") == 0, ends
        await frames(page, 4)
        await page.click("#run")
        await page.wait_for_timeout(300)
        before = await count(page)
        await page.click("#back")
        await page.wait_for_function(f"document.body.dataset.count == {before - 1}")
        await page.focus("#back")
        await page.keyboard.press("Enter")
        await page.wait_for_function(f"document.body.dataset.count == {before - 2}")
        assert not page.faults

    browsing(test)


def test_rewinding_ends_at_the_first_frame_and_when_the_page_is_left(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.evaluate(  # as in browsers that tell nothing of disabled buttons
            "addEventListener('pointerup', event => { if (event.target.disabled) event.stopImmediatePropagation(); }, true)"
        )
        await page.hover("#back")
        for ends in ("document.getElementById('back').disabled", "!dispatchEvent(new Event('blur')) || true"):
            await page.mouse.down()
            await page.wait_for_function(ends)
            await page.evaluate("pause(false)")
            await frames(page, 5)
            await page.wait_for_timeout(400)
            assert await page.inner_text("#run") == "Pause", "it still rewinds"
            await page.mouse.up()
        assert not page.faults

    browsing(test)


def test_a_reload_and_a_lost_connection_find_the_episode_again(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.wait_for_function("document.body.dataset.count > 5")
        await page.click("#run")
        await page.wait_for_timeout(300)
        before = await count(page)
        await page.reload()
        await page.wait_for_function(f"document.body.dataset.count >= {before}")
        await page.evaluate("state.socket.close()")
        here = await count(page)
        await page.wait_for_function(f"document.body.dataset.count > {here} && state.socket.readyState == 1")
        assert not page.faults

    browsing(test, visitors=1)


def test_a_server_that_stands_still_is_lost_before_the_browser_says_so(browsing, monkeypatch):
    """The one that is connected, and the next one, to which no connection is made."""
    edit_page(monkeypatch, "PATIENCE = 10e3", "PATIENCE = 1e3")

    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.evaluate("""{
            state.socket.onmessage = null; state.socket.close = () => {};
            window.said = []; new MutationObserver(() => said.push($("status").textContent)).observe($("status"), {childList: true});
            const real = WebSocket;
            WebSocket = class { static OPEN = 1; readyState = 0; constructor() { WebSocket = real; } close() {} };
            void 0;
        }""")
        await page.wait_for_function("said.length > 2 && said.at(-1) === 'connected'")
        lost = [f"connection lost; trying again in {seconds} s" for seconds in (0.5, 1)]
        assert (await page.evaluate("said"))[:2] == lost
        await frames(page, 2)
        assert not page.faults

    browsing(test)


@pytest.mark.parametrize("known", [True, False])
def test_a_robot_that_is_chosen_while_the_connection_is_lost_begins_once_there_is_one(browsing, known: bool):
    """Also one that is chosen before the page knows that the connection is lost."""

    async def test(browser, address, client):
        page = await opened(browser, address)
        choose, lose = "document.querySelector('[data-name=arm]').click()", "state.socket.close()"
        if known:
            await page.evaluate(f"{lose}; {choose}")
        else:
            await page.evaluate(f"state.socket.send = () => {{}}; {choose}")
            assert await page.evaluate("state.begun && state.socket.readyState == 1")
            await page.evaluate(lose)
        await page.wait_for_function("state.socket.readyState == 1 && state.tries == 0")
        await frames(page, 2)
        assert await page.inner_text("#name") == "arm" and not page.faults
        [visitor] = client.server.app[SESSIONS].visitors.values()
        assert visitor.session.robot.name == "arm"

    browsing(test)


def test_who_finds_no_place_waits_for_one_and_cannot_press_anything_meanwhile(browsing, monkeypatch):
    edit_page(monkeypatch, "RETRY = 10e3", "RETRY = 0.2e3")

    async def test(browser, address, client):
        first = await opened(browser, address)
        second = await (await browser.new_context(bypass_csp=True)).new_page()
        await second.goto(address)
        await second.wait_for_function("document.getElementById('status').textContent.includes('trying again in 0.2')")
        assert "all places are taken" in await second.inner_text("#status")
        assert await second.evaluate("[...document.querySelectorAll('button')].every(b => b.closest('[inert]'))")
        assert not await second.is_visible("#seen"), "a picture that is broken"
        await first.close()
        await second.wait_for_selector("body[data-count]", timeout=PATIENCE)
        await second.wait_for_function("document.getElementById('status').textContent == 'connected'")
        assert not await second.evaluate("document.querySelector('[inert]')") and await second.is_visible("#seen")

    browsing(test, visitors=1)


def test_a_page_that_is_loaded_again_while_a_robot_begins_shows_that_robot(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        simulator, asked, go_on = client.server.app[SESSIONS].simulator, threading.Event(), threading.Event()
        reset = simulator.reset
        simulator.reset = lambda *what, **how: (asked.set(), go_on.wait(SECONDS), reset(*what, **how))[-1]
        await page.click("#robots button[data-name=arm]")
        await until(asked.is_set)
        await page.reload()
        await page.wait_for_function("state.robot?.name == 'pusher' && state.pending.length")  # what the greeting says
        go_on.set()
        await page.wait_for_function("document.querySelectorAll('.slider').length == 7")
        await frames(page, 3)
        assert await page.inner_text("#name") == "arm" and await page.inner_text("#said") == "" and not page.faults

    browsing(test)


def test_a_browser_that_keeps_nothing_drives_and_finds_the_episode_again(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.add_init_script(
            "Object.defineProperty(window, 'sessionStorage', {get() { throw new DOMException(); }})"
        )
        await page.reload()
        await page.wait_for_selector("body[data-count]")
        await page.evaluate("state.socket.close()")
        await frames(page, 5)
        visitors = client.server.app[SESSIONS].visitors
        assert len(visitors) == 2 and await page.evaluate("token") in visitors and not page.faults

    browsing(test)


def test_nothing_is_sent_before_the_greeting(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.evaluate("""window.sent = []; window.WebSocket = class {
            static OPEN = 1;
            readyState = 0;
            constructor() { setTimeout(() => { this.readyState = 1; this.onopen?.(); window.open_ = true; }); }
            send(text) { sent.push(JSON.parse(text).type); }
        }; state.socket.close()""")
        await page.keyboard.down("ArrowUp")
        await page.wait_for_function("window.open_")
        await page.wait_for_timeout(200)
        assert await page.evaluate("sent") == []
        await page.evaluate("hear({type: 'hello', token, robot: state.robot.name, start: 0})")
        assert (await page.evaluate("sent"))[:1] == ["rewind"]
        assert not page.faults

    browsing(test)


def test_two_visitors_do_not_mix_and_a_third_is_told(browsing):
    async def test(browser, address, client):
        first = await opened(browser, address)
        second = await opened(browser, address)
        await second.click("#robots button[data-name=arm]")
        await second.wait_for_function("document.querySelectorAll('.slider').length == 7")
        await first.keyboard.down("ArrowUp")
        for page in (first, second):
            await frames(page, 3)
        one, other = await actions(client)
        assert one[1] > 1 and one[2:] == [0.0] * (len(one) - 2), "the pusher's own action"
        assert other[:7] == pytest.approx([0.5] * 7, abs=0.01), "the arm's rest"
        third = await (await browser.new_context(bypass_csp=True)).new_page()
        await third.goto(address)
        await third.wait_for_function(
            "document.getElementById('status').textContent.includes('all places')", timeout=PATIENCE
        )

    browsing(test)


def test_what_is_clicked_while_an_answer_is_under_way_does_not_make_the_next_ones_later(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        simulator = client.server.app[SESSIONS].simulator
        step = simulator.step
        simulator.step = lambda actions: (time.sleep(0.05), step(actions))[-1]
        talk = await overheard(page)
        first = len(talk)
        for button in ("#again", "#record", "#again", "#robots button[data-name=arm]", "#starts button", "#record"):
            await page.evaluate(f"document.querySelector('{button}').click()")
        await until(lambda: talk[first:].count("act") > 3)
        asked = [
            (talk[:i].count("<") - 1, i - talk[:i].count("<")) for i in range(first, len(talk)) if talk[i] == "act"
        ]
        assert all(a == b for a, b in asked), f"(answers but for the greeting, questions): {asked}"
        await page.wait_for_function("+document.getElementById('latency').textContent >= 50")
        assert not page.faults

    browsing(test)


def test_a_rewind_is_made_once_what_is_under_way_has_come_and_is_not_of_the_robot_chosen_after_it(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        await page.wait_for_function("document.body.dataset.count > 5")
        talk = await overheard(page)
        told = talk.count("rewind")  # by the new connection
        await page.evaluate("tell({type: 'rewind', frames: 0}); rewind()")
        await until(lambda: talk.count("rewind") == told + 2)
        await page.evaluate("tell({type: 'rewind', frames: 1}); begin(state.robots.find(r => r.name == 'arm'), 0)")
        await page.wait_for_function("!state.pending.length")
        assert await page.evaluate("state.action.length") == 7, "the frame that was gone back to was another robot's"
        assert not page.faults

    browsing(test)


def test_a_model_that_takes_longer_than_the_page_waits_for_a_word_is_slow_and_not_lost(browsing, monkeypatch):
    monkeypatch.setattr(sessions, "PROGRESS_SECONDS", 0.2)
    edit_page(monkeypatch, "PATIENCE = 10e3", "PATIENCE = 1e3")

    async def test(browser, address, client):
        page = await opened(browser, address)
        connections, status = [], "document.getElementById('status').textContent"
        page.on("websocket", lambda socket: connections.append(socket))
        simulator = client.server.app[SESSIONS].simulator
        step = simulator.step
        simulator.step = lambda actions: (time.sleep(2.5), step(actions))[-1]
        await page.wait_for_function(f"{status}.startsWith('slow: this frame has taken 2 s')")
        shown = "+document.getElementById('fps').textContent"
        await page.wait_for_function(f"{shown} > 0 && {shown} < 0.5")
        simulator.step = step
        here = await count(page)
        await page.wait_for_function(f"document.body.dataset.count > {here} && {status} == 'connected'")
        assert not connections, "it took the connection for lost, and made another"

    browsing(test)


async def overheard(page) -> list[str]:
    """Of the page's present connection from now on: types of what it says, "<" for each answer. A new connection."""
    talk: list[str] = []

    def listen(socket) -> None:
        socket.on("framesent", lambda text: talk.append(json.loads(text)["type"]))
        socket.on("framereceived", lambda text: talk.append("<") if json.loads(text)["type"] != "working" else None)

    page.on("websocket", listen)
    await page.evaluate("state.socket.close()")
    await until(lambda: "rewind" in talk)  # what it says to the greeting
    return talk


def test_a_key_that_is_held_begins_or_pauses_once_and_none_before_there_is_a_robot(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        talk = await overheard(page)
        for key in ("r", "Space"):
            for _ in range(5):  # the first presses it, the others are repeats
                await page.keyboard.down(key)
            await page.keyboard.up(key)
        assert await page.inner_text("#run") == "Resume"
        await until(lambda: "start" in talk)
        await page.wait_for_function("!state.pending.length")
        await page.wait_for_timeout(100)
        assert talk.count("start") == 1
        await page.route("**/robots", lambda route: None)  # the answer does not come
        await page.reload()
        await page.keyboard.press("r")
        assert await page.locator("#again").evaluate("button => !!button.closest('[inert]')")
        assert not page.faults

    browsing(test)


@pytest.mark.slow
def test_the_page_says_that_a_model_without_actions_follows_none(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address)
        assert "the action returns to rest" in await page.inner_text("#holds")
        await page.evaluate("state.robots.forEach(robot => { robot.deaf = true; })")
        await page.click("#robots button[data-name=arm]")
        assert "trained without actions, so they have no effect" in await page.inner_text("#holds.bad")
        assert not page.faults

    browsing(test)


def test_a_place_to_go_to_stays_when_the_comparison_ends_and_goes_back_with_a_rewind(browsing):
    async def test(browser, address, client):
        simulator = client.server.app[SESSIONS].simulator
        simulator.update_robots([replace(simulator.robots["arm"], keeps=True)])
        page = await opened(browser, address)
        await page.click("#robots button[data-name=arm]")
        await page.evaluate("state.robot.keeps = true")
        await page.evaluate("document.getElementById('truth').click()")
        await page.wait_for_function("state.truth")
        await page.evaluate("state.action.fill(0.7)")
        await frames(page, 2)
        await page.evaluate("document.getElementById('truth').click()")
        await page.wait_for_function("!state.truth")
        assert await page.evaluate("state.action[0]") == pytest.approx(0.7)
        await page.click("#run")
        await page.wait_for_function("!state.pending.length")
        here = await count(page)
        await page.evaluate("state.action.fill(0.3)")
        await page.click("#run")
        await page.wait_for_function(f"document.body.dataset.count > {here}")
        await page.click("#run")
        for _ in range(100):
            if await count(page) <= here:
                break
            await page.click("#back")
            await page.wait_for_function("!state.pending.length")
        assert await page.evaluate("state.action[0]") == pytest.approx(0.7), "where it was sent before that frame"
        assert not page.faults

    browsing(test, truth=FakeTruth)


def test_it_fits_a_phone(browsing):
    async def test(browser, address, client):
        phone = {"viewport": {"width": 360, "height": 640}, "has_touch": True, "is_mobile": True}
        page = await opened(browser, address, bypass_csp=False, **phone)  # as a visitor has it
        assert await page.evaluate("document.documentElement.scrollWidth") <= 360
        assert not await page.is_visible("#saved"), "nothing was recorded yet"
        pad = await page.locator(".pads").bounding_box()
        assert pad["y"] + pad["height"] <= 640, "the picture and the pad are on one screen"
        await page.tap(".pad button[data-key=ArrowUp]")
        for width, height in ((500, 320), (740, 360)):  # on its side
            await page.set_viewport_size({"width": width, "height": height})
            assert await page.evaluate("document.documentElement.scrollWidth") <= width
            for part in (".views", ".pads"):
                box = await page.locator(part).bounding_box()
                assert box["y"] + box["height"] <= height, f"{part} is on the screen"
        assert not page.faults

    browsing(test)


def test_it_fits_a_laptop(browsing):
    async def test(browser, address, client):
        page = await opened(browser, address, viewport={"width": 1280, "height": 720})
        pad = await page.locator(".pads").bounding_box()
        assert pad["y"] + pad["height"] <= 720, "the picture and the pad are on one screen"
        picture = await page.locator("#seen").bounding_box()
        assert picture["width"] >= 340 and not page.faults

    browsing(test)
