"""Exceptions for data that cannot be used, with complete messages.

Owns the exception types, and how the advice at the end of a message is recognised. A message says what is wrong,
where (file and byte offset, or dataset, episode and step) and what to do; the command line prints it unchanged.
"""

from __future__ import annotations

import re
from pathlib import Path

from hma_jax.config import ConfigError

MAX_LISTED = 6
"""Number of cases that a message lists one by one; for the others it gives only their number. If a dataset was fetched
in part, every shard may be damaged."""

ADVICE = re.compile(
    r"[.;] (?:Download|Fetch|Repair|[Ll]eave) [^.;]*(?:--skip-damaged|corrupt='skip'|store\.corrupt=skip)[^.;]*\.?$"
)
"""The end of a message that says how to skip damaged data."""


def without_advice(text: str) -> str:
    """The message of an EpisodeError without its advice, for users who skip damaged data already.

    Not for messages that a token store keeps: its hash covers the whole message.
    """
    return ADVICE.sub(".", text)


class DataError(Exception):
    """Data that cannot be used."""


class NoDatasetError(DataError, ConfigError):
    """A given location that is not a dataset: most often the path is misspelt."""


class UnreachableError(DataError):
    """A disk or an object store that cannot be read. The data may be intact, so no policy skips data because of this
    error."""


class EpisodeError(DataError):
    """One episode is unusable; the policy corrupt='skip' may skip it.

    Attributes, if known: `path` of its file, `offset` of its first byte in the file.
    """

    path: Path | None = None
    offset: int | None = None

    def at(self, path: Path, offset: int) -> EpisodeError:
        """The same error, with file and offset."""
        self.path, self.offset = path, offset
        return self


def too_many_skipped(name: str, total: int, limit: int, last: str) -> DataError:
    """The error for a dataset of which too many episodes were skipped; `last`: why the last one was skipped."""
    return DataError(
        f"{name}: {total} episodes cannot be used, more than max_skipped={limit}. The last: {without_advice(last)} To use "
        "the others, raise the limit: --set store.max_skipped=N."
    )


class CorruptRecordError(EpisodeError):
    """Bytes in a shard that are not what was written.

    Attributes: `path` of the file, `offset` in bytes of the record's first byte, `reason`.
    """

    def __init__(self, path: str | Path, offset: int, reason: str):
        self.path = Path(path) if isinstance(path, str) else path
        self.offset = offset
        self.reason = reason
        super().__init__(
            f"{path}: corrupt record at byte {offset}: {reason}. Download the file again, or read the dataset with "
            "corrupt='skip' to leave the record out."
        )

    def __reduce__(self):
        return type(self), (self.path, self.offset, self.reason)
