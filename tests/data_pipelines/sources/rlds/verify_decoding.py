"""python -m tests.data_pipelines.sources.rlds.verify_decoding DIR...: our reading equals tfds's, feature by feature.

Each DIR is an RLDS dataset or a folder of some. Every feature of every record of every split is
compared with tfds's decoder; where TensorFlow can be imported, also with TensorFlow's, images
pixel by pixel. Prints one line per dataset; exit code 1 on any difference.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import sys
from pathlib import Path
from typing import Any

from data_pipelines.errors import DataError
from data_pipelines.sources.rlds.schema import resolve_version
from tests.data_pipelines.sources.rlds.decoding import Tally, compare_directory

SHOWN = 5
"""Differences printed per dataset."""


def datasets_in(path: Path) -> list[Path]:
    """The version directory of a dataset, or those of all datasets in a folder."""
    try:
        return [resolve_version(path)]
    except DataError:
        inside = [child for child in sorted(path.iterdir()) if child.is_dir()] if path.is_dir() else []
        found = [v for child in inside if (v := _version(child)) is not None]
        if not found:
            raise
        return found


def _version(path: Path) -> Path | None:
    try:
        return resolve_version(path)
    except DataError:
        return None


def load_tensorflow() -> Any:
    """The module, or None where it is not installed."""
    if importlib.util.find_spec("tensorflow") is None:
        return None
    import tensorflow

    return tensorflow


def main(arguments: list[str]) -> int:
    if not arguments:
        print(__doc__)
        return 2
    tensorflow = load_tensorflow()
    version = importlib.metadata.version("tensorflow_datasets")
    against = f"tensorflow {tensorflow.__version__}" if tensorflow else "no TensorFlow, pixels not compared"
    print(f"tensorflow_datasets {version}; {against}")
    total = Tally()
    for path in [d for a in arguments for d in datasets_in(Path(a))]:
        tally = compare_directory(path, tensorflow)
        _say(f"{path.parent.name}/{path.name}", tally)
        for difference in tally.differences[:SHOWN]:
            print(f"    {difference}")
        total.add(tally)
    _say("all", total)
    return 1 if total.differences else 0


def _say(name: str, tally: Tally) -> None:
    pixels = f", pixels of {tally.jpeg:,} JPEG and {tally.png:,} PNG" if tally.jpeg + tally.png else ""
    print(
        f"{name}: {tally.records:,} records, {len(tally.features)} features, {tally.values:,} values, "
        f"{tally.stored:,} images as stored{pixels}: {len(tally.differences)} differences",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
