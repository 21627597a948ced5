"""Imported by every process of the tests, also by those that tests start as `python -m tests.*`."""

import gc

# Tracing makes millions of objects that live on: looking through them again and again took an eighth of all time.
gc.set_threshold(100_000, 20, 20)
