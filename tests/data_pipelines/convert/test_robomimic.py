"""Robomimic files of the real layout: images, actions, success, order, masks and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from data_pipelines.convert.write import convert
from data_pipelines.errors import DataError
from data_pipelines.sources.robomimic import RobomimicSource, succeeded
from data_pipelines.sources.robomimic_dataset import RobomimicDataset
from data_pipelines.sources.settings import RobomimicSettings
from data_pipelines.sources.source import INSTRUCTION_KEY
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import demo_actions, number, read_back, write_robomimic


def test_demonstrations_keep_their_order_frames_actions_and_success(tmp_path):
    source = RobomimicSource(write_robomimic(tmp_path / "image.hdf5"))
    done = convert(source, tmp_path, "lift")
    assert done.spec.hz == 20 and done.spec.image_key == "observation/agentview"
    dataset, episodes = read_back(done.directory, "observation/agentview")
    assert [e.success for e in episodes] == [True, False, True]  # by reward; every one ends with a done
    for k, (steps, episode) in enumerate(zip((5, 7, 4), episodes, strict=True)):  # demo_9, demo_10, demo_11
        assert [number(image) for image in episode.images] == [24 * k + t for t in range(steps)]
        np.testing.assert_array_equal(episode.actions, demo_actions(k, steps).astype(np.float32))
    wrist = dataset.episode(1, "observation/robot0_eye_in_hand", ["observation/sim_state"])
    assert number(wrist.images[0]) == 24 + 6 and (wrist.actions == 1).all() and wrist.actions.shape == (7, 11)
    record = dataset.record(2)
    assert record["steps/observation/robot0_eef_pos"].tolist() == [2.0] * 12
    assert record["steps/language_instruction"] == [b"Lift"] * 4
    assert record["steps/reward"].tolist() == [0, 0, 0, 1]


def test_a_mask_a_camera_a_rate_and_a_size_can_be_chosen(tmp_path):
    settings = RobomimicSettings(("agentview",), "train", hz=10, short_side=16)
    source = RobomimicSource(write_robomimic(tmp_path / "image.hdf5"), settings)
    assert list(source.units) == ["demo_9", "demo_11"] and source.hz == 10
    assert list(source.layout.images) == ["observation/agentview"]
    _, episodes = read_back(convert(source, tmp_path, "lift").directory, "observation/agentview")
    assert [number(e.images[1]) for e in episodes] == [1, 49] and episodes[0].images[0].shape == (16, 16, 3)
    with pytest.raises(ConfigError, match="no mask 'half'; it has train, valid"):
        RobomimicSource(tmp_path / "image.hdf5", RobomimicSettings(filter_key="half"))
    with pytest.raises(ConfigError, match="no camera 'side'; it has agentview, robot0_eye_in_hand"):
        RobomimicSource(tmp_path / "image.hdf5", RobomimicSettings(("side",)))


def test_a_demonstration_without_a_number_is_not_left_out_in_silence(tmp_path):
    def rename(file):
        file["data"].move("demo_11", "demo_a")
        file["data"].create_group("notes")
        file["mask/train"][:] = [b"demo_9", b"demo_10"]

    path = write_robomimic(tmp_path / "image.hdf5", change=rename)
    with pytest.raises(DataError, match="data/'demo_a' has actions, but is not called demo_<number>.*Rename it"):
        RobomimicSource(path)
    assert RobomimicSource(path, RobomimicSettings(filter_key="train")).units == ["demo_9", "demo_10"]
    path = write_robomimic(
        tmp_path / "version.hdf5", change=lambda file: file["data"].create_dataset("version", data=3)
    )
    assert len(RobomimicSource(path).units) == 3, "an array beside the demonstrations is no damage"


def test_low_dimensional_files_are_refused_with_the_remedy(tmp_path):
    path = write_robomimic(tmp_path / "low_dim.hdf5", images=False)
    with pytest.raises(DataError, match=r"demo_9/obs has no \*_image .*dataset_states_to_obs"):
        RobomimicSource(path)


def test_without_an_image_of_that_name_every_picture_is_a_camera(tmp_path):
    """As LIBERO writes them."""

    def rename(file):
        for demo in file["data"].values():
            for camera in ("agentview", "robot0_eye_in_hand"):
                demo["obs"].move(f"{camera}_image", f"{camera}_rgb")
            demo["obs/depth"] = np.zeros((len(demo["actions"]), 32, 32, 1), np.float32)

    path = write_robomimic(tmp_path / "libero.hdf5", change=rename)
    source, usual = RobomimicSource(path), RobomimicSource(write_robomimic(tmp_path / "image.hdf5"))
    assert list(source.cameras) == ["agentview_rgb", "robot0_eye_in_hand_rgb"]
    assert list(source.unsupported_images) == ["observation/depth"]
    assert [list(e.images.values()) for e in source.read(1)] == [list(e.images.values()) for e in usual.read(1)]
    episode = RobomimicDataset(path).episode(1, "observation/agentview_rgb", ["action"])
    assert [number(image) for image in episode.images] == [24 + t for t in range(7)]


@pytest.mark.parametrize(
    "field, message",
    [
        ("agentview", "'obs/agentview_image' and 'obs/agentview' would both be called 'observation/agentview'"),
        ("sim_state", "'states' and 'obs/sim_state' would both be called 'observation/sim_state'"),
    ],
)
def test_no_field_hides_another_of_the_same_name(tmp_path, field, message):
    def change(file):
        for demo in file["data"].values():
            demo[f"obs/{field}"] = np.zeros((len(demo["actions"]), 2), np.float32)

    path = write_robomimic(tmp_path / "image.hdf5", change=change)
    with pytest.raises(DataError, match=f"demo_9: {message}. Rename one of them"):
        RobomimicSource(path)


def test_integers_and_flags_are_vectors_too(tmp_path):
    def change(file):
        for demo in file["data"].values():
            demo["obs/gripper"] = np.arange(len(demo["actions"]))[:, None]
            demo["obs/contact"] = np.ones(len(demo["actions"]), bool)

    source = RobomimicSource(write_robomimic(tmp_path / "image.hdf5", change=change))
    assert source.identity() != RobomimicSource(write_robomimic(tmp_path / "otherimage.hdf5")).identity()
    dataset, _ = read_back(convert(source, tmp_path, "lift").directory, "observation/agentview")
    record = dataset.record(0)
    assert record["steps/observation/gripper"].tolist() == [0, 1, 2, 3, 4]
    assert record["steps/observation/contact"].tolist() == [1] * 5


def test_a_depth_image_beside_the_cameras_is_named_and_left_out(tmp_path):
    def change(file):
        for demo in file["data"].values():
            demo["obs/agentview_depth_image"] = np.zeros((len(demo["actions"]), 32, 32, 1), np.uint16)

    source = RobomimicSource(write_robomimic(tmp_path / "image.hdf5", change=change))
    assert list(source.cameras) == ["agentview", "robot0_eye_in_hand"]
    assert source.unsupported_images == {"observation/agentview_depth_image": (32, 32, 1)}


def test_groups_beside_the_arrays_of_a_demonstration_are_left_out(tmp_path):
    """As Isaac Lab writes them."""

    def change(file):
        file["data/demo_9/obs"].create_group("extra")
        del file["data/demo_9/states"]
        file["data/demo_9"].create_group("states")

    source = RobomimicSource(write_robomimic(tmp_path / "a.hdf5", change=change))
    assert not {"observation/extra", "observation/sim_state"} & source.layout.vectors.keys()
    assert len(list(source.read(0))) == 1


def test_a_group_in_the_place_of_an_array_is_damage(tmp_path):
    def change(file):
        del file["data/demo_9/actions"]
        file["data/demo_9"].create_group("actions")

    with pytest.raises(DataError, match="a.hdf5 is damaged .*Group.*Download the file again"):
        RobomimicSource(write_robomimic(tmp_path / "a.hdf5", change=change))


def test_success_without_rewards_is_by_done_and_otherwise_unknown():
    assert succeeded(np.array([0.0, 0.9]), np.array([0, 1])) is False  # shaped reward, done at the end
    assert succeeded(None, np.array([0, 1])) is True
    assert succeeded(None, np.array([0, 0])) is False
    assert succeeded(None, None) is None


def drop(key):
    return lambda file: file.__delitem__(key)


def env_args(value):
    return lambda file: file["data"].attrs.__setitem__("env_args", value)


def test_a_file_of_libero_says_its_task_in_words(tmp_path):
    """Its env_name is the scene, which many tasks share; the dataset is still called by it."""

    def say(file):
        file["data"].attrs["problem_info"] = '{"language_instruction": "turn on the stove"}'

    path = write_robomimic(tmp_path / "libero.hdf5", change=say)
    (episode,) = RobomimicSource(path).read(0)
    assert episode.instructions == ["turn on the stove"] * 5
    dataset = RobomimicDataset(path)
    assert dataset.record(0, [INSTRUCTION_KEY]) == {INSTRUCTION_KEY: [b"turn on the stove"] * 5}
    assert dataset.name == "robomimic_lift"
    assert RobomimicSource(path).identity()["text"] == "turn on the stove"


@pytest.mark.parametrize("kwargs", ["null", "[]", "{}"])
def test_a_file_that_does_not_say_its_rate_is_converted_at_that_of_the_published_tasks(tmp_path, kwargs):
    """Read where it lies it has none: an entry must say it."""
    path = write_robomimic(tmp_path / "image.hdf5", change=env_args(f'{{"env_name": "Lift", "env_kwargs": {kwargs}}}'))
    assert RobomimicSource(path).hz == 20 and RobomimicDataset(path).hz is None
    assert RobomimicDataset(write_robomimic(tmp_path / "says.hdf5")).hz == 20


def test_a_demonstration_that_does_not_say_its_success_is_not_written_as_a_failure(tmp_path):
    def change(file):
        del file["data/demo_10/rewards"], file["data/demo_10/dones"]

    source = RobomimicSource(write_robomimic(tmp_path / "image.hdf5", change=change))
    with pytest.raises(DataError, match="data/demo_10: it does not say whether it succeeded, but other recordings do"):
        convert(source, tmp_path, "toy")
    assert convert(source, tmp_path, "toy", skip_damaged=True).episodes == 2


def shorten(file):
    frames = file["data/demo_10/obs/agentview_image"][:-1]
    del file["data/demo_10/obs/agentview_image"]
    file["data/demo_10/obs/agentview_image"] = frames


@pytest.mark.parametrize(
    "change, message",
    [
        (drop("data"), "no group 'data'"),
        (drop("data/demo_10/actions"), "data/demo_10/actions cannot be read"),
        (drop("data/demo_10/obs/agentview_image"), "data/demo_10/obs/agentview_image cannot be read"),
        (shorten, r"demo_10/obs/agentview_image is uint8 \[6, 32, 32, 3\]; 7 actions need"),
        (env_args("{"), "env_args of 'data' is not JSON"),
        (env_args(3), "env_args of 'data' is not JSON"),
        (env_args('{"env_kwargs": {"control_freq": "fast"}}'), "says control_freq 'fast', which is not a rate"),
        (env_args('{"env_kwargs": {"control_freq": -20}}'), "says control_freq -20, which is not a rate"),
    ],
)
def test_malformed_files_are_named_to_the_field(tmp_path, change, message):
    path = write_robomimic(tmp_path / "image.hdf5", change=change)
    with pytest.raises(DataError, match=message):
        convert(RobomimicSource(path), tmp_path, "lift")
    assert not list(tmp_path.glob("lift/1.0.0"))


def test_a_mask_that_names_a_demonstration_twice_is_refused(tmp_path):
    def change(file):
        file["mask/mine"] = np.array([b"demo_9", b"demo_11", b"demo_9"])

    path = write_robomimic(tmp_path / "image.hdf5", change=change)
    with pytest.raises(DataError, match="mask/mine names 'demo_9' twice"):
        RobomimicSource(path, RobomimicSettings(filter_key="mine"))


def test_something_else_than_hdf5_is_refused(tmp_path):
    (tmp_path / "x.hdf5").write_text("no")
    with pytest.raises(DataError, match="not a readable HDF5 file"):
        RobomimicSource(tmp_path / "x.hdf5")
