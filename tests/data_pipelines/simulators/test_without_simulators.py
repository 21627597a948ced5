"""What the suite does where nothing is simulated: messages, records, jobs, restarts."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.publishing.output_lock import lock_output
from data_pipelines.simulators import generate, packages, read_start, select
from data_pipelines.simulators.episode import StartState
from data_pipelines.simulators.record import encode_episode
from data_pipelines.simulators.simulator import can_simulate
from data_pipelines.simulators.stats import stats_table
from data_pipelines.simulators.worker import Job, episode_seed, facts_path
from data_pipelines.simulators.write import write_dataset
from data_pipelines.sources.rlds.dataset import RldsDataset
from hma_jax.config import ConfigError
from hma_jax.simulator.robots import Robot
from tests import files
from tests.data_pipelines.simulators.fakes import EPISODES, SIZE, SPEC, fake_workers, make_episode, write_episode
from tests.test_packaging import PYPROJECT


@pytest.fixture
def fake(monkeypatch):
    return fake_workers(monkeypatch)


@pytest.fixture
def home(tmp_path):
    staging = tmp_path / "pusht" / ".1.0.0.episodes.mark"
    staging.mkdir(parents=True)
    for i in range(EPISODES):
        write_episode(staging, i)
    with lock_output(staging.with_name(".1.0.0")) as held:
        write_dataset(
            SPEC, staging.parent, held, staging, episodes=EPISODES, size=SIZE, metadata={"fingerprint": "mark"}
        )
    return tmp_path


def test_what_was_simulated_is_read_back(home):
    dataset = RldsDataset(home / "pusht")
    assert (dataset.name, len(dataset)) == ("pusht", EPISODES)
    for i in range(EPISODES):
        episode, made = dataset.episode(i, "observation/image", ["action"]), make_episode(i)
        np.testing.assert_array_equal(episode.actions, made.actions)
        assert episode.success == made.success and len(episode.images) == 80
        assert np.abs(episode.images[0].astype(int) - made.frames[0]).max() <= 2
        assert read_start(dataset, i) == made.start, "the start state lost digits"
    assert sorted(p.name for p in (home / "pusht").iterdir()) == ["1.0.0", "stats.json"]


def test_episodes_with_states_of_different_widths_are_no_dataset(tmp_path):
    """`tfds` decodes half of such a dataset."""
    for i in range(2):
        write_episode(tmp_path, i)
    facts = json.loads(facts_path(tmp_path, 1).read_text())
    facts_path(tmp_path, 1).write_text(json.dumps(facts | {"env": "PushTwo", "states": 13}))
    home = tmp_path / "pusht"
    home.mkdir()
    with lock_output(home / ".1.0.0") as held, pytest.raises(DataError, match=r"pusht: .*10 in PushT, 13 in PushTwo"):
        write_dataset(SPEC, home, held, tmp_path, episodes=2, size=SIZE, metadata={"fingerprint": "mark"})
    assert not (home / "1.0.0").exists()


def test_tfds_decodes_the_records(home):
    import tensorflow_datasets as tfds

    from data_pipelines.sources.rlds.tfrecord import read_record
    from tests.data_pipelines.shards import index_shard

    features = tfds.builder_from_directory(str(home / "pusht" / "1.0.0")).info.features
    shard = index_shard(next((home / "pusht" / "1.0.0").glob("*.tfrecord-*")))
    example = features.deserialize_example_np(read_record(shard.path, shard.offsets[1], shard.lengths[1]))
    steps = list(example["steps"])
    made = make_episode(1)
    np.testing.assert_array_equal([s["action"] for s in steps], made.actions)
    np.testing.assert_array_equal([s["observation"]["state"] for s in steps], made.states)
    assert bool(example["episode_metadata"]["success"])
    assert [bool(s["is_terminal"]) for s in steps] == [False] * 80


def test_robots_without_a_success_signal_claim_none():
    from data_pipelines.sources.rlds.example import parse_example

    (quiet,) = select(["dmc_reacher"])
    assert "episode_metadata/success" not in parse_example(encode_episode(quiet, make_episode(1), 0))


def test_the_table_of_figures_has_speed_lengths_and_success(home):
    table = stats_table(home)
    assert "| `pusht` | gym-pusht | 2 | 10 | push script | 3 | 240 | 8.0 to 8.0 | 40 | 1/3 |" in table
    assert "16 px" in table
    with pytest.raises(DataError, match="no simulator datasets"):
        stats_table(home / "pusht")


@pytest.mark.parametrize("text", ['{"frames": [80,', "[]", "{}", '{"frames": [], "success": null}'])
def test_figures_that_cannot_be_read_are_told_with_their_file(tmp_path, text):
    """As a copy that broke off leaves them: they ended the table in a traceback."""
    path = tmp_path / "pusht" / "stats.json"
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(DataError, match=rf"{path}.*Remove the file to leave pusht out of the table"):
        stats_table(tmp_path)


def test_missing_packages_are_named_with_the_extra_and_what_draws(monkeypatch):
    monkeypatch.setattr(packages.importlib.util, "find_spec", lambda name: None)
    message = r"not installed \(gym-pusht, mujoco\)\. Run: pip install -e '.\[sim\]'.*libegl1"
    with pytest.raises(ConfigError, match=message):
        packages.require_packages([SPEC])


@pytest.mark.parametrize("robot", ["robosuite_panda_lift", "robosuite_g1"])  # of robosuite-models, which needs it too
def test_another_version_of_robosuite_is_refused(monkeypatch, robot):
    """Of 1.5.2 episodes would ignore their seeds."""
    specs, installed = select([robot]), dict(packages.USED_VERSIONS)
    monkeypatch.setattr(packages.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(packages.ctypes.util, "find_library", lambda name: "lib")
    monkeypatch.setattr(packages.importlib.metadata, "version", lambda name: installed.get(name, "1"))
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    packages.require_packages(specs)
    installed["robosuite"] = "1.5.2"
    message = r"robosuite 1\.5\.2 is installed, but only version 1\.5\.1 can be used\. Run: pip install -e '.\[sim\]'"
    with pytest.raises(ConfigError, match=message):
        packages.require_packages(specs)
    packages.require_packages([SPEC])  # of another package


def test_the_extra_installs_the_only_versions_that_are_used():
    extra = PYPROJECT["project"]["optional-dependencies"]["sim"]
    assert {f"{package}=={version}" for package, version in packages.USED_VERSIONS.items()} <= set(extra)


def test_a_machine_that_cannot_draw_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(packages.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(packages.ctypes.util, "find_library", lambda name: None)
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(ConfigError, match="no OSMesa library.*apt-get install.*libosmesa6"):
        packages.require_packages([SPEC])
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with pytest.raises(ConfigError, match="MUJOCO_GL is 'glfw'"):
        packages.require_packages([SPEC])


def test_a_robot_can_be_simulated_where_packages_a_library_and_the_process_allow_it(monkeypatch):
    robot = Robot("metaworld_drawer", 1, (-1.0,) * 4, (1.0,) * 4, (0.0,) * 4)
    monkeypatch.setattr(packages.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(packages.ctypes.util, "find_library", lambda name: "lib")
    monkeypatch.delitem(packages.sys.modules, "tensorflow", raising=False)
    assert can_simulate(robot) and not can_simulate(replace(robot, name="metaworld_sawyer"))
    with monkeypatch.context() as beside_tensorflow:
        beside_tensorflow.setitem(packages.sys.modules, "tensorflow", object())
        assert not can_simulate(robot)
    with monkeypatch.context() as with_a_screen:
        with_a_screen.setenv("MUJOCO_GL", "glfw")
        assert not can_simulate(robot)
    monkeypatch.setattr(packages.ctypes.util, "find_library", lambda name: None)
    assert not can_simulate(robot)


def test_a_process_with_tensorflow_is_refused_before_it_can_crash(monkeypatch):
    monkeypatch.setitem(packages.sys.modules, "tensorflow", object())
    with pytest.raises(ConfigError, match="TensorFlow is loaded in this process"):
        packages.prepare_process()


def test_a_job_survives_its_command_line_and_seeds_are_its_episodes_own():
    job = Job("pusht", (3, 4), 7, 64, "/some where")
    assert Job.from_json(job.to_json()) == job
    seeds = {episode_seed(n, s, i) for n in ("pusht", "fetch") for s in (0, 1) for i in range(50)}
    assert len(seeds) == 200


def test_text_that_is_no_start_state_is_refused():
    with pytest.raises(DataError, match="is not a start state"):
        StartState.from_json(b'{"env": "Lift"}')


contents = partial(files.contents, leaving_out=("stats.json",))


def run(root, **more):
    return generate.generate_sim(root, names=["pusht"], **{"episodes": 12, "size": SIZE} | more)


def test_a_run_cut_short_goes_on_and_ends_with_the_same_bytes(tmp_path, fake):
    run(tmp_path / "whole", workers=2)
    assert sorted(fake.made) == list(range(12))

    fake.made.clear()
    fake.dies_at = (4,)
    message = "pusht: its simulator ended with exit code -11: cannot draw.*tries them again"
    with pytest.raises(DataError, match=message):
        run(tmp_path / "cut")
    assert sorted(fake.made) == [0, 1, 2, 3, 10, 11], "the other job of the dataset was not run"
    assert not (tmp_path / "cut" / "pusht" / "1.0.0").exists()

    fake.made.clear()
    fake.dies_at = ()
    seen = []
    run(tmp_path / "cut", progress=lambda name, done, total: seen.append((done, total)))
    assert sorted(fake.made) == list(range(4, 10)), "episodes were made again"
    assert seen == [(6, 12)] + [(n, 12) for n in range(7, 13)]
    assert contents(tmp_path / "cut") == contents(tmp_path / "whole")

    fake.made.clear()
    run(tmp_path / "cut")
    assert fake.made == []


def test_datasets_that_could_not_be_made_are_counted_not_their_processes(tmp_path, fake):
    fake.dies_at = (4, 10)  # of both jobs
    with pytest.raises(
        DataError, match="^1 of 1 datasets could not be made; .* pusht: its simulator .* tries"
    ) as error:
        run(tmp_path)
    assert str(error.value).count("cannot draw") == 1


def test_a_dataset_of_other_settings_or_of_others_is_not_replaced(tmp_path, fake):
    run(tmp_path)
    kept = contents(tmp_path)
    fake.made.clear()
    for change, how in (({"seed": 1}, "seed: 0 -> 1"), ({"episodes": 13}, "episodes: 12 -> 13")):
        with pytest.raises(ConfigError, match=f"pusht/1.0.0: {how}. Nothing was changed. Choose another directory"):
            run(tmp_path, **change)
    (tmp_path / "pusht/1.0.0/metadata.json").write_text("{}")
    with pytest.raises(ConfigError, match="it does not say how it was made"):
        run(tmp_path)
    assert not fake.made and contents(tmp_path) == kept | {"pusht/1.0.0/metadata.json": b"{}"}


def test_a_dataset_of_another_generator_is_made_again(tmp_path, fake, monkeypatch):
    run(tmp_path)
    fake.made.clear()
    monkeypatch.setattr(generate, "GENERATOR_VERSION", generate.GENERATOR_VERSION + 1)
    run(tmp_path)
    assert len(fake.made) == 12


@pytest.mark.parametrize("package", ["numpy", "dm-control", "gymnasium", "mujoco", "simplejpeg"])
def test_the_fingerprint_follows_packages_beneath_the_robots_own(monkeypatch, package):
    (spec,) = select(["ogbench_ur5e"])
    versions = dict.fromkeys(package_names(), "1.0")
    monkeypatch.setattr(packages.importlib.metadata, "version", lambda name: versions[name])
    before = generate.fingerprint(spec, 10, SIZE, 0)
    assert before == generate.fingerprint(spec, 10, SIZE, 0)
    versions[package] = "1.1"
    assert generate.fingerprint(spec, 10, SIZE, 0) != before


def package_names() -> set[str]:
    names = {*packages.MODULES, *packages.COMMON_PACKAGES}
    return names.union(*packages.IMPORTED_TOGETHER.values(), *packages.DEPENDENCIES.values())


def test_the_fingerprint_follows_the_library_that_draws(monkeypatch, fake):
    marks = set()
    for library in packages.GL:
        monkeypatch.setenv("MUJOCO_GL", library)
        marks.add(generate.fingerprint(SPEC, 10, SIZE, 0))
    assert len(marks) == 2


def test_a_dataset_that_another_process_makes_is_named_and_left_alone(tmp_path, fake):
    theirs = tmp_path / "pusht" / ".1.0.0.episodes.theirs"
    theirs.mkdir(parents=True)
    refused = pytest.raises(ConfigError, match="another process is writing .*pusht .process ")
    with lock_output(tmp_path / "pusht" / ".1.0.0"), refused:
        run(tmp_path)
    assert theirs.is_dir() and fake.made == []
    run(tmp_path)  # nobody's now
    assert sorted(p.name for p in (tmp_path / "pusht").iterdir()) == ["1.0.0", "stats.json"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"episodes": 0}, "episodes must be at least 1"),
        ({"size": 8}, "frame size must lie in 16..1024"),
        ({"workers": 0}, "workers must be at least 1"),
    ],
)
def test_bad_arguments_are_named(tmp_path, fake, arguments, message):
    with pytest.raises(ConfigError, match=message):
        run(tmp_path, **arguments)
