"""Tiny sources in the published formats, whose frames say by their colour which one they are."""

from __future__ import annotations

import io
import json
import pickle
import struct
from pathlib import Path

import numpy as np
import simplejpeg
from PIL import Image

from data_pipelines.sources.rlds.dataset import RldsDataset

HEIGHT, WIDTH = 36, 64


def colour(i: int) -> tuple[int, int, int]:
    """Red and green count, blue falls: nothing that BGR could be taken for."""
    return 10 + 10 * (i % 24), 20 + 40 * (i // 24), 250 - 10 * (i % 24)


def picture(i: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    return np.full((height, width, 3), colour(i), np.uint8)


def number(image: np.ndarray) -> int:
    """Which frame this is. Fails for other colours than `colour` gives."""
    red, green, blue = image.reshape(-1, 3).mean(axis=0)
    i = round((red - 10) / 10) + 24 * round((green - 20) / 40)
    assert np.abs(np.array([red, green, blue]) - colour(i)).max() < 5, (red, green, blue)
    return i


def write_video(path: Path, frames: list[int], fps: int, size=(HEIGHT, WIDTH), times: list[int] | None = None) -> None:
    """`times` in 1 / fps seconds, those without a gap if None."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "8", "g": "10", "preset": "ultrafast"})
        stream.height, stream.width, stream.pix_fmt = *size, "yuv420p"
        for i, time in zip(frames, times or range(len(frames)), strict=True):
            frame = av.VideoFrame.from_ndarray(picture(i, *size), format="rgb24")
            frame.pts = time
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def read_back(directory: Path, image_key: str):
    """Every episode as our own reader sees it, after tfds has accepted the directory and agreed."""
    import tensorflow_datasets as tfds

    dataset = RldsDataset(directory)
    size = dataset.features["steps/action"].size
    dataset.check_keys(image_key, ["action"], [size])
    episodes = [dataset.episode(i, image_key, ["action"]) for i in range(len(dataset))]
    builder = tfds.builder_from_directory(str(directory))
    assert builder.info.splits["train"].num_examples == len(dataset)
    from data_pipelines.sources.rlds.tfrecord import read_record

    path, offset, length = dataset._locate(0)
    steps = list(builder.info.features.deserialize_example_np(read_record(path, offset, length))["steps"])
    np.testing.assert_array_equal([s["action"] for s in steps], episodes[0].actions)
    picture = steps[-1]
    for part in image_key.split("/"):
        picture = picture[part]
    assert np.abs(picture.astype(int) - episodes[0].images[-1]).max() <= 4  # another JPEG decoder
    assert [bool(s["is_first"]) for s in steps] == [True] + [False] * (len(steps) - 1)
    assert [bool(s["is_last"]) for s in steps] == [False] * (len(steps) - 1) + [True]
    return dataset, episodes


# --- Robomimic ---------------------------------------------------------------------------------


def write_robomimic(path: Path, lengths=(5, 7, 4), images=True, change=None) -> Path:
    """Demonstration k has k success by its reward unless k == 1; numbered so that text order is wrong."""
    import h5py

    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(lengths)
        data.attrs["env_args"] = json.dumps(
            {"env_name": "Lift", "env_type": 1, "env_kwargs": {"control_freq": 20, "reward_shaping": False}}
        )
        for k, steps in enumerate(lengths):
            demo = data.create_group(f"demo_{9 + k}")
            demo.attrs["num_samples"] = steps
            demo["actions"] = demo_actions(k, steps)
            demo["states"] = np.full((steps, 11), k, np.float64)
            demo["rewards"] = np.eye(steps)[-1] if k != 1 else np.zeros(steps)
            demo["dones"] = np.eye(steps, dtype=np.int64)[-1]
            if images:
                frames = np.stack([picture(24 * k + t, 32, 32) for t in range(steps)])
                demo["obs/agentview_image"] = frames
                demo["obs/robot0_eye_in_hand_image"] = frames[::-1]
            demo["obs/robot0_eef_pos"] = np.full((steps, 3), k, np.float64)
            demo["next_obs/robot0_eef_pos"] = np.full((steps, 3), -1.0)
        file["mask/train"] = np.array([b"demo_9", b"demo_11"])
        file["mask/valid"] = np.array([b"demo_10"])
        if change is not None:
            change(file)
    return path


def demo_actions(k: int, steps: int) -> np.ndarray:
    return (np.arange(steps * 7).reshape(steps, 7) / 64 + k).astype(np.float64)


# --- LeRobot -----------------------------------------------------------------------------------

FPS = 10
CAMERA = "observation.images.top"


def write_lerobot(root: Path, version: str, lengths=(12, 9), camera: str = "video", change=None) -> Path:
    """Episode e shows frames 24 e + t. `change(e, table)` may spoil a table of columns."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    features = {
        CAMERA: {"dtype": camera, "shape": [HEIGHT, WIDTH, 3], "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": [2], "names": None},
        "action": {"dtype": "float32", "shape": [3], "names": None},
        "next.success": {"dtype": "bool", "shape": [1], "names": None},
        "next.reward": {"dtype": "float32", "shape": [1], "names": None},
        **{k: {"dtype": "int64", "shape": [1]} for k in ("episode_index", "frame_index", "index", "task_index")},
        "timestamp": {"dtype": "float32", "shape": [1]},
    }
    old = version != "v3.0"
    info = {
        "codebase_version": version,
        "robot_type": "toy",
        "fps": FPS,
        "chunks_size": 1000,
        "total_episodes": len(lengths),
        "splits": {"train": f"0:{len(lengths)}"},
        "features": features,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        if old
        else "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        if old
        else "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    meta = root / "meta"
    meta.mkdir(parents=True)
    (meta / "info.json").write_text(json.dumps(info))
    tables = []
    for e, steps in enumerate(lengths):
        rows = {
            "observation.state": pa.array([[e, t] for t in range(steps)], pa.list_(pa.float32())),
            "action": pa.array(lerobot_actions(e, steps).tolist(), pa.list_(pa.float32())),
            "next.success": pa.array([e == 0 and t == steps - 1 for t in range(steps)]),
            "next.reward": pa.array([float(t == steps - 1) for t in range(steps)], pa.float32()),
            "timestamp": pa.array(np.arange(steps, dtype=np.float32) / FPS),
            "frame_index": pa.array(range(steps)),
            "episode_index": pa.array([e] * steps),
            "index": pa.array(range(sum(lengths[:e]), sum(lengths[:e]) + steps)),
            "task_index": pa.array([(1 - e) % 2] * steps),
        }
        if camera == "image":
            rows[CAMERA] = pa.array([{"bytes": _encoded(24 * e + t), "path": None} for t in range(steps)])
        if change is not None:
            change(e, rows)
        tables.append(pa.table(rows))
    tasks = ["stack", "push"]
    shown = [[24 * e + t for t in range(steps)] for e, steps in enumerate(lengths)]
    if old:
        (meta / "tasks.jsonl").write_text(
            "".join(json.dumps({"task_index": i, "task": t}) + "\n" for i, t in enumerate(tasks))
        )
        lines = [{"episode_index": e, "tasks": [tasks[(1 - e) % 2]], "length": n} for e, n in enumerate(lengths)]
        (meta / "episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        for e, table in enumerate(tables):
            path = root / info["data_path"].format(episode_chunk=0, episode_index=e)
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(table, path)
            if camera == "video":
                write_video(
                    root / info["video_path"].format(episode_chunk=0, episode_index=e, video_key=CAMERA),
                    shown[e],
                    FPS,
                )
        return root
    pq.write_table(pa.table({"task_index": [0, 1], "__index_level_0__": tasks}), meta / "tasks.parquet")
    starts = np.cumsum([0, *lengths]) / FPS
    rows = {
        "episode_index": list(range(len(lengths))),
        "tasks": [[tasks[(1 - e) % 2]] for e in range(len(lengths))],
        "length": list(lengths),
        "data/chunk_index": [0] * len(lengths),
        "data/file_index": [0] * len(lengths),
    }
    if camera == "video":
        for name, values in {
            "chunk_index": [0] * len(lengths),
            "file_index": [0] * len(lengths),
            "from_timestamp": starts[:-1].tolist(),
            "to_timestamp": starts[1:].tolist(),
        }.items():
            rows[f"videos/{CAMERA}/{name}"] = values
        write_video(
            root / info["video_path"].format(video_key=CAMERA, chunk_index=0, file_index=0),
            sum(shown, []),
            FPS,
        )
    (meta / "episodes" / "chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(rows), meta / "episodes" / "chunk-000" / "file-000.parquet")
    path = root / info["data_path"].format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True)
    pq.write_table(pa.concat_tables(tables), path)
    return root


def lerobot_actions(e: int, steps: int) -> np.ndarray:
    return (np.arange(steps * 3).reshape(steps, 3) / 8 + e).astype(np.float32)


def _encoded(i: int) -> bytes:
    """PNG for even frames, JPEG for odd ones: both are found in tables."""
    if i % 2:
        return simplejpeg.encode_jpeg(picture(i), quality=95, colorsubsampling="444")
    out = io.BytesIO()
    Image.fromarray(picture(i)).save(out, "PNG")
    return out.getvalue()


# --- EPIC-KITCHENS -----------------------------------------------------------------------------


def _varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _inner(field: int, data: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _floats(*values: float) -> bytes:
    return b"".join(_varint(n << 3 | 5) + struct.pack("<f", v) for n, v in enumerate(values, 1))


def hand(side: int, x: float, y: float, score: float = 0.9) -> bytes:
    """A HandDetection of the published schema: 1 bbox, 2 score, 3 state, 4 object_offset, 5 side."""
    box = _floats(x - 0.05, y - 0.1, x + 0.05, y + 0.1)
    score_and_state = _varint(2 << 3 | 5) + struct.pack("<f", score) + _varint(3 << 3) + _varint(3)
    side_field = _varint(5 << 3) + _varint(side) if side else b""  # proto3 leaves zeros out
    return _inner(1, box) + score_and_state + _inner(4, _floats(0.1, -0.2)) + side_field


def detections(video: str, frame: int, hands: list[bytes]) -> bytes:
    """A Detections message: 1 video_id, 2 frame_number, 3 hands, 4 objects."""
    thing = _inner(1, _floats(0.1, 0.1, 0.2, 0.2)) + _varint(2 << 3 | 5) + struct.pack("<f", 0.3)
    parts = [_inner(1, video.encode()), _varint(2 << 3) + _varint(frame)]
    return b"".join([*parts, *(_inner(3, h) for h in hands), _inner(4, thing)])


def write_epic(root: Path, video: str, frames: list[list[bytes]], shown=lambda n: n) -> tuple[Path, Path]:
    """(frames, detections); frame n, from 1, is `picture(shown(n))`."""
    participant = video[:3]
    folder = root / "EPIC" / participant / "rgb_frames" / video
    folder.mkdir(parents=True)
    for n in range(1, len(frames) + 1):
        jpeg = simplejpeg.encode_jpeg(picture(shown(n)), quality=95, colorsubsampling="444")
        (folder / f"frame_{n:010d}.jpg").write_bytes(jpeg)
    path = root / "hand-objects" / participant / f"{video}.pkl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps([detections(video, n, hands) for n, hands in enumerate(frames, 1)], protocol=3))
    return root / "EPIC", root / "hand-objects"
