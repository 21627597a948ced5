"""The page for a person's labels, in a real Chromium."""

import json
from types import SimpleNamespace

import numpy as np

from experiments.applications.judging.blind import write_blind
from experiments.applications.judging.outcomes import LEARNED, SHUFFLED
from experiments.applications.policies.tasks import RecordedTask


def test_labels_outlive_a_page_that_is_loaded_again(chromium, tmp_path):
    runner, browser = chromium
    films = np.random.default_rng(0).integers(256, size=(3, 2, 8, 8, 3), dtype=np.uint8)
    judged = SimpleNamespace(
        policies=("mine",), worlds=(LEARNED, SHUFFLED), rollouts=lambda name, world: SimpleNamespace(images=films),
        config=SimpleNamespace(starts=3, seed=0, task=RecordedTask("arm", goal="done")),
    )  # fmt: skip
    page_path = write_blind(judged, tmp_path)

    async def test() -> str:
        page = await browser.new_page()
        where = page.locator("#where")
        await page.goto(page_path.as_uri())
        await page.keyboard.press("Control+f")
        await page.keyboard.down("S")  # as after Caps Lock
        await page.keyboard.down("S")  # the key repeats
        await page.keyboard.press("ArrowRight")
        await page.keyboard.press("ArrowLeft")
        await page.click("#on")
        assert await where.inner_text() == "3 of 3, 1 labelled: not labelled"
        await page.reload()
        assert await where.inner_text() == "1 of 3, 1 labelled: success"
        async with page.expect_download() as saved:
            await page.click("#save")
        labels = (await (await saved.value).path()).read_text()
        await page.close()  # and what was saved goes with it
        return labels

    assert json.loads(runner.run(test()))["labels"] == {"0": True}
