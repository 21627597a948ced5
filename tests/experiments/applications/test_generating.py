"""`hma generate`: what is replayed, what is written, and that being killed changes nothing."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from data_pipelines.convert import write as convert_module
from data_pipelines.convert.write import encode
from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.registry import get_spec
from data_pipelines.sources.lerobot_dataset import LeRobotDataset
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.source import SUCCESS_KEY, find_instructions
from data_pipelines.suite.generate import generate_suite
from data_pipelines.tokens.store import TokenStore
from experiments.applications.generating import compare as comparing
from experiments.applications.generating import source as source_module
from experiments.applications.generating import trajectories as trajectories_module
from experiments.applications.generating.survey import survey
from experiments.applications.generating.trajectories import describe, describe_training, open_trajectories
from experiments.cli.main import main
from experiments.simulators import load_simulator
from hma_jax.config import ConfigError, DecodeConfig, MaskingConfig, TrainConfig
from hma_jax.evaluation.metrics import MAX_PSNR
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.simulator.folder import save_robots
from hma_jax.simulator.robots import Robot
from hma_jax.tokenizers.io import load_tokenizer
from tests.data_pipelines.fakes import write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset
from tests.experiments.applications.runs import TABLE, make_run

ROBOT = Robot.of(TABLE.entries[0])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Five recorded episodes of pusher_sand."""
    root = tmp_path_factory.mktemp("suite")
    (directory,) = generate_suite(root, scale=0.01, validation=5, names=["pusher_sand"])
    return directory


@pytest.fixture
def gnm(tmp_path):
    """(simulator, spec) of a model that knows a robot of two actions at stride 2, in `tmp_path / "study"`."""
    spec = get_spec("berkeley_gnm_cory_hall")
    entry = Embodiment(spec.name, 2, 2, (0.0,) * 2, (1.0,) * 2, layout=spec.action_layout())
    return load_simulator(make_run(tmp_path / "study", table=EmbodimentTable((*TABLE.entries, entry)))), spec


def opened(simulator, spec, place, **options):
    """The recordings at `place`, as the robot that `spec` is called after sees them."""
    robot, none = simulator.robot(spec.name), place.parent / "no store"
    return open_trajectories(str(place), "train", robot, {}, simulator.tokenizer, none, **options)[0]


def generate(run, recorded, out, *more: str) -> int:
    asked = ["--actions", str(recorded), "--split", "val", "--out", str(out), "--batch", "2", "--clips", "0"]
    return main(["generate", str(run), *asked, *more])


def content(out):
    directory = out / "pusher_sand_generated" / "1.0.0"
    return {path.name: path.read_bytes() for path in directory.iterdir() if not path.name.startswith(".")}


def test_recorded_actions_are_replayed_and_a_killed_command_goes_on(run, recorded, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(source_module, "SHARD_BYTES", 1)  # a shard per batch
    clip = tmp_path / "whole" / "pusher_sand_generated" / "clips" / "00000.mp4"
    clip.parent.mkdir(parents=True)
    clip.write_bytes(b"of a dataset that was removed")
    assert generate(run, recorded, tmp_path / "whole", "--clips", "1") == 0
    assert len(clip.read_bytes()) > 500
    said = " ".join(capsys.readouterr().out.split())
    assert "5 episodes. PSNR against the recording" in said and "hma data inspect" in said

    begun = []
    encode = convert_module.encode

    def dies(episode, layout):
        begun.append(episode.origin)
        if len(begun) == 4:  # in the second of three batches
            raise KeyboardInterrupt
        return encode(episode, layout)

    monkeypatch.setattr(convert_module, "encode", dies)
    assert generate(run, recorded, tmp_path / "cut") == 130
    assert not (tmp_path / "cut" / "pusher_sand_generated" / "1.0.0").exists()
    assert generate(run, recorded, tmp_path / "cut") == 0
    assert begun[4:] == [f"generated/pusher_sand/val/{i}/seed {episode_seed(i)}" for i in (2, 3, 4)]
    assert content(tmp_path / "cut") == content(tmp_path / "whole")

    made = RldsDataset(tmp_path / "whole" / "pusher_sand_generated" / "1.0.0")
    source = RldsDataset(recorded, "val")
    metadata = json.loads(content(tmp_path / "whole")["metadata.json"])
    assert metadata["actions"]["dataset"] == "pusher_sand" and metadata["hz"] == 2.0 and metadata["stride"] == 2
    assert len(made) == len(source) == 5 and made.hz == 2
    for i in range(5):
        mine = made.episode(i, "observation/image", ("action",))
        truth = open_trajectories(str(recorded), "val", ROBOT, {}, load_tokenizer(run.parent / "tokenizer"), run)[0][i]
        low, high = np.array(ROBOT.low * 2, np.float32), np.array(ROBOT.high * 2, np.float32)
        np.testing.assert_array_equal(mine.actions, np.clip(truth.chunks.reshape(len(truth), -1), low, high))
        apart = np.abs(np.stack(mine.images).astype(int) - truth.images)
        assert apart[:3].mean() < 6 < apart[3:].mean()  # JPEG; then a model that knows nothing


def test_what_was_made_under_other_ranges_of_actions_is_not_taken_for_the_same(run, recorded, tmp_path, capsys):
    assert generate(run, recorded, tmp_path, "--episodes", "1", "--allow-clipping") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "1 episode. PSNR" in said and "(one alone has no interval); a still" in said and "nan" not in said
    save_robots([replace(ROBOT, low=tuple(x / 2 for x in ROBOT.low))], run / "robots.json")
    try:
        assert generate(run, recorded, tmp_path, "--episodes", "1", "--allow-clipping") == 2
    finally:
        (run / "robots.json").unlink()
    assert "was made from another source, with other settings or by an earlier version" in " ".join(
        capsys.readouterr().err.split()
    )


def test_what_a_version_of_before_began_is_not_finished_with_other_bytes(run, recorded, monkeypatch):
    """It had no instructions, and what came after it had some."""
    simulator = load_simulator(run)
    driven, _ = open_trajectories(str(recorded), "val", ROBOT, {}, simulator.tokenizer, run)
    source = source_module.GeneratedSource(simulator, ROBOT, driven, given=1, count=1, seed=0, checkpoint="")
    now = source.identity()
    monkeypatch.setattr(source_module, "GENERATOR_VERSION", source_module.GENERATOR_VERSION - 1)
    assert source.identity() != now


def test_the_rate_is_the_recordings_where_the_run_does_not_know_it(tmp_path):
    """As that of a robot which the model knew before others were added: its tokens are in another study."""
    spec = get_spec("berkeley_gnm_cory_hall")
    table = EmbodimentTable((*TABLE.entries, Embodiment(spec.name, 2, 2, (0.0,) * 2, (1.0,) * 2)))
    simulator = load_simulator(make_run(tmp_path / "study", table=table))
    robot, rlds = simulator.robot(spec.name), write_rlds(tmp_path, spec, [9, 9])
    recorded, _ = open_trajectories(str(rlds), "train", robot, {}, simulator.tokenizer, tmp_path)
    source = source_module.GeneratedSource(simulator, robot, recorded, given=1, count=2, seed=0, checkpoint="")
    assert robot.hz == 0 and source.hz == spec.hz / 2 == 2.5


def test_actions_that_stand_in_another_order_than_the_model_learnt_are_not_replayed(tmp_path, monkeypatch):
    spec = get_spec("berkeley_gnm_cory_hall")
    entry = Embodiment(spec.name, 2, 2, (0.0,) * 2, (1.0,) * 2, layout=spec.action_layout())
    simulator = load_simulator(make_run(tmp_path / "study", table=EmbodimentTable((*TABLE.entries, entry))))
    robot, rlds = simulator.robot(spec.name), str(write_rlds(tmp_path, spec, [9, 9]))

    def opened():
        recorded, _ = open_trajectories(rlds, "train", robot, {}, simulator.tokenizer, tmp_path)
        source_module.GeneratedSource(simulator, robot, recorded, given=1, count=2, seed=0, checkpoint="")
        return recorded

    recorded, (key,) = opened(), spec.action_keys
    known = describe(recorded)
    recorded.spec = replace(spec, image_key="observation/wrist")
    assert describe(recorded) != known, "what another camera gives is not taken for the same"
    swapped = replace(spec, action_keys=(f"{key}[1:]", f"{key}[:1]"), action_dims=(1, 1))
    monkeypatch.setattr(trajectories_module, "get_spec", lambda _: swapped)
    with pytest.raises(ConfigError, match="another order of them, than when the model was trained"):
        opened()


def test_frames_that_are_corrected_otherwise_than_those_a_model_learnt_from_are_refused(tmp_path, monkeypatch):
    spec = get_spec("berkeley_gnm_cory_hall")
    entry = Embodiment(spec.name, 2, 2, (0.0,) * 2, (1.0,) * 2, layout=spec.action_layout())
    simulator = load_simulator(make_run(tmp_path / "study", table=EmbodimentTable((*TABLE.entries, entry))))
    robot, rlds, tokens = simulator.robot(spec.name), str(write_rlds(tmp_path, spec, [9, 9])), tmp_path / "tokens"
    tokenize_dataset(spec, rlds, simulator.tokenizer, tokens, min_val=1)
    rotated = replace(spec, image_corrections=("rotate_180",))

    def opened(entry):
        monkeypatch.setattr(trajectories_module, "get_spec", lambda _: entry)
        return open_trajectories(rlds, "train", robot, {}, simulator.tokenizer, tokens)

    assert len(opened(spec)[0]) == 2
    with pytest.raises(ConfigError, match=r"image_corrections .* \(there -> asked for\): none -> rotate_180\. "):
        opened(rotated)
    tokenize_dataset(rotated, rlds, simulator.tokenizer, tokens, min_val=1, overwrite=True)
    assert len(opened(rotated)[0]) == 2
    with pytest.raises(ConfigError, match=r"\(there -> asked for\): rotate_180 -> none\. "):
        opened(spec)


def test_recordings_may_lack_as_many_episodes_as_were_left_out_of_their_tokens(tmp_path):
    """The model was trained without them; `hma judge` has no option of its own for it."""
    spec = get_spec("berkeley_gnm_cory_hall")
    entry = Embodiment(spec.name, 2, 2, (0.0,) * 2, (1.0,) * 2, layout=spec.action_layout())
    simulator = load_simulator(make_run(tmp_path / "study", table=EmbodimentTable((*TABLE.entries, entry))))
    rlds, tokens = write_rlds(tmp_path, spec, [9] * 6, shards=3), tmp_path / "tokens"
    sorted(rlds.glob("*tfrecord*"))[1].unlink()

    def opened():
        return open_trajectories(str(rlds), "train", simulator.robot(spec.name), {}, simulator.tokenizer, tokens)[0]

    with pytest.raises(DataError, match="00001-of-00003"):
        opened()
    tokenize_dataset(spec, rlds, simulator.tokenizer, tokens, min_val=1, corrupt="skip")
    recorded = opened()
    assert len(recorded) == len(set(recorded.ids().tolist())) == 4


def with_texts(e: int, features: dict) -> None:
    """Two texts in an episode of 9 steps, whose later frames and actions are those of a damaged one if e is 1."""
    features["steps/language_instruction"] = [b"open"] * 4 + [b"close"] * 5
    if e == 1:
        features["steps/observation/image"][4] = b"no image"


def source_of(simulator, spec, recorded, **options):
    given = {"given": 1, "count": len(recorded), "seed": 0, "checkpoint": ""}
    return source_module.GeneratedSource(simulator, simulator.robot(spec.name), recorded, **given | options)


def test_texts_rewards_and_success_are_those_of_the_recording(gnm, tmp_path):
    """An episode had its first text, the reward 0 and no success."""
    simulator, spec = gnm
    place = write_rlds(tmp_path, spec, [9, 9], change=with_texts, rewards=lambda e: np.arange(9))
    twin = source_of(simulator, spec, opened(simulator, spec, place), count=1, knows_success=True).twin()
    (episode,) = twin.read(0)
    assert list(episode.instructions) == ["open"] * 2 + ["close"] * 3
    assert episode.rewards.tolist() == [1, 5, 9, 13, 8] and episode.success is False
    encode(episode, twin.layout)


def test_texts_as_code_points_are_read():
    """As Language Table has them."""
    points = np.array([[*b"push", 0, 0], [*b"pull", 0, 0]])
    assert find_instructions({"steps/observation/instruction": points.ravel()}, 2) == ["push", "pull"]
    assert find_instructions({"steps/observation/instruction": np.array([3, 3])}, 2) == ["", ""]


def test_a_damaged_episode_stops_the_command_or_is_left_out(gnm, tmp_path):
    simulator, spec = gnm
    place = write_rlds(tmp_path, spec, [9] * 3, change=with_texts)

    def read(**options):
        source = source_of(simulator, spec, opened(simulator, spec, place, **options)).twin()
        return [item for unit in range(len(source.units)) for item in source.read(unit)]

    with pytest.raises(EpisodeError, match="episode 1 .*step 4 of .* cannot be decoded"):
        read()
    found = read(skip_damaged=True)
    assert [getattr(item, "origin", "left out") for item in found] == [
        f"recorded/{spec.name}/train/0", "left out", f"recorded/{spec.name}/train/2"
    ]  # fmt: skip
    assert "corrupt=" not in found[1].reason and str(tmp_path) not in found[1].reason


def test_actions_in_other_units_are_told_and_refused(gnm, tmp_path):
    """They were clipped, and nothing said so."""
    simulator, spec = gnm
    robot, recorded = simulator.robot(spec.name), opened(simulator, spec, write_rlds(tmp_path, spec, [4, 9]))
    known = survey(recorded, 2, robot)  # its second value is the number of the step; the range ends at 3
    assert known.shares() == {"action 1": round(5 / 13, 6)} and known.knows_success
    assert "(38 % of action 1): action 1 of 0 to 8 is outside the range" in known.describe()
    known.require_raw_units()
    assert known.note().startswith("note: recorded actions") and survey(recorded, 1, robot).note() == ""
    other = replace(robot, low=(-3.0, -3.0), high=(3.0, 1.0))
    with pytest.raises(ConfigError, match="hardly its raw units.*--allow-clipping"):
        survey(recorded, 2, other).require_raw_units()


@pytest.mark.parametrize(
    "changed",
    [
        {"checkpoint": "other"}, {"step": 4}, {"tokenizer": "u"}, {"decode": DecodeConfig(3, 0.5)}, {"seed": 1},
        {"given": 2}, {"count": 4}, {"fingerprint": "other"}, {"split": "val"},
    ],
    ids=lambda changed: next(iter(changed)),
)  # fmt: skip
def test_what_was_generated_in_another_way_is_another_dataset(changed):
    spec, robot = get_spec("berkeley_gnm_cory_hall"), Robot("other", 2, (0.0,) * 2, (1.0,) * 2, (0.0,) * 2)

    class Fake:
        def __init__(self, step=3, tokenizer="t", decode=DecodeConfig()):
            self.model, self.decode = SimpleNamespace(table=None, step=step), decode
            self.tokenizer = SimpleNamespace(image_shape=(8, 8), identity=tokenizer)

        def __len__(self):
            return 3

    def identity(checkpoint="c", seed=0, given=1, count=5, fingerprint="f", split="train", **of_simulator):
        recorded = SimpleNamespace(name=spec.name, split=split, fingerprint=fingerprint, spec=spec, observed={})
        own = {"given": given, "count": count, "seed": seed, "checkpoint": checkpoint}
        return source_module.GeneratedSource(Fake(**of_simulator), robot, recorded, **own).identity()

    assert identity(**changed) != identity()


def test_another_rate_of_the_recordings_is_another_dataset(gnm, tmp_path):
    simulator, spec = gnm
    recorded = opened(simulator, spec, write_rlds(tmp_path, spec, [9]))
    known = source_of(simulator, spec, recorded).identity()
    recorded.spec = replace(spec, hz=2 * spec.hz)
    assert source_of(simulator, spec, recorded).identity() != known


def test_the_recorded_twin_has_the_layout_and_actions_of_what_was_generated(run, recorded, tmp_path):
    assert generate(run, recorded, tmp_path, "--episodes", "2", "--recorded") == 0
    places = [tmp_path / f"pusher_sand_{kind}" / "1.0.0" for kind in ("generated", "recorded")]
    assert len({(place / "features.json").read_bytes() for place in places}) == 1
    made, twin = map(RldsDataset, places)
    source, keys = RldsDataset(recorded, "val"), ["steps/observation/state", "steps/observation/position"]
    for i in range(2):
        mine, truth = (one.episode(i, "observation/image", ("action",)) for one in (made, twin))
        np.testing.assert_array_equal(mine.actions, truth.actions)
        np.testing.assert_array_equal(mine.images[:3], truth.images[:3])
        for key in keys:
            rows = source.record(i, [key])[key].reshape(len(source.episode(i, "observation/image", ()).images), -1)
            np.testing.assert_array_equal(made.record(i, [key])[key].reshape(len(mine.images), -1), rows[::2])
        assert mine.success is truth.success is source.episode(i, "observation/image", ()).success
    about = [json.loads((place / "metadata.json").read_text()) for place in places]
    assert about[0]["action"] == about[1]["action"] == {
        "shape": [2, 2], "values": ["xy x", "xy y"], "fields": ["action"], "rows_per_second": 4.0
    }  # fmt: skip
    assert about[0]["clipped"] == about[1]["clipped"] and about[0]["clipped"].keys() <= {"xy x", "xy y"}

    assert main(["data", "export", str(places[0]), "--out", str(tmp_path / "lerobot")]) == 0
    exported = LeRobotDataset(tmp_path / "lerobot")
    assert exported.hz == 2
    for i in range(2):
        for key in (*keys, "steps/action", "steps/reward", "steps/language_instruction", SUCCESS_KEY):
            theirs, ours = (one.record(i, [key])[key] for one in (exported, made))
            np.testing.assert_array_equal(np.asarray(theirs).ravel(), np.asarray(ours).ravel())


def episode_seed(i: int) -> int:
    return source_module.episode_seed(0, f"pusher_sand/val/{i}")


def test_that_a_model_without_actions_follows_none_is_said(tmp_path, capsys):
    run = make_run(tmp_path / "study", TrainConfig(masking=MaskingConfig(setting="passive")))
    assert generate(run, tmp_path / "none", tmp_path / "out") == 2
    assert "note: the model was trained without actions" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_a_token_store_gives_the_same_trajectories(run, recorded, tmp_path, capsys):
    tokenizer, robots = load_tokenizer(run.parent / "tokenizer"), {ROBOT.name: ROBOT}
    tokenize_dataset(get_spec("pusher_sand"), recorded, tokenizer, tmp_path, min_val=1, keep_frames="val")
    for split in ("train", "val"):
        stored, robot = open_trajectories("pusher_sand", split, None, robots, tokenizer, tmp_path)
        assert robot == ROBOT
        number = int(stored._store.episode("pusher_sand", split, 0).episode)
        truth = open_trajectories(str(recorded), "train+val", ROBOT, robots, tokenizer, tmp_path)[0][number]
        np.testing.assert_array_equal(stored[0].chunks, truth.chunks)
        seen = truth.images if split == "val" else tokenizer.decode(tokenizer.encode(truth.images))
        np.testing.assert_array_equal(stored[0].images, seen)
        asked = [
            "--actions",
            str(tmp_path / "pusher_sand"),
            "--split",
            split,
            "--episodes",
            "1",
            "--clips",
            "0",
            "--allow-clipping",
        ]
        assert main(["generate", str(run), *asked, "--out", str(tmp_path / split)]) == 0
        said = " ".join(capsys.readouterr().out.split())
        note = f"has no frames of pusher_sand, split {split}. PSNR is computed against frames decoded from tokens"
        assert (note in said) == (split == "train")
    with pytest.raises(ConfigError, match=f"pusher: no such directory, and {tmp_path} has tokens of pusher_sand$"):
        open_trajectories("pusher", "val", None, robots, tokenizer, tmp_path)


def test_how_many_of_the_episodes_a_study_trains_on_is_said(recorded, tmp_path, capsys):
    own = make_run(tmp_path)
    tokenizer = load_tokenizer(tmp_path / "tokenizer")
    spec = get_spec("pusher_sand")
    tokenize_dataset(spec, recorded, tokenizer, tmp_path / "tokens", min_val=1, keep_frames="val")
    manifest = TokenStore(tmp_path / "tokens").manifest("pusher_sand")
    trained, held_out = len(manifest.train.episodes), len(manifest.val.episodes)

    def note(place: str, split: str) -> str:
        found = open_trajectories(place, split, None, {ROBOT.name: ROBOT}, tokenizer, tmp_path / "tokens")[0]
        return describe_training(found, len(found), tmp_path / "tokens")

    assert f"trains on {trained} of {trained + held_out} episodes" in note(str(recorded), "train+val")
    assert note("pusher_sand", "val") == "" and f"{trained} of {trained} " in note("pusher_sand", "train")
    capsys.readouterr()
    asked = ["--actions", "pusher_sand", "--episodes", "1", "--clips", "0", "--batch", "2"]
    assert main(["generate", str(own), *asked, "--out", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "trains on 1 of 1 episode" in said and "`--actions pusher_sand --split val`" in said


def test_what_cannot_be_replayed_is_refused(run, recorded, tmp_path):
    tokenizer = load_tokenizer(run.parent / "tokenizer")
    gripper = Robot.of(TABLE.entries[1])
    with pytest.raises(ConfigError, match="2 action values, but gripper_wood needs 4"):
        open_trajectories(str(recorded), "val", gripper, {}, tokenizer, tmp_path)
    with pytest.raises(ConfigError, match="choose one with --robot"):
        open_trajectories(str(recorded), "val", None, {gripper.name: gripper}, tokenizer, tmp_path)


@pytest.mark.slow
def test_a_run_outside_a_study_begins_with_the_recordings_it_is_given(recorded, tmp_path, capsys):
    """As one that was converted: there are neither starts beside it nor held-out frames of its robot."""
    mine = EmbodimentTable((replace(TABLE.entries[0], name="My-Arm"),))
    run = make_run(tmp_path / "converted", table=mine)
    with pytest.raises(ConfigError, match="Move the run into the directory of a study"):
        load_simulator(run)
    assert generate(run, recorded, tmp_path / "out", "--robot", "My-Arm", "--episodes", "2") == 0
    assert (tmp_path / "out" / "my_arm_generated" / "1.0.0").is_dir()
    assert "2 episodes. PSNR against the recording" in " ".join(capsys.readouterr().out.split())


def test_clips_that_cannot_be_written_are_refused_at_once(run, recorded, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "av", None)
    assert generate(run, recorded, tmp_path / "out", "--clips", "1") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "--clips 1 needs the package 'av'" in said and "hma-jax[convert]" in said
    assert not (tmp_path / "out").exists()


def test_generated_frames_and_a_still_are_compared_with_what_was_recorded_after_the_given_ones(tmp_path, monkeypatch):
    recorded = np.broadcast_to(np.uint8([0, 10, 20, 40])[:, None, None, None], (4, 8, 8, 3))
    generated = recorded + np.uint8([0, 0, 5, 5])[:, None, None, None]
    pairs = [comparing.Pair(7, generated, recorded), comparing.Pair(9, recorded, recorded)]
    monkeypatch.setattr(comparing, "RldsDataset", lambda _: pairs)
    monkeypatch.setattr(comparing, "read_pairs", lambda *_: iter(pairs))
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips" / "00001.mp4").touch()  # of another dataset that was here
    found = comparing.compare(tmp_path / "data", None, given=2, clips=0, rate=2.0)
    assert not list((tmp_path / "clips").iterdir())
    off, still = 20 * np.log10(255 / 5), 20 * np.log10(255 / np.array([10.0, 30.0]))
    assert (found.generated.mean, found.still.mean) == pytest.approx(((off + MAX_PSNR) / 2, still.mean()))
    rows = [line.split(",")[:2] for line in (tmp_path / "psnr.csv").read_text().splitlines()[1:]]
    assert rows == [["7", "2"], ["7", "3"], ["9", "2"], ["9", "3"]]
