"""What generated trajectories are worth: who is trained on what, and what is made of the outcomes."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from data_pipelines.suite.generate import generate_suite
from experiments.analysis.bootstrap import bootstrap_intervals
from experiments.applications import synthetic
from experiments.applications.generating import conditions, demonstration_sources
from experiments.applications.generating.conditions import (
    ALL,
    CONDITIONS,
    CONTROL,
    FEW,
    GIVEN,
    MOST,
    PASSIVE,
    Condition,
    share_closed,
)
from experiments.applications.generating.demonstration_sources import (
    RecordedSource,
    ScriptedSource,
    Settings,
    Training,
    shuffled_actions,
)
from experiments.applications.generating.reconstruction import ThroughTokenizer, reconstruct_recorded
from experiments.applications.generating.trajectories import open_trajectories
from experiments.applications.policies.acting import scale_of
from experiments.applications.policies.cloning import BcConfig
from experiments.applications.policies.demonstrations import Demonstrations, save_demonstrations
from experiments.applications.policies.network import EncoderConfig
from experiments.applications.synthetic import choose, make_data, run_trial
from experiments.simulators import load_simulator
from hma_jax.config import ConfigError, DecodeConfig, MaskingConfig, TrainConfig
from hma_jax.simulator.folder import DECODE, change_decode, save_decode
from hma_jax.simulator.robots import Robot
from tests.experiments.applications.runs import TABLE, make_run


def demonstrations(kind: int, count: int = 100) -> Demonstrations:
    """Episodes of one pixel that says of which kind they are, and an action that says which one it is."""
    images = np.full((count, 3, 1, 1, 3), kind, np.uint8)
    actions, ones = np.repeat(np.arange(count, dtype=np.float32), 3).reshape(count, 3, 1), np.ones(count, int)
    images[:, 0] = 0  # the frame that a generated trajectory is given is a recorded one
    return Demonstrations(images, actions, 3 * ones, np.ones((count, 3), bool), ones > 0, ones)


DATA = {kind: demonstrations(i) for i, kind in enumerate(("recorded", "generated", "shuffled", "blind"))}


def test_conditions_are_nested_and_no_recording_is_also_generated():
    chosen = [choose(c, DATA, 3, 1) for c in CONDITIONS if c.kind in DATA]
    assert len(chosen) == GIVEN == len(CONDITIONS) - 1
    which = [d.actions[:, 0, 0].astype(int).tolist() for d in chosen]
    kinds = [np.bincount(d.images[:, 0, 0, 0, 0], minlength=4).tolist() for d in chosen]
    assert kinds[:4] == [[10, 0, 0, 0], [10, 10, 0, 0], [10, 50, 0, 0], [10, 90, 0, 0]]
    assert kinds[4:] == [[10, 0, 90, 0], [100, 0, 0, 0], [10, 0, 0, 90]]
    assert all(len(set(w)) == len(w) for w in which)
    for d, c in zip(
        chosen, CONDITIONS[:GIVEN], strict=True
    ):  # of a generated trajectory two frames, none of them recorded
        assert d.lengths.tolist() == [3] * c.recorded + [2] * c.generated
        assert (d.images[c.recorded :, :2] > 0).all()
    for fewer, more in zip(which[:3], which[1:4], strict=True):
        assert more[: len(fewer)] == fewer
    assert which[MOST] == which[CONTROL] == which[PASSIVE] and sorted(which[ALL]) == sorted(which[MOST])
    assert set(which[FEW]) != set(choose(CONDITIONS[FEW], DATA, 4, 1).actions[:, 0, 0].astype(int).tolist())


def test_the_third_control_has_the_recorded_frames_that_generated_trajectories_begin_with_and_no_others(tmp_path):
    count = 100
    rng, lengths = np.random.default_rng(0), np.where(np.arange(count) == 4, 1, 3)
    recorded = replace(demonstrations(0), images=rng.integers(0, 256, (count, 3, 1, 1, 3), np.uint8), lengths=lengths)
    for kind in ("recorded", "generated", "shuffled", "held_out"):
        save_demonstrations(recorded, tmp_path / f"{kind}.npz")
    settings = Settings(given=2, with_given=True)
    data = make_data(SimpleNamespace(settings=settings), None, tmp_path)
    made = choose(CONDITIONS[GIVEN], data, 3, 0)
    which = made.actions[:, 0, 0].astype(int)
    assert sorted(which) == list(range(count))
    assert made.lengths[:10].tolist() == lengths[which[:10]].tolist()
    assert made.lengths[10:].tolist() == np.minimum(lengths[which[10:]], 2).tolist()
    episode, frame = made.steps()
    np.testing.assert_array_equal(made.images[episode, frame], recorded.images[which[episode], frame])
    assert which[:10].tolist() == choose(CONDITIONS[MOST], data, 3, 0).actions[:10, 0, 0].astype(int).tolist()
    without = make_data(SimpleNamespace(settings=replace(settings, with_given=False)), None, tmp_path)
    assert set(data) - set(without) == {conditions.GIVEN_KIND}


class Coarse:
    """A tokenizer whose reconstruction keeps the upper half of a grey level."""

    def reconstruct(self, images: np.ndarray) -> np.ndarray:
        assert images.ndim == 4 and images.dtype == np.uint8
        return images // 16 * 16


def test_policies_that_see_through_the_tokenizer_see_no_frame_otherwise_and_none_is_reconstructed_twice():
    rng, ones = np.random.default_rng(0), np.ones(2, int)

    def made(first: np.ndarray | None = None) -> Demonstrations:
        images = rng.integers(0, 256, (2, 4, 8, 8, 3), np.uint8)
        if first is not None:
            images[:, :2] = first[:, :2]
        return Demonstrations(images, np.zeros((2, 4, 1), np.float32), 4 * ones, np.ones((2, 4), bool), ones > 0, ones)

    recorded = made()
    data = {"recorded": recorded, "held_out": made(), "given": replace(recorded, lengths=2 * ones)}
    data |= {kind: made(recorded.images) for kind in ("generated", "shuffled", "blind")}
    seen = reconstruct_recorded(data, Coarse(), 2)
    for kind, demos in seen.items():
        frames = 2 if kind in ("generated", "shuffled", "blind") else 4
        np.testing.assert_array_equal(demos.images[:, :frames], data[kind].images[:, :frames] // 16 * 16)
        np.testing.assert_array_equal(demos.images[:, frames:], data[kind].images[:, frames:])
        np.testing.assert_array_equal(demos.lengths, data[kind].lengths)

    told = []
    policy = SimpleNamespace(reset=lambda *a, **k: told.append((a, k)), act=lambda images: images)
    through = ThroughTokenizer(policy, Coarse())
    through.reset([1], seeds=[7])
    assert told == [(([1],), {"seeds": [7]})]
    np.testing.assert_array_equal(through.act(recorded.images[:, 0]), recorded.images[:, 0] // 16 * 16)


def test_a_policy_that_sees_through_the_tokenizer_does_so_in_the_true_simulator(monkeypatch):
    monkeypatch.setattr(synthetic, "clone", lambda *_: "policy")
    monkeypatch.setattr(synthetic, "action_errors", lambda policy, *_: np.array([float(policy == "policy")]))
    source, coarse = SimpleNamespace(settings=Settings(), judge=lambda policy: {"success": [policy]}), Coarse()
    data = DATA | {"held_out": DATA["recorded"]}
    for through, acting in ((None, "policy"), (coarse, ThroughTokenizer("policy", coarse))):
        found = run_trial(source, CONDITIONS[MOST], data, 0, lambda *_: None, through)
        assert found == {"success": [acting], "error": [1]}


@pytest.mark.parametrize("asked", [False, True])
def test_policies_are_trained_and_judged_through_the_tokenizer_if_that_was_asked_for(asked, tmp_path, monkeypatch):
    """Both in the true simulator: trained on what the tokenizer reconstructs, and acting on it."""
    run, kinds = make_run(tmp_path / "study"), ("recorded", "generated", "shuffled", "held_out")
    monkeypatch.setattr(synthetic, "require_multiples", lambda *_: None)
    monkeypatch.setattr(synthetic, "make_source", lambda *_: SimpleNamespace(settings=settings))
    monkeypatch.setattr(synthetic, "make_data", lambda *_: {kind: demonstrations(i) for i, kind in enumerate(kinds)})
    monkeypatch.setattr(synthetic, "reconstruct_recorded", lambda data, *how: ("reconstructed", data, how))
    monkeypatch.setattr(synthetic, "run_trials", lambda *given: got.append(given) or 1 / 0)
    settings, got = Settings(seeds=(0,), through_tokenizer=asked), []
    monkeypatch.setattr(sys, "argv", ["synthetic", str(run), "--out", str(tmp_path / "out")])
    with pytest.raises(ZeroDivisionError):
        synthetic.main()
    ((_, seen, _, through),) = got
    assert (through is not None) == asked == (seen[0] == "reconstructed" if asked else False)
    assert not asked or seen[2] == (through, 1)


def test_errors_of_all_policies_are_in_one_unit_and_every_policy_has_its_own_seed(monkeypatch):
    """That of the recordings, whatever a policy was trained on."""
    scales, seeds = [], []
    monkeypatch.setattr(synthetic, "clone", lambda demos, config, seed, update: seeds.append(seed))
    monkeypatch.setattr(synthetic, "action_errors", lambda policy, demos, scale: scales.append(scale) or np.zeros(1))
    source, data = SimpleNamespace(settings=Settings(), judge=lambda policy: {}), DATA | {"held_out": DATA["recorded"]}
    for condition, seed in ((CONDITIONS[FEW], 3), (CONDITIONS[MOST], 4)):
        run_trial(source, condition, data, seed, lambda *_: None)
    assert scales == [scale_of(DATA["recorded"])] * 2 and seeds == [3, 4]


def test_the_held_out_demonstrations_of_the_scripted_expert_are_other_episodes(monkeypatch):
    asked, made = [], SimpleNamespace(seeds=None, take=lambda rows: rows)
    monkeypatch.setattr(demonstration_sources, "record", lambda *_, seed, **__: asked.append(seed) or made)
    monkeypatch.setattr(demonstration_sources, "start_distances", lambda *_: np.ones(200))
    source = ScriptedSource(Settings(), Robot("gripper_wood", 1, (0.0,) * 4, (1.0,) * 4, (0.0,) * 4), 32)
    source.record()
    source.record_held_out()
    assert len(set(asked)) == 2


def test_every_control_s_share_is_that_of_its_own_trials_whichever_were_tried():
    rng, seeds = np.random.default_rng(0), (0, 1, 2)
    rates = dict(zip(range(len(CONDITIONS)), (0.2, 0.3, 0.5, 0.7, 0.25, 0.8, 0.4, 0.6), strict=True))
    every = {(i, s): {"success": rng.random(400) < rate} for i, rate in rates.items() for s in seeds}
    found = {one.name: one for one in conditions.summarise(every, seeds)}
    for left_out in ({PASSIVE}, {GIVEN}, {PASSIVE, GIVEN}):
        some = {at: trial for at, trial in every.items() if at[0] not in left_out}
        summaries = conditions.summarise(some, seeds)
        assert len(summaries) == len(found) - 2 * len(left_out)
        assert all(found[one.name] == one for one in summaries)
    for i, name in conditions.SHARES.items():
        share = found[f"share of the gap: {name}"].measured["success"].mean
        assert share == pytest.approx((rates[i] - rates[FEW]) / (rates[ALL] - rates[FEW]), abs=0.08)


def test_the_share_of_the_gap_is_that_of_the_means():
    seeds, rng = (0, 1, 2), np.random.default_rng(0)
    rates = (0.2, 0.3, 0.5, 0.7, 0.25, 0.8)
    trials = {
        (i, s): {"success": rng.random(400) < rate, "distance": np.zeros(400)}
        for i, rate in enumerate(rates)
        for s in seeds
    }
    panel = conditions.make_panel(trials, seeds)
    share, control = share_closed(panel, MOST), share_closed(panel, CONTROL)
    assert share.mean == pytest.approx(0.83, abs=0.08) and share.low < 0.83 < share.high < share.low + 0.4
    assert control.high < share.low
    # The ends are where what remains of the gap is just not significant.
    for r in (share.low, share.high):
        rest = panel.points[MOST] - (1 - r) * panel.points[FEW] - r * panel.points[ALL]
        (left,) = bootstrap_intervals(replace(panel, points=(rest,), seeds=(seeds,)), 2000)
        assert min(abs(left.low), abs(left.high)) == pytest.approx(0, abs=1e-9)
    # Policies trained on few trajectories depend on which: of a gap that is not significant no share is known.
    few = (np.linspace(0, 1, 400) < np.array([[0.0], [0.3], [0.6]])).astype(float)
    alike = share_closed(replace(panel, points=(few, *panel.points[1:])), MOST)
    assert np.isfinite(alike.mean) and np.isnan([alike.low, alike.high]).all()


def test_the_share_of_the_gap_is_that_of_the_seeds_that_all_have():
    """A run may be under way, or have been continued with more seeds."""
    rng, rates = np.random.default_rng(0), {FEW: 0.2, MOST: 0.7, ALL: 0.8}
    trials = {(i, s): {"success": rng.random(400) < rates.get(i, 0.5)} for i in range(6) for s in range(4)}
    some = {at: trial for at, trial in trials.items() if at not in ((MOST, 3), (ALL, 0))}
    found, expected = (share_closed(conditions.make_panel(t, s), MOST) for t, s in ((some, range(4)), (trials, (1, 2))))
    assert found == expected and np.isfinite([found.low, found.high]).all()
    alone = {MOST: 3, ALL: 0}
    none = {(i, s): trial for (i, s), trial in trials.items() if s == alone.get(i, s)}
    assert np.isnan(share_closed(conditions.make_panel(none, tuple(range(4))), MOST).mean)


def test_a_share_without_any_scatter_has_no_interval(recwarn):
    """Ten recordings never succeed, nor do generated ones beside them; a hundred mostly do: no spread is known."""
    rng = np.random.default_rng(0)
    trials = {(i, s): {"success": rng.random(20) < 0.9 * (i == ALL)} for i in range(6) for s in range(3)}
    share = share_closed(conditions.make_panel(trials, (0, 1, 2)), MOST)
    assert share.mean == 0 and np.isnan([share.low, share.high]).all() and not recwarn.list


def test_policies_that_never_succeed_are_no_certainty_and_leave_no_gap_to_close(recwarn):
    trials = {(i, s): {"success": np.full(20, i == MOST), "distance": np.zeros(20)} for i in range(6) for s in (0, 1)}
    found = conditions.summarise(trials, (0, 1))
    few, most, share = (found[i].measured["success"] for i in (0, MOST, 6))
    assert (few.low, most.high) == (0, 1) and few.high == pytest.approx(1 - most.low) == pytest.approx(0.161, abs=0.001)
    assert np.isnan(share.mean) and not recwarn.list
    assert "| 10 recorded | 0.00 | 0.00 to 0.16 |" in conditions.markdown(found)
    assert "| share of the gap: 10 + 90 generated | – | – |" in conditions.markdown(found)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Some recorded episodes of pusher_sand, four of them held out."""
    (directory,) = generate_suite(tmp_path_factory.mktemp("suite"), scale=0.01, validation=4, names=["pusher_sand"])
    return str(directory)


def made_where_it_was_stopped(source, simulator, out: Path, monkeypatch) -> dict[str, Demonstrations]:
    """What `make_data` gives where a kill came upon its second batch; the first is not made again."""
    replay, made = synthetic.replay, []

    def stopped(_, __, trajectories, rows, ___):
        made.append(list(rows))
        if len(made) == 2:
            raise KeyboardInterrupt
        return replay(_, __, trajectories, rows, ___)

    monkeypatch.setattr(synthetic, "replay", stopped)
    with pytest.raises(KeyboardInterrupt):
        make_data(source, simulator, out)
    data = make_data(source, simulator, out)
    assert made == [[0, 1], [2, 3], [2, 3], [4], [0, 1], [2, 3], [4]] and not (out / synthetic.UNDER_WAY).exists()
    return data


@pytest.mark.slow
def test_without_a_simulator_policies_are_judged_on_held_out_recordings(recordings, tmp_path, monkeypatch):
    encoder = EncoderConfig(size=8, channels=(4, 4, 4), hidden=8)
    monkeypatch.setattr(synthetic, "BcConfig", partial(BcConfig, encoder=encoder))
    run = make_run(tmp_path / "study")
    simulator, robot = load_simulator(run, episodes=2, history=1), Robot.of(TABLE.entries[0])
    train, val = (
        open_trajectories(recordings, split, robot, {}, simulator.tokenizer, tmp_path)[0] for split in ("train", "val")
    )
    source = RecordedSource(Training(trajectories=5, seeds=(0,), steps=2, given=2), robot, train, val)
    data = made_where_it_was_stopped(source, simulator, tmp_path, monkeypatch)
    recorded, generated = data["recorded"], data["generated"]
    for i in range(5):
        length = len(train[i])
        assert recorded.lengths[i] == length
        np.testing.assert_array_equal(recorded.images[i, :length], train[i].images)
        low, high = np.array(robot.low * robot.stride), np.array(robot.high * robot.stride)
        whole = train[i].chunks.reshape(length, -1)  # an action is the whole chunk, as it was executed
        np.testing.assert_allclose(recorded.actions[i, :length], np.clip(whole, low, high), rtol=1e-6)
        np.testing.assert_array_equal(generated.images[i, :2], train[i].images[:2])
        assert (generated.images[i, 2:length] != train[i].images[2:]).any((1, 2, 3)).all()
        assert not generated.images[i, length:].any()
    assert (data["shuffled"].images != generated.images).any()
    np.testing.assert_array_equal(data["shuffled"].actions, recorded.actions)
    assert len(data["held_out"]) == 4

    found = run_trial(source, Condition("", 2, 3), data, 0, lambda *_: None)
    assert set(found) == {"error"} and len(found["error"]) == 4
    trials = {(i, 0): {"error": [round((6 - i) * e, 5) for e in found["error"]]} for i in range(PASSIVE)}
    synthetic.write_results((0,), trials, synthetic.quality_of(data, 2), tmp_path)
    assert conditions.read_trials(tmp_path) == trials and not (tmp_path / conditions.TRIALS).exists()
    assert "success" not in (tmp_path / "table.md").read_text()


@pytest.mark.slow
def test_the_second_control_is_a_model_without_actions_which_shows_the_same_under_all(tmp_path):
    run = make_run(tmp_path / "study")
    robot = load_simulator(run, history=1).robot("pusher_sand")
    with pytest.raises(ConfigError, match="setting=forward, not without actions"):
        synthetic.load_passive(run, robot, DecodeConfig())
    passive = make_run(tmp_path / "passive", TrainConfig(masking=MaskingConfig(setting="passive")))
    blind, rng, ones = synthetic.load_passive(passive, robot, DecodeConfig()), np.random.default_rng(0), np.ones(2, int)
    images, acted = rng.integers(0, 256, (2, 4, 8, 8, 3), np.uint8), rng.uniform(-1, 1, (2, 4, 2)).astype(np.float32)
    demos = Demonstrations(images, acted, 4 * ones, np.ones((2, 4), bool), ones > 0, ones)
    shown = [
        synthetic.imagine(blind, robot, replace(demos, actions=a), 1, tmp_path / str(i), lambda *_: None)
        for i, a in enumerate((acted, shuffled_actions(demos)))
    ]
    np.testing.assert_array_equal(*shown)
    assert (shown[0][:, 1:] != images[:, 1:]).any()


def test_the_second_control_is_decoded_as_the_model_that_it_controls(tmp_path, monkeypatch):
    """A model with actions was sampled, as its decode.json said, and the one without, which had none, was greedy."""
    run, out = make_run(tmp_path / "study"), tmp_path / "out"
    passive = make_run(tmp_path / "passive", TrainConfig(masking=MaskingConfig(setting="passive")))
    for where, decode in ((run, DecodeConfig(8, 0.7)), (passive, DecodeConfig(3, 0.2))):
        save_decode(decode, where / DECODE)
    monkeypatch.setattr(synthetic, "BcConfig", partial(BcConfig, encoder=EncoderConfig(size=8, channels=(4, 4, 4))))
    made = []
    monkeypatch.setattr(synthetic, "make_data", lambda *given: made.append((given[1].decode, given[3].decode)) or 1 / 0)
    for asked in ([], ["--temperature", "0.5"]):
        place = ["--out", str(out / str(len(made)))]
        monkeypatch.setattr(sys, "argv", ["synthetic", str(run), "--without-actions", str(passive), *place, *asked])
        with pytest.raises(ZeroDivisionError):
            synthetic.main()
    assert made == [(change_decode(DecodeConfig(8), t),) * 2 for t in (0.0, 0.5)]
    assert json.loads((out / "1/settings.json").read_text())["temperature"] == 0.5


def test_recordings_that_do_not_do_are_refused_before_anything_is_claimed(recordings, tmp_path, monkeypatch):
    run, out = make_run(tmp_path / "study"), tmp_path / "out"
    asked = ["synthetic", str(run), "--actions", recordings, "--out", str(out)]
    for more, said in (
        ([], "split train, has [0-9]+ trajectories, but 100 are needed; give another"),
        (["--given", "0"], "--given must be at least 1, got 0: a generated trajectory begins with"),
        (["--seeds", "0"], "no seed"),
        (["--held-out", "train"], "evaluated on their training data, split train"),
        (["--hold", "4", "--starts", "3"], "--hold, --starts: only for tasks of the suite, not with recordings"),
        (["--robot", "gripper_wood"], "2 action values, but gripper_wood needs 4"),
    ):
        monkeypatch.setattr(sys, "argv", [*asked, *more])
        with pytest.raises(ConfigError, match=said):
            synthetic.main()
        assert [path.name for path in out.iterdir()] == [".lock"]
    monkeypatch.setattr(sys, "argv", ["synthetic", str(run), "--out", str(out), "--split", "train", "--held-out", "a"])
    with pytest.raises(ConfigError, match="--split, --held-out: only for recordings; give these with --actions"):
        synthetic.main()
    (out / "without_actions.json").write_text("{}")
    monkeypatch.setattr(sys, "argv", asked[:2] + asked[4:])
    with pytest.raises(
        ConfigError, match="already has policies of a model without actions: give --without-actions again"
    ):
        synthetic.main()
    monkeypatch.setattr(sys, "argv", ["synthetic", str(run), "--out", str(tmp_path / "small")])
    with pytest.raises(ConfigError, match="policies and success heads need images of 32 x 32 pixels, but 8 x 8"):
        synthetic.main()
    assert [path.name for path in (tmp_path / "small").iterdir()] == [".lock"]


def test_episodes_that_leave_nothing_to_generate_or_to_judge_are_refused():
    with pytest.raises(ConfigError, match="--given 14 must be below the 14 frames of an episode"):
        Settings(given=14)
    with pytest.raises(ConfigError, match="--starts must be at least 1, got 0"):
        Settings(starts=0)
    with pytest.raises(ConfigError, match="no seed"):
        Settings(seeds=())
    with pytest.raises(ConfigError, match="--steps must be at least 1, got 0"):
        Settings(steps=0)
    assert Settings(given=13).given == 13


def test_a_dimension_that_stood_still_in_training_is_not_judged():
    actions = np.zeros((2, 3, 2), np.float32)
    actions[..., 0] = [[0, 1, 2], [2, 1, 0]]
    unknown = np.zeros((2, 3), bool)
    demos = Demonstrations(
        np.zeros((2, 3, 1, 1, 3), np.uint8), actions, np.array([3, 3]), unknown, unknown[:, 0], np.full(2, -1)
    )
    others = replace(demos, actions=actions + np.array([0.0, 0.5], np.float32))

    class Exact:
        def reset(self):
            self.t = -1

        def act(self, images):
            self.t += 1
            return actions[:, self.t]

    np.testing.assert_array_equal(synthetic.action_errors(Exact(), others, scale_of(demos)), 0)


def test_errors_and_pictures_are_compared_over_what_was_recorded_after_the_given_frames():
    """Neither padding nor the given frames, which are the recorded ones, count."""
    lengths, rng = np.array([6, 4, 5]), np.random.default_rng(0)
    counts = np.arange(6) < lengths[:, None]
    images, acted = np.full((3, 6, 8, 8, 3), 100, np.uint8), rng.normal(size=(3, 6, 2)).astype(np.float32)
    recorded = Demonstrations(images, acted, lengths, counts, lengths > 0, lengths)
    made = images + np.where(counts & (np.arange(6) >= 2), 10, 0).astype(np.uint8)[..., None, None, None]
    found = synthetic.quality_of({"recorded": recorded, "generated": replace(recorded, images=made)}, 2)
    assert found == {"generated": pytest.approx([20 * np.log10(255 / 10)] * 3)}

    scale, frames = scale_of(recorded), iter(range(6))
    off = np.where(counts, 2, 99)[..., None] * np.array(scale.std)
    policy = SimpleNamespace(reset=lambda: None, act=lambda _: (t := next(frames), acted[:, t] + off[:, t])[1])
    np.testing.assert_allclose(synthetic.action_errors(policy, recorded, scale), [4, 4, 4], rtol=1e-4)


def test_other_actions_are_another_trajectorys_and_a_shorter_ones_last_is_held():
    demos = demonstrations(0, 3)
    demos = Demonstrations(**{**vars(demos), "actions": demos.actions + np.arange(3)[:, None] / 10})
    demos.lengths[2] = 2
    np.testing.assert_allclose(
        shuffled_actions(demos)[..., 0], [[2, 2.1, 2.1], [0, 0.1, 0.2], [1, 1.1, 1.2]], rtol=1e-6
    )
