"""Shared by tests of experiments: pages without the time that drawing takes."""

from __future__ import annotations

import base64

import pytest

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


def leave_unrendered(patch: pytest.MonkeyPatch) -> None:
    """Figures are made as ever, with all that they show, and their files hold one pixel: laying them out and painting
    them takes most of the time of a page."""
    patch.setattr("matplotlib.figure.Figure.savefig", lambda figure, file, **_: file.write(PIXEL))


@pytest.fixture
def unrendered(monkeypatch):
    leave_unrendered(monkeypatch)
