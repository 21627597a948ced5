"""Intervals of few draws: what they are is tested in `test_agreement`, with the draws that it names."""

import pytest

from experiments.applications.judging import agreement


@pytest.fixture
def few_draws(monkeypatch):
    for function in (agreement.agree, agreement.agree_with_counts, agreement.share, agreement.mean_above):
        monkeypatch.setattr(function, "__defaults__", (50,))
