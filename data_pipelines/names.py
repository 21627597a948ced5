"""Names and paths that files of others give, before they become places on this machine's disk.

Owns what a dataset may be called and what a path inside a dataset may look like. Symbolic links are
followed, as caches of downloads are made of them; only the text of a path is judged here.
"""

from __future__ import annotations

import re
from pathlib import Path

LONGEST_NAME = 128
LONGEST_PATH = 1024

NAME_RULE = f"use up to {LONGEST_NAME} letters, digits, '_', '.' and '-', the first a letter, a digit or '_'"

_NAME = re.compile(rf"[A-Za-z0-9_][A-Za-z0-9_.-]{{0,{LONGEST_NAME - 1}}}")


def is_name(text: object) -> bool:
    """Whether `text` can be the name of a dataset, and so of a file or a directory."""
    return isinstance(text, str) and _NAME.fullmatch(text) is not None


def inside(root: Path, text: object) -> Path:
    """`root` / `text`, for a relative path that stays below `root`.

    Raises ValueError, saying why, for anything else.
    """
    if not isinstance(text, str) or not 0 < len(text) <= LONGEST_PATH or not text.isprintable():
        raise ValueError(f"{shown(text)} is no path of up to {LONGEST_PATH} printable characters")
    if text[0] == "/" or "\\" in text or ".." in text.split("/"):
        raise ValueError(f"{shown(text)} leaves the dataset's directory")
    return root / text


def brief(text: object) -> str:
    """A message that may quote a file of others, of bounded length."""
    text = str(text)
    longest = 500
    return text if len(text) <= longest else f"{text[:longest]} ..."


def shown(value: object, longest: int = 80) -> str:
    """A value of others for a message: on one line, of bounded length."""
    if isinstance(value, (list, dict)):  # of any depth
        return f"a {type(value).__name__} of {len(value):,}"
    text = ascii(value[:longest]) if isinstance(value, (str, bytes)) else ascii(value)
    return text if len(text) <= longest + 8 else f"{text[:longest]}..."
