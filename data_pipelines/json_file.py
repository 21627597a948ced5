"""JSON files of others: an object, or a message that says which file and what to do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from data_pipelines.errors import DataError


def read_object(path: Path, *, if_missing: str, advice: str) -> dict[str, Any]:
    """The JSON object in `path`. DataError with `if_missing` where there is no such file, and with
    `advice` where it cannot be read."""
    try:
        value = json.loads(path.read_text())
    except FileNotFoundError:
        raise DataError(f"{path} is missing: {if_missing}") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error}). {advice}") from error
    if not isinstance(value, dict):
        raise DataError(f"{path} holds no JSON object. {advice}")
    return value
