"""The page for a person's labels, in a real Chromium."""

import asyncio
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from experiments.applications.judging.blind import write_blind
from experiments.applications.judging.outcomes import LEARNED, SHUFFLED
from experiments.applications.policies.tasks import RecordedTask


def page_in(place: Path) -> str:
    """The address of a page of three clips."""
    films = np.random.default_rng(0).integers(256, size=(3, 2, 8, 8, 3), dtype=np.uint8)
    judged = SimpleNamespace(
        policies=("mine",), worlds=(LEARNED, SHUFFLED), rollouts=lambda name, world: SimpleNamespace(images=films),
        config=SimpleNamespace(starts=3, seed=0, task=RecordedTask("arm", goal="done")),
    )  # fmt: skip
    return write_blind(judged, place).as_uri()


async def saved_by(page) -> dict[str, bool]:
    """What stands in the file that the page saves; it goes with the page."""
    async with page.expect_download() as saved:
        await page.click("#save")
    return json.loads((await (await saved.value).path()).read_text())["labels"]


def test_labels_outlive_a_page_that_is_loaded_again(chromium, tmp_path):
    runner, browser = chromium

    async def test() -> None:
        page = await browser.new_page()
        where = page.locator("#where")
        await page.goto(page_in(tmp_path))
        await page.keyboard.press("Control+f")
        await page.keyboard.down("S")  # as after Caps Lock
        await page.keyboard.down("S")  # the key repeats
        await page.keyboard.press("ArrowRight")
        await page.keyboard.press("ArrowLeft")
        await page.click("#on")
        assert await where.inner_text() == "3 of 3, 1 labelled: not labelled"
        await page.reload()
        assert await where.inner_text() == "1 of 3, 1 labelled: success"
        assert await saved_by(page) == {"0": True}
        await page.close()

    runner.run(test())


def test_windows_keep_each_others_labels_and_a_page_says_where_none_are_kept(chromium, tmp_path):
    runner, browser = chromium
    loses = "1 of 3, 3 labelled: failure. This browser does not keep labels: save labels.json before you leave"

    async def test() -> None:
        context = await browser.new_context()
        one, other = [await context.new_page() for _ in range(2)]
        for page in (one, other):
            await page.goto(page_in(tmp_path))
        await one.keyboard.press("s")
        await one.keyboard.press("s")
        for key in ("f", "ArrowRight", "f"):  # the first one is corrected
            await other.keyboard.press(key)
        assert await saved_by(one) == {"0": False, "1": True, "2": False}
        await one.keyboard.press("f")
        assert await saved_by(other) == {"0": False, "1": True, "2": False}

        await other.evaluate("void (Storage.prototype.setItem = () => { throw new DOMException(); })")
        for key in ("s", "ArrowLeft", "ArrowLeft"):
            await other.keyboard.press(key)
        assert (await other.inner_text("#where")).startswith(loses)
        asked = []
        other.on("dialog", lambda dialog: (asked.append(dialog.type), asyncio.ensure_future(dialog.dismiss()))[1])
        async with other.expect_event("dialog"):
            await other.evaluate("setTimeout(() => location.reload())")
        assert asked == ["beforeunload"]
        assert await saved_by(other) == {"0": False, "1": True, "2": True}
        await other.reload()
        assert asked == ["beforeunload"], "what is saved may go"
        assert await other.inner_text("#where") == "1 of 3, 3 labelled: failure"
        await context.close()

    runner.run(test())
