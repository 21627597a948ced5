"""Runs trials: which are missing, where each runs, and how it ended."""
