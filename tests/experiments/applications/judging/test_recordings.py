"""`hma judge --recordings`, from the command to the page, for a robot that no simulator has."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from data_pipelines.registry import DatasetSpec, get_spec
from experiments.applications.generating.trajectories import (
    Outline,
    RldsTrajectories,
    describe,
    rewards_of_frames,
)
from experiments.applications.judging.agreement import agree, agree_with_counts, mean_above
from experiments.applications.judging.doubts import describe_control, describe_head, describe_recorded_head
from experiments.applications.judging.head import balanced_error
from experiments.applications.judging.outcomes import HEAD, read_outcomes
from experiments.applications.judging.real import read_real
from experiments.applications.judging.recordings import labelled
from experiments.applications.judging.rollouts import load_rollout
from experiments.applications.policies.network import EncoderConfig, random_shift
from experiments.cli.main import main
from hma_jax.config import ConfigError, MaskingConfig, TrainConfig
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.simulator.robots import Robot
from tests.data_pipelines.convert.sources import write_lerobot, write_robomimic
from tests.data_pipelines.fakes import write_rlds
from tests.experiments.applications.runs import make_run

pytestmark = pytest.mark.beside

SPEC = get_spec("berkeley_gnm_cory_hall")
TABLE = EmbodimentTable((Embodiment(SPEC.name, 2, 1, (0.0,) * 2, (1.0,) * 2, low=(-2.0,) * 2, high=(2.0,) * 2),))

POLICIES = """
import numpy as np


class Constant:
    def __init__(self, action):
        self.action = np.array(action)

    def reset(self, episodes=None, *, seeds=None): ...

    def act(self, images):
        return np.repeat(self.action[None], len(images), 0)


def policies(robot):
    return {"low": Constant(robot.low), "high": Constant(robot.high), "wild": Constant([9.0, 9.0])}
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A run of one robot, 20 recordings of which every other one succeeded, and three policies."""
    root = tmp_path_factory.mktemp("own")
    make_run(root, TrainConfig(masking=MaskingConfig(setting="full")), TABLE)
    write_rlds(root, SPEC, [9] * 19 + [4])
    (root / "mine.py").write_text(POLICIES)
    return root


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Networks that look at images of 8 x 8 pixels."""
    monkeypatch.setattr(EncoderConfig.__init__, "__defaults__", (8, (4, 4, 4), 8))


def judge(root, out, *more: str) -> int:
    asked = ["--robot", SPEC.name, "--policies", str(root / "mine.py"), "--recordings", str(root / SPEC.name)]
    return main(["judge", str(root / "model"), *asked, "--out", str(out), "--head-steps", "2", *more])


def said(capsys, error: bool = False) -> str:
    found = capsys.readouterr()
    return " ".join(re.sub("[│╭╮╰╯─]", " ", found.err if error else found.out).split())


def test_from_recordings_to_the_page_without_a_simulator_and_with_counts_of_the_real_robot(
    study, tmp_path, capsys, few_draws
):
    out = tmp_path / "out"
    assert judge(study, out, "--frames", "3") == 0
    told = said(capsys)
    assert "compared with nothing outside the model" in told and "wild (100%)" in told
    assert "Assumed is that no frame of a failure shows it, none of the first half" in told
    assert "and each of the last 2 of a success" in told
    rows = read_outcomes(out / "outcomes.csv")
    policies, starts = (
        ("random", "hma", "low", "high", "wild"),
        4,
    )  # 9 successes, of one too few frames, and 10 failures
    assert {(o.policy, o.start, o.world) for o in rows} == {
        (p, m, w) for p in policies for m in range(starts) for w in ("learned", "shuffled")
    }
    assert {o.judge for o in rows} == {HEAD}
    summary = json.loads((out / "agreement.json").read_text())
    assert summary["compared with"] is None and not summary["agreement"] and summary["task"] == "push"
    head = summary["head"]
    assert (head["unknown"], head["too short"]) == (0, 1)
    assert (head["episodes"], head["successes"], head["learnt from"], head["successes among them"]) == (4, 2, 15, 7)
    page = (out / "judge.html").read_text()
    assert "--split train" in page and not any(flag in page for flag in ("--demonstrations", "--steps", "--cloned"))
    assert "compared with nothing outside the model" in page and "true" not in page.split("<h1>")[1].split("<pre>")[
        0
    ].replace("true simulator", "")
    first = load_rollout(out / "rollouts" / "low.learned.npz")
    assert first.images.shape == (4, 4, 8, 8, 3) and (first.actions == -2).all()

    before = {path: path.stat().st_mtime_ns for path in (out / "rollouts").iterdir()}
    counts = tmp_path / "real.csv"
    counts.write_text("policy,successes,episodes\nlow,1,10\nhigh,9,10\nrandom,0,8\n")
    assert judge(study, out, "--frames", "3", "--real", str(counts)) == 0
    assert before == {path: path.stat().st_mtime_ns for path in (out / "rollouts").iterdir()}
    summary = json.loads((out / "agreement.json").read_text())
    assert summary["compared with"] == "real robot"
    assert list(summary["agreement"]) == ["learned model", "control: actions of other episodes"]
    assert summary["policies"]["high"]["real robot"]["mean"] == 0.9
    assert summary["policies"]["hma"]["real robot"]["mean"] is None
    page = (out / "judge.html").read_text()
    assert "Agreement with the real robot" in page and "nothing outside" not in page and "--real" in page
    assert "agreement with real robot" in said(capsys)


def test_success_by_a_user_s_own_function_takes_the_place_of_the_head(study, tmp_path, capsys, few_draws, monkeypatch):
    monkeypatch.setattr(
        EncoderConfig.__init__, "__defaults__", (32, (4, 4, 4), 8)
    )  # a head could not look at 8 x 8 pixels
    file, out = tmp_path / "told.py", tmp_path / "out"
    file.write_text(POLICIES + "\n\ndef success(images, first):\n    return np.ones(len(images), bool)\n")
    for _ in range(2):  # what is finished is found again
        assert judge(study, out, "--frames", "3", "--policies", str(file)) == 0
        assert "It recognises 2 of 2 successes and 0 of 2 failures" in said(capsys)
    assert [path.name for path in (out / "head").iterdir()] == ["measured.json"]
    assert all(o.success for o in read_outcomes(out / "outcomes.csv"))
    page = (out / "judge.html").read_text()
    assert "That of the file with the policies." in page and "It was trained on" not in page


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--task", "reach"), "--task reach is only for robots with a true simulator"),
        (("--cloned", "2"), "with --recordings there is no scripted expert to train policies on: remove --cloned,"),
        (
            ("--steps", "9", "--demonstrations", "9"),
            "no scripted expert to train policies on: remove --demonstrations, --steps,",
        ),
        (("--split", "val"), "no split 'val'"),
        (
            ("--hold", "7"),
            "of 20 recordings 0 succeeded and 0 failed (0 do not say whether they did, 20 have fewer than the 10 frames",
        ),
        (("--frames", "0"), "--frames must be at least 1, got 0"),
        (("--head-episodes", "15"), "A success head needs at least 8 of each"),
        (("--frames", "1"), "--hold 2 is more than the 1 frames of an episode"),
        (("--real", "nowhere.csv"), "nowhere.csv cannot be read as counts"),
        (("--batch", "1"), "--batch must be at least 2"),
        (("--reward", "1"), "berkeley_gnm_cory_hall/train/0: it has no reward for every step, which --reward needs"),
    ],
)
def test_what_cannot_be_judged_is_refused_before_anything_is_made(study, tmp_path, capsys, more, message):
    assert judge(study, tmp_path / "out", *more) == 2
    assert message in said(capsys, error=True)
    assert not [path for path in tmp_path.glob("out/*") if path.name != ".lock"]


def test_a_misspelt_robot_is_told_those_of_the_model(study, tmp_path, capsys):
    """Before, fifty robots with tasks, none of which the model had."""
    for name, hint in (("berkeley_gnm_cory_hal", f"did you mean {SPEC.name}?"), ("x", f"it has {SPEC.name}")):
        assert main(["judge", str(study / "model"), "--robot", name, "--out", str(tmp_path / "out")]) == 2
        assert f"the model has no robot {name!r}; {hint}" in said(capsys, error=True)
    assert main(["judge", str(study / "model"), "--robot", SPEC.name, "--out", str(tmp_path / "out")]) == 2
    told = said(capsys, error=True)
    assert "has no task" in told and "pusher_sand" not in told


@pytest.mark.parametrize("flag", ["--real", "--registry", "--split", "--reward"])
def test_what_is_of_recordings_is_refused_without_them(tmp_path, capsys, flag):
    asked = ["--robot", "pusher_sand", "--out", str(tmp_path / "out"), flag, "1"]
    assert main(["judge", str(tmp_path / "model"), *asked]) == 2
    assert f"{flag} is only for robots without a true simulator: add --recordings" in said(capsys, error=True)


def test_counts_of_policies_that_are_not_judged_are_refused(study, tmp_path, capsys):
    counts = tmp_path / "real.csv"
    counts.write_text("policy,successes,episodes\nlow,1,10\nhihg,9,10\nrandom,0,8\n")
    assert judge(study, tmp_path / "out", "--real", str(counts)) == 2
    assert "--real has policies hihg, but the policies here are random, hma, low, high, wild" in said(
        capsys, error=True
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "column policy, successes, episodes is missing"),
        ("policy,successes\na,1\n", "column episodes is missing"),
        ("policy,successes,episodes\na,1,\n", "line 2: successes and episodes of a must be whole numbers"),
        ("policy,successes,episodes\na,0.5,1\n", "line 2: successes and episodes of a must be whole numbers"),
        ("policy,successes,episodes\na,1,2\nb,3,2\n", "line 3: b cannot succeed in 3 of 2"),
        ("policy,successes,episodes\na,1,2\n\na,1,2\n", "line 4: a is already in an earlier line"),
        ("policy,successes,episodes\na,1,2\nb,1,2\n", "has 2 policies, but a comparison needs at least 3"),
    ],
)
def test_counts_that_are_none_are_named_to_the_line(tmp_path, text, message):
    path = tmp_path / "real.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_real(path)


def test_counts_are_read_as_a_spreadsheet_saves_them(tmp_path):
    """With a byte order mark, and an end of line of its own."""
    path = tmp_path / "real.csv"
    path.write_bytes("\ufeffpolicy,successes,episodes\r\na,1,2\r\nb,0,2\r\nc,2,2\r\n".encode())
    assert read_real(path) == {"a": (1, 2), "b": (0, 2), "c": (2, 2)}


def test_every_format_says_how_long_a_recording_is_whether_it_succeeded_and_what_the_task_was(tmp_path):
    def move(episode, features):  # as in many Open-X datasets
        features["steps/observation/natural_language_instruction"] = features.pop("steps/language_instruction")

    written = (
        (
            write_lerobot(tmp_path / "toy-arm", "v3.0", camera="image"),
            DatasetSpec("toy_arm", "observation/top", ("action",), (3,), 10),
        ),
        (
            write_robomimic(tmp_path / "image.hdf5", lengths=(5, 23)),
            DatasetSpec("robomimic_lift", "observation/agentview", ("action",), (7,), 20),
        ),
        (write_rlds(tmp_path, SPEC, [5, 8]), SPEC),
        (write_rlds(tmp_path / "moved", SPEC, [5, 8], change=move), SPEC),
    )
    rlds = [(3, False), (4, True)]
    for (place, spec), outlines, task in zip(
        written,
        ([(6, True), (5, False)], [(3, True), (12, False)], rlds, rlds),
        ["push", "Lift", "push", "push"],
        strict=True,
    ):
        zeros = (0.0,) * spec.action_dim
        recorded = RldsTrajectories(str(place), "train", spec, Robot(spec.name, 2, zeros, zeros, zeros), 8)
        assert [recorded.outline(i) for i in range(2)] == [Outline(*one) for one in outlines]
        assert len(recorded[0]) == outlines[0][0] and recorded[0].instructions[0] == task
        assert len(set(recorded.ids().tolist())) == len(recorded)


def test_recordings_of_other_task_texts_are_others(tmp_path):
    """The texts are copied into what is generated from them."""
    place, spec = write_lerobot(tmp_path / "arm", "v2.1"), DatasetSpec("arm", "observation/top", ("action",), (3,), 10)

    def described():
        return describe(RldsTrajectories(str(place), "train", spec, Robot("arm", 2, *[(0.0,) * 3] * 3), 8))

    before, path = described(), place / "meta" / "tasks.jsonl"
    path.write_text(path.read_text().replace("push", "pull"))
    assert described() != before


def test_recordings_are_shown_as_their_entry_corrects_them(tmp_path):
    place, robot = str(write_rlds(tmp_path, SPEC, [5])), Robot(SPEC.name, 2, *[(0.0,) * SPEC.action_dim] * 3)
    corrected = replace(SPEC, image_corrections=("swap_red_blue",))
    plain, swapped = (RldsTrajectories(place, "train", spec, robot, 8) for spec in (SPEC, corrected))
    assert plain[0].images.any() and np.array_equal(swapped[0].images, plain[0].images[..., ::-1])
    assert describe(plain)["image_key"] == SPEC.image_key != describe(swapped)["image_key"]


def test_a_frame_has_the_reward_of_the_action_before_it_and_the_last_one_what_came_after():
    np.testing.assert_array_equal(rewards_of_frames(np.array([0.0, 1, 2, 3, 4]), 1), [np.nan, 0, 1, 2, 4])
    np.testing.assert_array_equal(rewards_of_frames(np.array([0.0, 1, 2, 3, 4, 9, 5]), 3), [np.nan, 2, 9])
    np.testing.assert_array_equal(rewards_of_frames(np.array([0.5]), 3), [np.float32(0.5)])


def test_rewards_are_read_in_every_format_that_has_them(tmp_path):
    zeros = (0.0,) * 7
    rlds = write_rlds(tmp_path, SPEC, [4, 4], rewards=lambda i: np.arange(i, i + 4))
    without = write_rlds(tmp_path / "without", SPEC, [4])
    lerobot = write_lerobot(tmp_path / "toy-arm", "v3.0", camera="image")
    robomimic = write_robomimic(tmp_path / "image.hdf5", lengths=(5, 23))
    written = (
        (lerobot, DatasetSpec("toy_arm", "observation/top", ("action",), (3,), 10), [1.0, 1.0]),
        (robomimic, DatasetSpec("robomimic_lift", "observation/agentview", ("action",), (7,), 20), [1.0, 0.0]),
        (rlds, SPEC, [3.0, 4.0]),
        (without, SPEC, [None]),
    )
    for place, spec, last in written:
        own = zeros[: spec.action_dim]
        recorded = RldsTrajectories(str(place), "train", spec, Robot(spec.name, 2, own, own, own), 8)
        rewards = [recorded.rewards(i) for i in range(len(last))]
        assert [None if r is None else r[-1] for r in rewards] == last
        assert all(len(r) == recorded.outline(i).frames for i, r in enumerate(rewards) if r is not None)


@pytest.mark.slow
def test_rewards_teach_the_head_at_every_frame_and_say_what_succeeded(study, tmp_path, capsys, few_draws):
    """Whatever the flag of success says: of these 20 the first 10 stay at the goal, seven of them from the first frame
    on, three from their fifth. Policies begin where it is not reached yet."""
    begin = [0] * 7 + [3] * 3
    written = write_rlds(tmp_path, SPEC, [9] * 20, rewards=lambda i: (i < 10) * (np.arange(9) >= begin[i % 10]))
    out, asked = tmp_path / "out", ("--recordings", str(written), "--frames", "3", "--reward")
    assert judge(study, out, *asked, "1") == 0
    head = json.loads((out / "agreement.json").read_text())["head"]
    assert (head["successes"], head["learnt from"], head["successes among them"]) == (2, 16, 8)
    # From the third frame on: of one held-out success two without the goal, then five at it; of the other seven.
    assert head["frames"] == 4 * 7 and head["positive"] == pytest.approx((5 + 7) / 28)
    assert load_rollout(out / "rollouts" / "low.learned.npz").images.shape[0] == 3
    assert "--reward 1.0" in (out / "judge.html").read_text() and "Assumed is" not in said(capsys)
    assert judge(study, tmp_path / "none", *asked, "2") == 2
    assert "of 20 recordings 0 succeeded and 20 failed" in said(capsys, error=True)
    always = write_rlds(tmp_path / "all", SPEC, [9] * 20, rewards=lambda i: np.r_[np.ones(3), np.full(6, i < 10)])
    assert judge(study, tmp_path / "none", "--recordings", str(always), *asked[2:], "1") == 2
    assert "0 of 4 held-out recordings have not yet reached the goal (--reward 1.0) at frame" in said(capsys, True)


def test_between_the_first_half_and_the_last_frames_of_a_success_nobody_knows():
    frames, reached = labelled(9, True, 2)
    assert frames.tolist() == [0, 1, 2, 3, 7, 8] and reached.tolist() == [False] * 4 + [True] * 2
    frames, reached = labelled(5, False, 2)
    assert frames.tolist() == [0, 1, 2, 3, 4] and not reached.any()
    frames, reached = labelled(3, True, 2)
    assert frames.tolist() == [0, 1, 2] and reached.tolist() == [False, True, True]


def test_a_pair_of_frames_is_moved_as_one():
    frames = np.random.default_rng(0).random((32, 1, 8, 8, 3)).repeat(2, 1)
    found = np.asarray(random_shift(frames, jax.random.key(0), 2))
    np.testing.assert_array_equal(found[:, 0], found[:, 1])
    same = (found[:, 0, 2:6, 2:6] == frames[:, 0, 2:6, 2:6].astype(np.float32)).all((1, 2, 3))
    inside = [
        (frame[y : y + 4, x : x + 4] == at[0, 2:6, 2:6]).all()
        for frame, at in zip(frames[:, 0].astype(np.float32), found, strict=True)
        for y in range(5)
        for x in range(5)
    ]
    assert same.mean() < 0.3 and sum(inside) == 32
    assert random_shift(frames, jax.random.key(0), 0) is frames


def test_the_head_of_the_step_that_is_best_on_other_recordings_is_taken():
    """Not the last one, which knows its own by heart."""
    seen, labels = np.zeros((4, 2, 8, 8, 3), np.uint8), np.array([True, False, False, False])
    heads = {
        step: SimpleNamespace(predict_pairs=lambda pairs, p=p: np.array(p, np.float32))
        for step, p in ((50, (0.5, 0.5, 0.5, 0.5)), (60, (0.8, 0.3, 0.2, 0.1)), (70, (0.0, 0.0, 0.0, 0.0)))
    }
    errors = {step: balanced_error(head, seen, labels) for step, head in heads.items()}
    assert min(errors, key=errors.get) == 60 and errors[50] == pytest.approx(np.log(2))


def test_few_episodes_of_the_real_robot_leave_more_doubt_than_many():
    learned = np.random.default_rng(0).random((6, 50)) < np.linspace(0.1, 0.9, 6)[:, None]
    few, many = (agree_with_counts(n * np.arange(1, 7) // 7, np.full(6, n), learned, draws=200) for n in (7, 700))
    spread = [found.over_starts["pearson"].high - found.over_starts["pearson"].low for found in (few, many)]
    assert few.measures["pearson"].mean == pytest.approx(many.measures["pearson"].mean) and spread[0] > 2 * spread[1]
    assert agree(learned, learned, draws=20).over_starts["pearson"].low == pytest.approx(1)


def test_success_that_does_not_hang_on_what_policies_do_is_told():
    rng = np.random.default_rng(0)
    control, learned = rng.random((4, 30)) < 0.5, rng.random((4, 30)) < 0.5
    same, better = (
        mean_above(learned, control, draws=200),
        mean_above(learned | (rng.random((4, 30)) < 0.6), control, draws=200),
    )
    assert same.low < 0 < same.high and 0 < better.low < better.mean < better.high
    told = [
        describe_control({"above the control": {"mean": x.mean, "low": x.low, "high": x.high}}) for x in (same, better)
    ]
    assert "not known that policies succeed more often in the model than in the control" in told[0] and told[1] == ""
    unsure = {"above the control": {"mean": 0.3, "low": -0.02, "high": 0.6}}
    assert "the difference is 0.30 (-0.02 to 0.60) on average" in describe_control(unsure), (
        "few starts are no proof of the contrary"
    )


def test_a_head_that_is_no_better_than_always_saying_the_same_is_told():
    measured = {
        "episodes": 20.0, "successes": 10.0, "successes told": 9.0, "failures told": 10.0, "learnt from": 60.0,
        "episode accuracy, decoded": 0.9, "successes among them": 30.0, "unknown": 0.0, "too short": 1.0,
    }  # fmt: skip
    assert "9 of 10 successes and 10 of 10 failures: 0.95" in describe_recorded_head(measured)
    assert "do not trust" not in describe_recorded_head(measured)
    assert (
        "do not trust" in describe_recorded_head(measured | {"failures told": 3.0}) and describe_recorded_head({}) == ""
    )


def test_whoever_tells_success_no_better_than_always_the_same_is_told():
    measured = {"positive": 0.3, "frame accuracy": 0.71, "frame AUROC": 0.6, "episodes": 40.0, "episode accuracy": 0.7}
    said = [describe_head({"head": measured | {"frame accuracy": x}, "own success": True}) for x in (0.71, 0.7)]
    assert all("The more frequent label is right for 0.700 of the frames" in one for one in said)
    assert "do not trust" not in said[0] and "do not trust" in said[1]
