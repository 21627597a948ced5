"""Tokenizers on eight (fake) devices: the same bytes as on one."""

from __future__ import annotations

import pytest

from tests.multidevice.run import run_on


@pytest.mark.slow
def test_tokens_and_frames_do_not_depend_on_the_number_of_devices():
    one, eight = run_on(1, "tokenize_on_devices"), run_on(8, "tokenize_on_devices")
    assert (one.pop("devices"), eight.pop("devices")) == (1, 8)
    assert (one.pop("at_once"), eight.pop("at_once")) == (2, 16)
    assert eight == one
