"""Trials are run: which are missing, where each runs, and what became of it."""
