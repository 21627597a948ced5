"""Sums that committed tables are written from."""

from hma_jax.evaluation.sums import add_up


def test_numbers_are_added_one_after_the_other_on_every_python():
    """`sum` of Python 3.12 says 2.0 here."""
    assert add_up([1e16, 1.0, 1.0, -1e16]) == 0.0
    assert add_up(iter([0.1] * 10)) == 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1
    assert add_up([]) == 0.0
