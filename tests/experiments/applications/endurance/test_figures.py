"""Curves over time: all that was measured lies within the panels."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from experiments.applications.endurance import figures
from experiments.applications.endurance.figures import PANELS, REFERENCE, draw_curves
from experiments.applications.endurance.tables import MEASURES


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """The figure of two minutes of two robots, which keep every share but follow in opposite ways."""
    kept = []
    monkeypatch.setattr(figures, "save", lambda figure, _: kept.append(figure))
    rows = [
        {"variant": "grown", "drive": "behaviour", "robot": robot, "start": 0, "part": minute, "seconds": 60.0}
        | dict.fromkeys(MEASURES, 0.9)
        | {"follows": follows, "object_found": 0.5 + follows / 2}
        for robot, follows in (("a", -0.9), ("b", 0.3))
        for minute in (1, 2)
    ]
    draw_curves(rows, tmp_path / "curves.png")
    (figure,) = kept
    yield dict(zip(PANELS, figure.axes, strict=True)), figure
    plt.close(figure)


def test_a_negative_correlation_lies_within_its_panel(drawn):
    panel = drawn[0]["follows"]
    low, high = panel.get_ylim()
    assert panel.lines[0].get_ydata() == pytest.approx([-0.3, -0.3]) and low < -0.3 < high


def test_bands_end_where_their_measure_does(drawn):
    for name, (least, most) in (("follows", (-1, 1)), ("object_found", (0, 1))):
        band = drawn[0][name].collections[0].get_paths()[0].vertices[:, 1]
        assert (band.min(), band.max()) == (least, most), name
    assert drawn[0]["follows"].get_ylim()[0] < -1 and drawn[0]["object_found"].get_ylim()[0] == 0


def test_what_is_dashed_has_one_name(drawn):
    (legend,) = drawn[1].legends
    assert [text.get_text() for text in legend.get_texts()] == ["grown", REFERENCE]
    assert np.isfinite(drawn[0]["psnr"].get_ylim()).all()
