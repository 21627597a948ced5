"""python -m tests.stress.openx_scale --fraction 0.01 --out DIR: a made-up Open-X, and what its size costs.

At fraction 1 it has 40 datasets whose sizes span four decades, 3,000,000 episodes of tiny records and
10,000 shards. What lies in DIR already is not made again. Each measure runs in a process of its own; the
last line of the output has all figures as JSON:

    make_s, rlds_mb            writing the shards
    first_index_s              opening every dataset for the first time: all shards are scanned
    second_start_s             the same again, in a new process; second_start_with_imports_s: that process as a whole
    index_mb, index_rss_mb     the kept index, and the memory of a process that has all of it open
    tokenise_s, store_mb       every episode into the token store, by a tokenizer that costs nothing
    manifest_mb, manifest_s    all manifests: their size, and opening the store and parsing them
    draw_us, frames_per_s      one window of the training loader on one core, and frames of windows per second;
    draw_cpu_us, frames_per_cpu_s  the same by the time that the process was running, for a machine that is shared
    rss_*_mb, open_files       of that process after the first and the last window, and at most
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from data_pipelines.registry import DatasetSpec

DATASETS, EPISODES, SHARDS = 40, 3_000_000, 10_000
DECADES = 4.0
SHORTEST, LONGEST = 4, 16  # steps
WINDOWS, FRAMES, BATCH = 200_000, 4, 50
HZ = 2.0


def sizes(fraction: float) -> tuple[np.ndarray, np.ndarray]:
    """Episodes and shards of each dataset."""
    weights = 10 ** (-DECADES * np.arange(DATASETS) / (DATASETS - 1))
    weights /= weights.sum()
    episodes = np.maximum(np.round(weights * EPISODES * fraction), 8).astype(int)
    shards = np.maximum(np.round(weights * SHARDS * fraction), 1).astype(int)
    return episodes, np.minimum(shards, episodes)


def name_of(k: int) -> str:
    return f"made_up_{k:02d}"


def spec_of(k: int) -> DatasetSpec:
    """Datasets have 2 to 8 action values."""
    from data_pipelines.registry import DatasetSpec

    return DatasetSpec(name_of(k), "observation/image", ("action",), (2 + k % 7,), HZ)


def make_datasets(root: Path, fraction: float) -> None:
    """All datasets below `root`. Episodes of equal length have equal records: only their number counts here."""
    from data_pipelines.sources.rlds.tfrecord import write_shard
    from tests.data_pipelines.fakes import write_metadata

    for k, (episodes, shards) in enumerate(zip(*sizes(fraction), strict=True)):
        spec, rng = spec_of(k), np.random.default_rng(k)
        directory = root / spec.name / "1.0.0"
        if (directory / "dataset_info.json").exists():
            continue
        shutil.rmtree(directory, ignore_errors=True)
        directory.mkdir(parents=True)
        records = {n: _record(spec, n, rng) for n in range(SHORTEST, LONGEST + 1)}
        lengths = rng.integers(SHORTEST, LONGEST + 1, episodes)
        parts = np.array_split(lengths, shards)
        for n, part in enumerate(parts):
            path = directory / f"{spec.name}-train.tfrecord-{n:05d}-of-{shards:05d}"
            write_shard(path, (records[steps] for steps in part.tolist()))
        write_metadata(directory, spec, [len(part) for part in parts])


def _record(spec: DatasetSpec, steps: int, rng: np.random.Generator) -> bytes:
    from data_pipelines.sources.rlds.example import encode_example
    from tests.data_pipelines.fakes import png

    frames = [png(np.full((8, 8, 3), rng.integers(0, 256, 3), np.uint8)) for _ in range(steps)]
    return encode_example(
        {
            "steps/observation/image": frames,
            "steps/action": rng.normal(size=(steps, spec.action_dim)).astype(np.float32),
            "steps/is_last": np.arange(steps) == steps - 1,
            "steps/language_instruction": [b"push"] * steps,
            "episode_metadata/success": np.array([1]),
        }
    )


# --- measures, each in its own process ---------------------------------------------------------


def measure_start(out: Path) -> dict:
    from data_pipelines.sources.rlds.dataset import RldsDataset

    begin = time.perf_counter()
    opened = [RldsDataset(out / "rlds" / name_of(k)) for k in range(DATASETS)]
    fingerprints = [dataset.fingerprint() for dataset in opened]
    end = time.perf_counter()
    index = sum(p.stat().st_size for p in (out / "cache").rglob("*") if p.is_file())
    return {
        "start_s": end - begin,
        "episodes": sum(map(len, opened)),
        "fingerprints": fingerprints,
        "index_mb": index / 1e6,
        "index_rss_mb": _resident(),
    }


def measure_tokenise(out: Path) -> dict:
    from tests.data_pipelines.fakes import FakeTokenizer
    from tests.data_pipelines.tokenizing import tokenize_dataset

    begin = time.perf_counter()
    for k in range(DATASETS):
        spec = spec_of(k)
        tokenize_dataset(spec, out / "rlds" / spec.name, FakeTokenizer(), out / "store", keep_frames="none")
    files = [p for p in (out / "store").rglob("*") if p.is_file()]
    return {
        "tokenise_s": time.perf_counter() - begin,
        "tokenise_rss_mb": _resident(),
        "store_mb": sum(p.stat().st_size for p in files) / 1e6,
    }


def measure_training(out: Path, windows: int) -> dict:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    from data_pipelines.loading.loader import make_loader
    from data_pipelines.loading.selection import LoaderConfig
    from data_pipelines.tokens.store import TokenStore

    begin = time.perf_counter()
    store = TokenStore(out / "store")
    episodes = sum(len(store.manifest(name).train.steps) for name in store.names)
    parsed = time.perf_counter()
    files = [p for p in (out / "store").glob("*/*") if p.suffix != ".array_record" and p.is_file()]
    loader = make_loader(
        store, store.embodiment_table(store.names, rate=2.0), LoaderConfig(frames=FRAMES, batch=BATCH), threads=1
    )
    next(loader)
    ready = time.perf_counter()
    first, most_files, spent, running = _resident(), 0, 0.0, time.process_time()
    for n in range(windows // BATCH):
        at = time.perf_counter()
        next(loader)
        spent += time.perf_counter() - at
        if n % 200 == 0:
            most_files = max(most_files, len(os.listdir("/proc/self/fd")))
    running = time.process_time() - running
    return {
        "train_episodes": episodes,
        "manifest_mb": sum(p.stat().st_size for p in files) / 1e6,
        "manifest_s": parsed - begin,
        "first_batch_s": ready - parsed,
        "draw_us": spent / windows * 1e6,
        "frames_per_s": windows * FRAMES / spent,
        "draw_cpu_us": running / windows * 1e6,
        "frames_per_cpu_s": windows * FRAMES / running,
        "rss_first_mb": first,
        "rss_last_mb": _resident(),
        "rss_most_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "open_files": most_files,
    }


def _resident() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def run(fraction: float, out: Path, windows: int = WINDOWS) -> dict:
    """Makes what is not there, and measures."""
    begin = time.perf_counter()
    make_datasets(out / "rlds", fraction)
    made = time.perf_counter() - begin
    size = sum(p.stat().st_size for p in (out / "rlds").rglob("*") if p.is_file())
    shutil.rmtree(out / "cache", ignore_errors=True)
    _wait_until_settled(out / "rlds")
    first = _child(out, "start")
    again = time.perf_counter()
    second = _child(out, "start")
    whole = time.perf_counter() - again
    if first.pop("fingerprints") != second.pop("fingerprints"):
        raise AssertionError("the second start sees other records than the first")
    return {
        "fraction": fraction,
        "episodes": first["episodes"],
        "shards": int(sizes(fraction)[1].sum()),
        "make_s": made,
        "rlds_mb": size / 1e6,
        "first_index_s": first["start_s"],
        "second_start_s": second["start_s"],
        "second_start_with_imports_s": whole,
        "index_mb": second["index_mb"],
        "index_rss_mb": second["index_rss_mb"],
        **_child(out, "tokenise"),
        **_child(out, "training", windows),
    }


def _wait_until_settled(root: Path) -> None:
    """An index does not trust shards that are younger than its scan by less than two seconds."""
    newest = max(p.stat().st_mtime for p in root.rglob("*.tfrecord*"))
    time.sleep(max(newest + 2.5 - time.time(), 0))


def _child(out: Path, measure: str, windows: int = 0) -> dict:
    from hma_jax.runtime.files import CACHE_VARIABLE

    command = [sys.executable, "-m", "tests.stress.openx_scale", "--measure", measure, "--out", str(out)]
    environment = os.environ | {CACHE_VARIABLE: str(out / "cache")}
    done = subprocess.run(
        [*command, "--windows", str(windows)], stdout=subprocess.PIPE, text=True, check=True, env=environment
    )
    figures = json.loads(done.stdout.splitlines()[-1])
    print(f"{measure}: {_text({k: v for k, v in figures.items() if k != 'fingerprints'})}", flush=True)
    return figures


def _text(figures: dict) -> str:
    return json.dumps({k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in figures.items()})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fraction", type=float, default=0.01)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--windows", type=int, default=WINDOWS, help="drawn by the training loader")
    parser.add_argument("--measure", choices=("start", "tokenise", "training"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure == "start":
        print(json.dumps(measure_start(args.out)))
    elif args.measure == "tokenise":
        print(json.dumps(measure_tokenise(args.out)))
    elif args.measure == "training":
        print(json.dumps(measure_training(args.out, args.windows)))
    else:
        print(_text(run(args.fraction, args.out, args.windows)))


if __name__ == "__main__":
    main()
