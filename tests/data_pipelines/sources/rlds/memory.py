"""Peak memory while a shard of very large records is tokenised.

`python -m tests.data_pipelines.sources.rlds.memory DIRECTORY [RECORDS] [MB]` writes RECORDS records of about MB
megabytes into DIRECTORY and tokenises them with a small real tokenizer in another process. A
record holds 480 x 640 frames stored raw, as large as frames get; two thirds of its bytes are
another camera and an embedding that nobody asks for. Default: 7 of 300 MB.
"""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

from data_pipelines.registry import DatasetSpec
from data_pipelines.sources.rlds.example import encode_example
from data_pipelines.sources.rlds.tfrecord import write_shard

BATCH = 256
FRAME = 480 * 640 * 3
SPEC = DatasetSpec("large", "observation/image", ("action",), (7,), hz=2)


def write(directory: Path, records: int, megabytes: int) -> Path:
    """An RLDS directory with one shard, a record at a time."""
    import tensorflow_datasets as tfds

    root = directory / SPEC.name / "1.0.0"
    root.mkdir(parents=True)
    count = write_shard(
        root / f"{SPEC.name}-train.tfrecord-00000-of-00001",
        (encode_example(_features(i, megabytes * 10**6 // (3 * FRAME))) for i in range(records)),
    )
    image = tfds.features.Image(shape=(480, 640, 3), encoding_format="png")
    step = {
        "observation": tfds.features.FeaturesDict({
            "image": image,
            "wrist": image,
            "embedding": tfds.features.Tensor(shape=(FRAME // 4,), dtype=np.float32),
        }),
        "action": tfds.features.Tensor(shape=(7,), dtype=np.float32),
    }  # fmt: skip
    tfds.features.FeaturesDict({"steps": tfds.features.Dataset(step)}).save_config(str(root))
    split = {
        "filepathTemplate": "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}",
        "name": "train",
        "numBytes": "1",
        "shardLengths": [str(count)],
    }
    info = {"fileFormat": "tfrecord", "name": SPEC.name, "version": "1.0.0", "splits": [split]}
    (root / "dataset_info.json").write_text(json.dumps(info))
    return root


def _features(episode: int, frames: int) -> dict:
    rng = np.random.default_rng(episode)
    encoded = []
    for _ in range(frames):
        out = io.BytesIO()
        image = np.broadcast_to(rng.integers(0, 255, (1, 640, 3)).astype(np.uint8), (480, 640, 3))
        Image.fromarray(image).save(out, "PNG", compress_level=0)
        encoded.append(out.getvalue())
    return {
        "steps/observation/image": encoded,
        "steps/observation/wrist": encoded,
        "steps/observation/embedding": np.zeros(frames * (FRAME // 4), np.float32),
        "steps/action": rng.normal(size=frames * 7).astype(np.float32),
    }


def tokenize(root: Path) -> None:
    """Tokenises and prints the peak of memory, in MB, and how much of it came with the records."""
    from hma_jax.config import TokenizerConfig
    from hma_jax.runtime.host_memory import keep_freed_memory
    from hma_jax.tokenizers.autoencoder import declare_tokenizer
    from hma_jax.tokenizers.lfq import LfqTokenizer
    from tests.data_pipelines.tokenizing import tokenize_dataset

    keep_freed_memory()
    config = TokenizerConfig(image_size=256, downsample=16, channels=32)
    tokenizer = LfqTokenizer(config, declare_tokenizer(config).init(0))
    for _ in range(4):  # the heap grows with the first calls, by 50 to 250 MB after one, by 3 or 4 after four
        tokenizer.encode(np.zeros((BATCH, 256, 256, 3), np.uint8))
    at_rest = _peak()
    began = time.monotonic()
    store = root.parent.parent / "store"
    manifest = tokenize_dataset(SPEC, root, tokenizer, store, min_val=1, batch=BATCH, threads=2)
    seconds = time.monotonic() - began
    frames = manifest.train.native_frames + manifest.val.native_frames
    size = sum(p.stat().st_size for p in root.iterdir()) / 1e6
    records = len(manifest.train.steps) + len(manifest.val.steps)
    peak = _peak()
    print(
        f"peak {peak:.0f} MB, growth {peak - at_rest:.0f} MB, for {size:.0f} MB in {records} records, {frames} frames, {seconds:.1f} s"
    )


def _peak() -> float:
    """Of this process alone: ru_maxrss begins with its parent's."""
    return int(re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024


if __name__ == "__main__":
    if sys.argv[1] == "--tokenize":
        tokenize(Path(sys.argv[2]))
    else:
        where, (records, megabytes) = Path(sys.argv[1]), map(int, sys.argv[2:] or (7, 300))
        made = write(where, records, megabytes)
        subprocess.run([sys.executable, "-m", __spec__.name, "--tokenize", str(made)], check=True)
