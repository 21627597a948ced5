"""Any source to one RLDS directory, restartable at every shard.

`<out>/<name>/1.0.0` appears when it is complete. Until then shards lie in a hidden directory
beside it with a journal of the finished ones; an interrupted conversion goes on behind the last
of them, and the result has the same bytes as an undisturbed one.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from data_pipelines.convert.episode import Conversion, LeftOut, Source, UnitError, encode
from data_pipelines.errors import DataError
from data_pipelines.registry import DatasetSpec
from data_pipelines.rlds.tfrecord import write_shard
from data_pipelines.rlds.writer import VERSION, build_features, shard_name, write_info
from hma_jax.config import require
from hma_jax.config.json import stable_hash

ADVICE = re.compile(r" Fetch the file again, or leave [\w ]+ out with --skip-damaged\.$")
"""What the message of a UnitError advises, of no use to whoever followed it."""

CONVERTER = 1
"""Raise it when a converter writes other bytes for the same source."""

SHARD_BYTES = 256 * 2**20
"""A shard ends with the unit that reaches this size."""

JOURNAL, LOCK = "journal.jsonl", ".lock"

Progress = Callable[[int, int, str], None]
"""Called with (units done, of how many, the unit just read)."""


@dataclass(frozen=True)
class _Shard:
    """A line of the journal: a finished shard, up to which unit, and what was left out of it."""

    units: int  # units done at its end
    records: int
    size: int  # bytes of payload
    left_out: dict[str, int]


def suggest_spec(source: Source, name: str) -> DatasetSpec:
    """The registry entry of a converted dataset: its first camera and its action."""
    layout = source.layout
    actions = {key: size for key, size in layout.vectors.items() if key.partition("/")[0] == "action"}
    return DatasetSpec(
        name,
        image_key=next(iter(layout.images)),
        action_keys=tuple(actions),
        action_dims=tuple(actions.values()),
        hz=source.hz,
        note=source.description,
    )


def convert(
    source: Source,
    out: str | Path,
    name: str,
    *,
    skip_damaged: bool = False,
    shard_bytes: int = SHARD_BYTES,
    progress: Progress | None = None,
) -> Conversion:
    """Writes every episode of `source` into `<out>/<name>/1.0.0`.

    The same source and settings again: goes on where it was, or finds it done. With
    `skip_damaged`, which may be added after damage was met, damaged units are left out and
    counted. Raises UnitError for a damaged unit otherwise, DataError if no episode is left,
    ConfigError for a name or place that cannot be used.
    """
    require(
        re.fullmatch(r"[a-z][a-z0-9_]*", name) is not None,
        f"--name {name!r} cannot be a dataset's name: use lower-case letters, digits and _ only",
    )
    final = Path(out) / name / VERSION
    mark = stable_hash(
        {
            "converter": CONVERTER,
            "name": name,
            "shard": shard_bytes,
            **source.identity(),
        }
    )
    if final.exists():
        return _finished(final, mark, source, name)
    aside = final.with_name(f".{VERSION}.{mark[:16]}.partial")
    aside.mkdir(parents=True, exist_ok=True)
    with _alone(aside):
        shards = _write_shards(source, aside, skip_damaged, shard_bytes, progress)
        conversion = _finish(source, aside, final, name, shards, mark)
    return conversion


def _write_shards(
    source: Source, aside: Path, skip_damaged: bool, shard_bytes: int, progress: Progress | None
) -> list[_Shard]:
    shards = _read_journal(aside)
    total = len(source.units)
    while (shards[-1].units if shards else 0) < total:
        unit = shards[-1].units if shards else 0
        left_out: Counter[str] = Counter()
        size = 0

        def records() -> Iterator[bytes]:
            nonlocal unit, size
            while unit < total and size < shard_bytes:
                try:
                    for item in source.read(unit):
                        if isinstance(item, LeftOut):
                            left_out[item.reason] += 1
                            continue
                        record = encode(item, source.layout)
                        size += len(record)
                        yield record
                except UnitError as error:
                    if not skip_damaged:
                        raise
                    left_out[ADVICE.sub("", str(error))] += 1
                unit += 1
                if progress is not None:
                    progress(unit, total, source.units[unit - 1])

        count = write_shard(aside / _part(len(shards)), records())
        shards.append(_Shard(unit, count, size, dict(sorted(left_out.items()))))
        _append(aside / JOURNAL, json.dumps(vars(shards[-1])))
    return shards


def _finish(
    source: Source, aside: Path, final: Path, name: str, shards: list[_Shard], mark: str
) -> Conversion:
    episodes = sum(s.records for s in shards)
    left_out = dict(sorted(sum((Counter(s.left_out) for s in shards), Counter()).items()))
    if not episodes:
        reasons = "; ".join(f"{n} x {reason}" for reason, n in left_out.items()) or "it has no unit"
        shutil.rmtree(aside)
        raise DataError(f"{source.description}: no episode can be made of it: {reasons}.")
    kept = [(k, s) for k, s in enumerate(shards) if s.records]
    for to, (k, _) in enumerate(kept):
        target = aside / shard_name(name, to, len(kept))
        if not target.exists():  # by a run that was stopped here
            os.replace(aside / _part(k), target)
    write_info(
        aside,
        name=name,
        features=build_features(source.layout.step_fields(), source.layout.episode_fields()),
        lengths=[s.records for _, s in kept],
        size=sum(s.size for _, s in kept),
        description=source.description,
        metadata={"fingerprint": mark, "hz": source.hz, "left_out": left_out},
        module="data_pipelines.convert",
    )
    strays = [*aside.glob("part-*"), *aside.glob(".part-*")]
    for stray in [*strays, aside / LOCK, aside / JOURNAL]:  # without the journal all of it is made again
        stray.unlink(missing_ok=True)
    os.replace(aside, final)
    return Conversion(final, suggest_spec(source, name), episodes, len(kept), left_out)


def _finished(final: Path, mark: str, source: Source, name: str) -> Conversion:
    """What is there already, if it was made of the same source in the same way."""
    try:
        metadata = json.loads((final / "metadata.json").read_text())
        splits = json.loads((final / "dataset_info.json").read_text())["splits"]
    except (OSError, ValueError, KeyError):
        metadata, splits = {}, []
    require(
        metadata.get("fingerprint") == mark,
        f"{final} exists already and was not made of this source with these settings; choose another --name "
        "or --out, or remove it",
    )
    lengths = [int(n) for split in splits for n in split["shardLengths"]]
    return Conversion(final, suggest_spec(source, name), sum(lengths), len(lengths), metadata["left_out"])


# --- the directory of an unfinished conversion -------------------------------------------------


def _part(index: int) -> str:
    return f"part-{index:05d}"


@contextmanager
def _alone(aside: Path) -> Iterator[None]:
    """Holds the directory; the lock falls with the process. ConfigError if another one has it."""
    with open(aside / LOCK, "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            held = True
        except BlockingIOError:
            held = False
        require(held, f"another conversion is writing {aside.parent}; wait for it or stop it")
        yield


def _read_journal(aside: Path) -> list[_Shard]:
    """Finished shards; a last line that was cut off by a crash does not count."""
    path = aside / JOURNAL
    if not path.exists():
        for stray in aside.iterdir():
            if stray.name != LOCK:
                stray.unlink()
        return []
    lines = path.read_bytes().split(b"\n")
    whole = lines[:-1]
    if lines[-1]:
        path.write_bytes(b"".join(line + b"\n" for line in whole))
    return [_Shard(**json.loads(line)) for line in whole]


def _append(path: Path, line: str) -> None:
    with open(path, "a") as file:
        file.write(line + "\n")
        file.flush()
        os.fsync(file.fileno())
