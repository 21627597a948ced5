"""Checks of a model rather than of code: the coordinate check of muP."""
