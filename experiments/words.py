"""Words of messages that several modules use."""

from __future__ import annotations

from collections.abc import Sequence


def few(names: Sequence[str]) -> str:
    """The first names of a list that may be long."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
