"""What is measured on the embedded suite itself, before any model: commands and their tables."""

COMMITTED = "(default: the committed one)"
"""What help texts say of a table's path."""
