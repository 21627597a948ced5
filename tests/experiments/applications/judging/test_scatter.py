"""Names in the scatter plot of a judgement: beside their own policy alone, and none is lost without a word."""

import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from experiments.applications.judging import scatter
from experiments.applications.judging.scatter import NO_ROOM, draw_scatter, name_points, place
from experiments.applications.judging.summary import REFERENCE

RESULTS = Path(__file__).parents[4] / "experiments" / "results"


@pytest.fixture
def panel():
    figure, panel = plt.subplots(figsize=(4.8, 4.7))
    panel.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    figure.canvas.draw()
    yield panel
    plt.close(figure)


def test_a_name_is_beside_its_own_policy_alone(panel):
    """And those of policies whose points coincide stand together."""
    rates = {
        "first": (0.98, 0.86), "second": (0.96, 0.86), "alone": (0.2, 0.3), "twin": (0.2, 0.3), "mine": (0.98, 0.84),
    }  # fmt: skip
    words = name_points(panel, rates, ["mine"])
    assert [word.get_text() for word in words] == ["mine", "first", "second", "alone, twin"]
    assert place(words, panel)
    panel.figure.canvas.draw()
    boxes = [Text.get_window_extent(word) for word in words]
    for i, box in enumerate(boxes):
        assert panel.bbox.containsx(box.x0) and panel.bbox.containsx(box.x1)
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert not any(box.contains(*panel.transData.transform(at)) for at in rates.values())


def test_a_name_without_room_is_hidden(panel):
    crowd = {f"a policy with a long name, {i}": (0.1 + i / 50, 0.5) for i in range(40)}
    words = name_points(panel, crowd, [])
    assert not place(words, panel)
    assert {word.get_visible() for word in words} == {True, False}


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Draws the figure of a committed judgement."""
    figures = []
    monkeypatch.setattr(scatter, "save", lambda figure, _: figures.append(figure))

    def draw(name: str) -> Figure:
        summary = json.loads((RESULTS / f"judge-{name}" / "agreement.json").read_text())
        draw_scatter({"own": [], "compared with": REFERENCE} | summary, tmp_path / "scatter.png")
        return figures[-1]

    yield draw
    for figure in figures:
        plt.close(figure)


@pytest.mark.parametrize("name", ["pusher_sand-reach", "metaworld_drawer"])
def test_names_of_committed_judgements_are_seen_or_the_caption_says_where_they_are(drawn, name):
    figure = drawn(name)
    caption, seen = figure.get_supxlabel(), [word.get_visible() for panel in figure.axes for word in panel.texts]
    assert caption.startswith("lines: 95 % intervals; blue: cloned")
    assert all(seen) == (NO_ROOM not in " ".join(caption.split()))
    assert sum(seen) >= len(seen) - 2


def test_the_line_of_a_name_ends_at_its_own_point_and_touches_no_other(drawn):
    """It leaves from the middle of the name, and was thought to leave from what of the name is nearest."""
    figure = drawn("pusher_sand-reach")
    figure.canvas.draw()
    radius, lines = 3 * figure.dpi / 72, 0  # with its edge
    for panel in figure.axes:
        points = panel.transData.transform([word.xy for word in panel.texts])
        for word, own in zip(panel.texts, points, strict=True):
            if word.get_visible() and word.arrow_patch.get_visible():
                start, _, end = word.arrow_patch.get_path().vertices
                line = start + np.linspace(0, 1, 200)[:, None] * (end - start)
                others = points[(points != own).any(1)]
                assert np.linalg.norm(line[:, None] - others, axis=-1).min() > radius, word.get_text()
                lines += 1
    assert lines
