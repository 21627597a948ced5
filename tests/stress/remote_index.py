"""python -m tests.stress.remote_index [--shards 1000]: the index of a dataset in a slow S3, and in a failing one.

Shards of 100 records of 20 kB lie in moto's server on this machine (2 GB of its memory at 1,000 shards).
The index is made with 50 ms before every answer, then with 1 % of the requests failing as well, each in a
process of its own; both must equal that of the same shards on the disk, byte for byte. Prints one line of figures
last, as JSON; ends with 1 if an index differs or the first takes more than --limit seconds.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

RECORDS, SIZE = 100, 20_000
URL = "s3://bucket/data/toy"


def make_dataset(root: Path, shards: int) -> Path:
    """Shards on the disk. Records are noise, of which no two are equal, but for 16 shards that repeat."""
    from data_pipelines.sources.rlds.tfrecord import write_shard
    from tests.data_pipelines.fakes import make_spec, write_metadata

    spec, rng = make_spec(), np.random.default_rng(0)
    directory = root / spec.name / "1.0.0"
    directory.mkdir(parents=True)
    groups = [[rng.bytes(int(n)) for n in rng.integers(SIZE // 2, SIZE * 3 // 2, RECORDS)] for _ in range(16)]
    for n in range(shards):
        records = [n.to_bytes(4, "big") + record for record in groups[n % len(groups)]]
        write_shard(directory / f"{spec.name}-train.tfrecord-{n:05d}-of-{shards:05d}", records)
    write_metadata(directory, spec, [RECORDS] * shards)
    return directory


def upload(directory: Path, environment: dict[str, str]) -> None:
    os.environ.update(environment)
    import s3fs

    fs = s3fs.S3FileSystem()
    fs.mkdir("bucket")
    fs.put(str(directory), "bucket/data/toy/1.0.0", recursive=True)


def make_index(directory: str) -> dict:
    """Figures of opening a dataset; `index` is a hash over every column of its index."""
    from data_pipelines.sources.rlds.dataset import RldsDataset
    from data_pipelines.sources.rlds.index import COLUMNS

    begin = time.perf_counter()
    dataset = RldsDataset(directory)
    seconds = time.perf_counter() - begin
    digest = hashlib.sha256(dataset.fingerprint().encode())
    for name in COLUMNS:
        digest.update(np.ascontiguousarray(getattr(dataset._index, name)).tobytes())
    return {"seconds": seconds, "episodes": len(dataset), "index": digest.hexdigest()}


def run(shards: int, latency: float, failing: float) -> dict:
    from tests.stress.s3_server import serve

    with tempfile.TemporaryDirectory(prefix="hma-remote-") as home, serve() as server:
        root = Path(home)
        directory = make_dataset(root, shards)
        upload(directory, server.environment)
        local = _child(str(directory), root / "cache-0", {})
        server.tell(latency=latency)
        slow = _child(URL, root / "cache-1", server.environment)
        requests = server.tell(latency=latency)
        again = _child(URL, root / "cache-1", server.environment)
        server.tell(latency=latency, failing=failing)
        faulty = _child(URL, root / "cache-2", server.environment)
        return {
            "shards": shards,
            "records": shards * RECORDS,
            "latency_s": latency,
            "requests": requests,
            "index_s": round(slow["seconds"], 2),
            "second_start_s": round(again["seconds"], 2),
            "failing": failing,
            "failing_index_s": round(faulty["seconds"], 2),
            "equal": slow["index"] == again["index"] == faulty["index"] == local["index"],
        }


def _child(directory: str, cache: Path, environment: dict[str, str]) -> dict:
    done = subprocess.run(
        [sys.executable, "-m", "tests.stress.remote_index", "--index", directory],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env=os.environ | environment | {"HMA_CACHE_DIR": str(cache)},
    )
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shards", type=int, default=1000)
    parser.add_argument("--latency", type=float, default=0.05, help="seconds before every answer")
    parser.add_argument("--failing", type=float, default=0.01, help="share of requests that fail")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds that the index may take")
    parser.add_argument("--index", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.index:
        print(json.dumps(make_index(args.index)))
        return
    figures = run(args.shards, args.latency, args.failing)
    print(json.dumps(figures))
    sys.exit(not figures["equal"] or figures["index_s"] > args.limit)


if __name__ == "__main__":
    main()
