"""The suite with real simulators, each in a process of its own: same bytes, and episodes run again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.registry import get_spec
from data_pipelines.simulators import EMBODIMENTS, generate_sim, select
from data_pipelines.simulators.packages import missing_packages
from data_pipelines.sources.rlds.dataset import RldsDataset
from tests.files import contents

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(missing_packages(EMBODIMENTS)), reason="simulators not installed: pip install -e '.[sim]'"),
]

NAMES = ("pusht", "dmc_reacher", "aloha")
"""No OpenGL; torque control; two arms and two tasks."""

EPISODES, SIZE = 2, 32

REPLAY = """
import json, sys
import numpy as np
from data_pipelines.simulators import read_start, replay
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.images import decode_image
from data_pipelines.sources.rlds.writer import encode_jpeg
for name in sys.argv[2:]:
    dataset = RldsDataset(f"{sys.argv[1]}/{name}")
    for i in range(len(dataset)):
        recorded = dataset.episode(i, "observation/image", ["action"])
        start = read_start(dataset, i)
        same = replay(name, start, recorded.actions, size=32)
        frames = [decode_image(encode_jpeg(frame)) for frame in same.frames[:-1]]
        equal = bool(np.array_equal(frames, recorded.images))
        other = replay(name, start, recorded.actions[::-1], size=32)
        change = np.abs(other.frames[-20:].astype(int) - same.frames[-20:]).mean()
        print(json.dumps([equal, float(change), same.success, recorded.success]))
"""
"""Prints per episode: whether the pictures are the recorded ones, effect of other actions, successes."""


AUDIT = """
import json, sys
import numpy as np
from data_pipelines.simulators import select
from data_pipelines.simulators.packages import prepare_process
prepare_process()
from data_pipelines.simulators.backends import open_simulator
from data_pipelines.simulators.behaviour import Behaviour
(spec,) = select([sys.argv[1]])
simulator = open_simulator(spec, 32)
def run(env, seed, steps):
    simulator.start(env, seed)
    began = simulator.data.time if hasattr(simulator, "data") else 0.0
    bounds = simulator.low, simulator.high
    behaviour = Behaviour(spec, *bounds, simulator.rest(), None, np.random.default_rng(seed))
    seen = [(simulator.physics(), simulator.frame())]
    for _ in range(steps):
        simulator.step(behaviour.act(False).astype(np.float64))
        seen.append((simulator.physics(), simulator.frame()))
    clock = simulator.data.time - began if hasattr(simulator, "data") else steps / spec.hz
    return seen, clock * spec.hz / steps
first, rate = run(spec.envs[0], 11, 4)
run(spec.envs[-1], 3, 10)
again, _ = run(spec.envs[0], 11, 4)
same = [bool(np.array_equal(x, y)) for a, b in zip(first, again) for x, y in zip(a, b)]
finite = bool(np.isfinite([simulator.low, simulator.high]).all())
widths = set()
for env in spec.envs:
    simulator.start(env, 11)
    widths.add(len(simulator.vector()))
print("\\n" + json.dumps([len(simulator.low), finite, rate, all(same), sorted(widths)]), flush=True)
import os
os._exit(0)
"""
"""Prints the action size, whether its bounds are finite, the physics' clock over that of the row,
whether an episode is the same, to the last pixel, after others, and the widths of states in all environments."""


@pytest.mark.parametrize("name", [spec.name for spec in EMBODIMENTS])
def test_every_robot_is_what_its_row_says_and_forgets_what_it_did(name):
    command = [sys.executable, "-W", "ignore", "-c", AUDIT, name]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    dim, finite, rate, same, widths = json.loads(done.stdout.splitlines()[-1])
    assert (dim, finite) == (select([name])[0].action_dim, True)
    assert abs(rate - 1) < 0.01, "frames do not come at the row's rate"
    assert same, "an episode depends on those before it"
    assert len(widths) == 1, "states of one dataset have different widths"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("sim")
    generate_sim(root, names=NAMES, episodes=EPISODES, size=SIZE)
    return root


def test_datasets_match_their_registry_entries(made):
    for name in NAMES:
        spec, dataset = get_spec(name), RldsDataset(made / name)
        dataset.check_keys(spec.image_key, spec.action_keys, spec.action_dims)
        assert len(dataset) == EPISODES
        for i in range(EPISODES):
            episode = dataset.episode(i, spec.image_key, spec.action_keys)
            assert episode.steps >= 12 * spec.stride, "too short for a window"
            assert (episode.success is None) == (not select([name])[0].success)
            frames = np.stack(episode.images).astype(int)
            assert frames.shape[1:] == (SIZE, SIZE, 3)
            assert np.abs(np.diff(frames[:: spec.stride], axis=0)).mean() > 0.05, "nothing moves"


def test_the_same_bytes_from_any_number_of_workers(made, tmp_path):
    generate_sim(tmp_path, names=NAMES, episodes=EPISODES, size=SIZE, workers=3)
    assert contents(tmp_path, ("stats.json",)) == contents(made, ("stats.json",))


def test_an_episode_does_not_depend_on_those_before_it(made, tmp_path):
    """Episodes of a killed run are kept, so the rest is made by processes that never made them."""
    staged = tmp_path / "dmc_reacher"
    command = [sys.executable, "-m", "data_pipelines.simulators"]
    job = {"name": "dmc_reacher", "episodes": [1], "seed": 0, "size": SIZE, "directory": str(staged)}
    staged.mkdir()
    subprocess.run([*command, json.dumps(job)], check=True, capture_output=True)
    from data_pipelines.sources.rlds.tfrecord import read_record
    from tests.data_pipelines.shards import index_shard

    shard = index_shard(next((made / "dmc_reacher").rglob("*.tfrecord-*")))
    whole = read_record(shard.path, shard.offsets[1], shard.lengths[1])
    assert (staged / "000001.record").read_bytes() == whole


def test_recorded_actions_give_the_recorded_episode_and_others_another(made):
    done = subprocess.run(
        [sys.executable, "-c", REPLAY, str(made), *NAMES],
        check=True,
        capture_output=True,
        text=True,
        env=os.environ | {"MUJOCO_GL": "egl"},
    )
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    assert len(lines) == len(NAMES) * EPISODES
    for equal, change, success, recorded in lines:
        assert equal, "the recorded actions gave other pictures"
        assert change > 0.2, "other actions led to the same pictures"
        assert success == recorded or recorded is None


def test_actions_of_another_robot_are_refused(made):
    code = (
        "from data_pipelines.sources.rlds.dataset import RldsDataset\nfrom data_pipelines.simulators import read_start, replay\n"
        f"start = read_start(RldsDataset({str(made / 'pusht')!r}), 0)\nreplay('pusht', start, [[0.0] * 7])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "actions of shape (1, 7) cannot be run: this robot needs [N, 2]" in done.stderr
