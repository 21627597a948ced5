"""What a person counted on the real robot: a CSV file with the columns policy, successes, episodes."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

from hma_jax.config import ConfigError, require

COLUMNS = ("policy", "successes", "episodes")

FEWEST = 3
"""Least number of policies: two are always in perfect order or perfect disorder."""


class Count(NamedTuple):
    """Successes and episodes of one policy."""

    successes: int
    episodes: int


def read_real(path: Path) -> dict[str, Count]:
    """{policy: its count}. Raises ConfigError, naming the line, for a line that is not a count."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:  # spreadsheets begin a file with a byte order mark
            reader = csv.DictReader(file)
            rows = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path} cannot be read as counts of the real robot ({error})") from error
    columns = list(rows[0][1]) if rows else []
    missing = [name for name in COLUMNS if name not in columns]
    require(
        not missing,
        f"{path}: column {', '.join(missing)} is missing, or there are no rows; the columns must be "
        f"{', '.join(COLUMNS)}",
    )
    counts: dict[str, Count] = {}
    for line, row in rows:
        name = row["policy"]
        try:
            count = Count(int(row["successes"]), int(row["episodes"]))
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"{path}, line {line}: successes and episodes of {name} must be whole numbers ({error})"
            ) from error
        fits = 0 <= count.successes <= count.episodes and count.episodes >= 1
        require(fits, f"{path}, line {line}: {name} cannot succeed in {count.successes} of {count.episodes} episodes")
        require(name not in counts, f"{path}, line {line}: {name} is already in an earlier line; add the two up")
        counts[name] = count
    require(len(counts) >= FEWEST, f"{path} has {len(counts)} policies, but a comparison needs at least {FEWEST}")
    return counts
