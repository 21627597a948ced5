"""python -m tests.stress.recordings --judged DIR --out OUT: what `hma judge --recordings` says where the truth is
known.

Takes a robot of the suite for one without a true simulator. OUT/NAME/1.0.0 has recordings of it as RLDS, with a reward
of 1 after every step that leads to the goal: a third are play, the others its expert with three kinds of noise.
`--judged` is a finished judgement of the same task with a true world: OUT/policies.py gives its cloned policies, as if
they were a user's own, and OUT/real.csv their successes there, as if they were the real robot's. The last line is the
command that judges.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

from data_pipelines.sources.rlds.example import encode_example
from data_pipelines.sources.rlds.tfrecord import write_shard
from data_pipelines.sources.rlds.writer import (
    STEP_FIELDS,
    TEXT,
    Field,
    build_features,
    encode_jpeg,
    image_field,
    shard_name,
    step_features,
    vector_field,
    write_info,
)
from experiments.applications.judging.config import JudgeConfig
from experiments.applications.judging.outcomes import STATE, TRUE, read_outcomes
from experiments.applications.policies.demonstrations import Demonstrations, record
from experiments.applications.policies.tasks import Task, find_task, join

SEED = 77
"""Of the recordings: none that a judgement makes for itself."""

POLICIES = '''"""Cloned policies of a judgement, as a user's own."""

from pathlib import Path

from experiments.applications.policies import load_policy


def policies(robot):
    places = sorted(Path({place!r}).glob("cloned-*"), key=lambda p: int(p.name.split("-")[1]))
    return {{p.name.replace("cloned", "own"): load_policy(p) for p in places}}
'''


def make(task: Task, count: int, to_success: bool) -> Demonstrations:
    """Of `task.frames` frames each; with `to_success` those that succeed end there."""
    play, after, noise = count // 3, 0 if to_success else None, JudgeConfig.head_noise
    expert = record(task, count - play, noise=noise, after=after, seed=SEED)
    return join([expert, record(task, play, play=True, after=after, seed=SEED + 1)])


def write(demos: Demonstrations, robot: str, out: Path, rest: int) -> None:
    """As RLDS, each after `rest` frames in which nothing happens."""
    directory = out / robot / "1.0.0"
    directory.mkdir(parents=True)
    size, dim = demos.images.shape[-2], demos.actions.shape[-1]
    fields = {"observation/image": image_field(size, size), "action": vector_field(dim)} | STEP_FIELDS
    features = build_features(fields, {"file_path": Field(TEXT), "success": Field("bool")})
    records = []
    for i, length in enumerate(demos.lengths.tolist()):
        still = np.repeat(np.r_[0, np.arange(length)], np.r_[rest, np.ones(length, int)])
        reached, actions = demos.reached[i, still], demos.actions[i, still] * (np.arange(len(still)) >= rest)[:, None]
        rewards = np.r_[reached[1:], reached[-1]].astype(np.float32)
        episode = {
            "steps/observation/image": [encode_jpeg(image) for image in demos.images[i, still]],
            "steps/action": actions.astype(np.float32).ravel(),
            "episode_metadata/file_path": [f"recordings/{robot}/{i}".encode()],
            "episode_metadata/success": np.array([demos.successes[i]], np.int64),
        }
        records.append(encode_example(step_features(rewards, [""] * len(still)) | episode))
    write_shard(directory / shard_name(robot, 0, 1), records)
    write_info(
        directory,
        name=robot,
        features=features,
        splits={"train": ([len(records)], sum(map(len, records)))},
        description=__doc__,
        metadata={},
        module=__name__,
    )


def write_truth(judged: Path, out: Path) -> None:
    """The policies of a judgement, and how often each succeeded in the true world, by its state."""
    (out / "policies.py").write_text(POLICIES.format(place=str((judged / "policies").absolute())))
    told: dict[str, list[bool]] = {}
    for o in read_outcomes(judged / "outcomes.csv"):
        if (o.world, o.judge) == (TRUE, STATE) and o.policy.split("-")[0] in ("random", "cloned"):
            told.setdefault(o.policy.replace("cloned", "own"), []).append(o.success)
    with open(out / "real.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("policy", "successes", "episodes"))
        rows.writerows((policy, sum(said), len(said)) for policy, said in told.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--judged", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--robot", default="pusher_sand")
    parser.add_argument("--task", default="reach")
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--rest", type=int, default=3, help="frames before anything happens")
    parser.add_argument("--to-success", action="store_true", help="recordings end with their success")
    args = parser.parse_args()
    task = find_task(args.robot, args.task)
    write(make(task, args.count, args.to_success), args.robot, args.out, args.rest)
    write_truth(args.judged, args.out)
    print(
        f"hma judge RUN --robot {args.robot} --policies {args.out}/policies.py --recordings {args.out}/{args.robot} "
        f"--reward 1 --hold {task.hold} --frames {task.frames} --starts 30 --real {args.out}/real.csv --out {args.out}/judged"
    )


if __name__ == "__main__":
    main()
