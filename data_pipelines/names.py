"""Validation of names and relative paths read from untrusted files, before they become paths on this machine.

Owns what a dataset may be called, the file by which a dataset of a token store is recognised, and what a path inside a
dataset may look like. Only the text of a path is checked: symbolic links are followed, as download caches consist of
them.
"""

from __future__ import annotations

import re
from pathlib import Path

MANIFEST = "manifest.json"
"""The file that every dataset of a token store has."""

MAX_NAME_LENGTH = 128
MAX_PATH_LENGTH = 1024

NAME_RULE = f"use up to {MAX_NAME_LENGTH} letters, digits, '_', '.' and '-', the first a letter, a digit or '_'"

_NAME = re.compile(rf"[A-Za-z0-9_][A-Za-z0-9_.-]{{0,{MAX_NAME_LENGTH - 1}}}")


def is_dataset_name(text: object) -> bool:
    """Whether `text` can be the name of a dataset, and so of a file or a directory."""
    return isinstance(text, str) and _NAME.fullmatch(text) is not None


def snake_case(text: str) -> str:
    """`text` in lower-case letters, digits and '_'; "" if none is left."""
    return re.sub(r"[^a-z0-9_]+", "_", text.lower()).strip("_")


def made_name(text: str) -> str:
    """A name, made from `text`, for a dataset to be written: like `snake_case`, and starting with a letter."""
    name = snake_case(text)
    return name if name[:1].isalpha() else f"dataset_{name}"


def safe_join(root: Path, text: object) -> Path:
    """`root` / `text`. Raises ValueError, saying why, unless `text` is a relative path that stays below `root`."""
    if not isinstance(text, str) or not 0 < len(text) <= MAX_PATH_LENGTH or not text.isprintable():
        raise ValueError(f"{quote(text)} is not a path of up to {MAX_PATH_LENGTH} printable characters")
    if text[0] == "/" or "\\" in text or ".." in text.split("/"):
        raise ValueError(f"{quote(text)} leaves the dataset's directory")
    return root / text


def truncate(text: object) -> str:
    """A message that may quote an untrusted file, cut to a bounded length."""
    text = str(text)
    max_length = 500
    return text if len(text) <= max_length else f"{text[:max_length]} ..."


def quote(value: object) -> str:
    """A value read from an untrusted file, for a message: on one line, of bounded length."""
    max_length = 80
    if isinstance(value, (list, dict)):  # nested to any depth
        return f"a {type(value).__name__} of {len(value):,}"
    text = ascii(value[:max_length]) if isinstance(value, (str, bytes)) else ascii(value)
    return text if len(text) <= max_length + 8 else f"{text[:max_length]}..."
