"""`hma judge` with a model that has learnt nothing: what it writes, and how it goes on."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.applications.judging import judge
from experiments.applications.judging.blind import compare_labels, read_labels, write_blind
from experiments.applications.judging.config import JudgeConfig
from experiments.applications.judging.doubts import describe_clipping
from experiments.applications.judging.ground_truth import SimulatedTruth
from experiments.applications.judging.head import PIECE, HeadConfig, HeadJudge, load_head
from experiments.applications.judging.judge import judge_run
from experiments.applications.judging.ladder import LadderConfig, names
from experiments.applications.judging.outcomes import HEAD, LEARNED, STATE, TRUE, Outcome, read_outcomes, write_outcomes
from experiments.applications.judging.page import write_page
from experiments.applications.judging.rollouts import run
from experiments.applications.judging.scatter import draw_scatter
from experiments.applications.judging.summary import COLUMNS, summarise
from experiments.applications.policies import find_task
from experiments.applications.policies.kinds import KINDS
from experiments.applications.policies.learning import FitConfig
from experiments.applications.policies.network import EncoderConfig
from experiments.cli.main import main
from hma_jax.config import ConfigError, MaskingConfig, TrainConfig
from hma_jax.convert.run_directory import write_run
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.tokenizers.io import save_tokenizer
from hma_jax.training.runs import Run
from tests.hma_jax.simulator.small import CONFIG, parts

pytestmark = pytest.mark.beside

SMALL = EncoderConfig(8, (4, 4, 4), 8)
ASKED = JudgeConfig(
    find_task("gripper_wood", frames=2, hold=1),
    starts=4,
    batch=2,
    demonstrations=4,
    demonstration_frames=4,
    ladder=LadderConfig(cloned=2, diffusion=0, steps=3, first=1, batch=2, encoder=SMALL),
    head=HeadConfig(encoder=SMALL, fit=FitConfig(steps=2, batch=4)),
    head_episodes=12,
)


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    root, tokenizer = tmp_path_factory.mktemp("study"), parts()[1]
    save_tokenizer(tokenizer, root / "tokenizer")
    table = EmbodimentTable((Embodiment("gripper_wood", 4, 1, (0.0,) * 4, (0.2,) * 4),))
    train = TrainConfig(masking=MaskingConfig(setting="full"))
    run = Run(CONFIG, train, table, declare_model(CONFIG, table).init(0), 0, {"tokenizer": tokenizer.identity})
    write_run(run, root / "model")
    return root, judge_run(root / "model", root / "out", ASKED)


def test_every_policy_is_judged_at_every_start_in_every_world(judged):
    _, found = judged
    assert found.policies == ("random", "cloned-1", "cloned-3", "hma") == (*names(ASKED.ladder), "hma")
    rows = {(o.policy, o.start, o.world, o.judge) for o in found.outcomes}
    assert len(rows) == len(found.outcomes) == 4 * 4 * 4
    assert {o.world for o in found.outcomes if o.judge == STATE} == {TRUE}
    a, b = (found.rollouts("cloned-3", world) for world in (TRUE, LEARNED))
    assert a.images.shape == b.images.shape == (4, 3, 8, 8, 3)
    assert not np.array_equal(a.images[:, 1:], b.images[:, 1:])
    control = found.rollouts("random", "shuffled")
    np.testing.assert_array_equal(control.actions[[1, 0]], found.rollouts("random", TRUE).actions[:2])


def test_every_start_has_its_own_seed_in_whichever_batch_it_is():
    """Else policies and the model drew the same in every batch."""
    asked, black = [], np.zeros((2, 8, 8, 3), np.uint8)

    class Black:
        rate = "model"

        def __len__(self):
            return 2

        def reset(self, starts, seeds):
            asked.append((starts, seeds))
            return black

        def step(self, actions):
            return black

    policy = SimpleNamespace(reset=lambda seeds: asked.append(seeds), act=lambda images: np.zeros((2, 4)))
    run(Black(), policy, ["a", "b", "c", "d"], [1, 2, 3, 4], ASKED.task)
    assert asked == [[1, 2], (["a", "b"], [1, 2]), [3, 4], (["c", "d"], [3, 4])]


@pytest.mark.parametrize(("name", "least"), [("demonstrations", 1), ("head_episodes", 3), ("batch", 2)])
def test_what_is_too_little_to_judge_by_is_refused_before_policies_are_trained(name, least):
    assert replace(ASKED, **{name: least})
    with pytest.raises(ConfigError, match=f"--{name.replace('_', '-')} must be at least {least}"):
        replace(ASKED, **{name: least - 1})


@pytest.mark.parametrize(("hold", "lasts", "frames"), [(2, 6, 4), (3, 6, 6), (5, 6, 6), (3, 3, 4)])
def test_demonstrations_are_as_long_as_the_task_where_little_is_left_of_them_to_reach_the_goal(hold, lasts, frames):
    task = find_task("gripper_wood", frames=lasts, hold=hold)
    robot = SimpleNamespace(name="gripper_wood", action_dim=4, stride=1)
    learned = SimpleNamespace(tokenizer=SimpleNamespace(image_size=8))
    truth = SimulatedTruth(replace(ASKED, task=task), robot, learned)
    assert truth.demonstrations().actions.shape[1] == frames


@pytest.mark.parametrize("kind", KINDS)
def test_a_negative_number_of_checkpoints_is_not_taken_for_one(kind):
    assert names(replace(ASKED.ladder, **{kind: 0}))
    with pytest.raises(ConfigError, match=f"--{kind} must not be negative, got -1"):
        replace(ASKED.ladder, **{kind: -1})


@pytest.mark.parametrize(("first", "beyond"), [(0, -1), (2**32 - 4, 2**32 - 3)])
def test_seeds_that_no_episode_can_have_are_refused_before_policies_are_trained(first, beyond):
    assert replace(ASKED, seed=first)
    with pytest.raises(ConfigError, match=f"--seed must lie in 0..{2**32 - 4}, got {beyond}"):
        replace(ASKED, seed=beyond)


def test_the_random_policy_alone_is_not_judged(tmp_path, monkeypatch):
    """For a quarter of an hour, since --policies was forgotten. Action heads that nothing was trained for are none."""
    model = parts()[0]
    assert model.config.action_heads and model.run.train.masking.setting == "forward"
    monkeypatch.setattr(judge, "load_simulator", lambda *_, **__: SimpleNamespace(model=model))
    alone = replace(ASKED, ladder=replace(ASKED.ladder, cloned=0))
    with pytest.raises(ConfigError, match="no policy to evaluate except the random one: give --policies FILE"):
        judge_run(tmp_path / "model", tmp_path / "out", alone)


def test_what_is_finished_is_found_again_and_the_rest_comes_out_the_same(judged):
    root, found = judged
    lost = root / "out" / "rollouts" / "cloned-3.learned.npz"
    kept = root / "out" / "rollouts" / "random.learned.npz"
    before, images = kept.stat().st_mtime_ns, found.rollouts("cloned-3", LEARNED).images
    lost.unlink()
    again = judge_run(root / "model", root / "out", ASKED)
    assert kept.stat().st_mtime_ns == before
    np.testing.assert_array_equal(again.rollouts("cloned-3", LEARNED).images, images)
    assert again.outcomes == found.outcomes
    with pytest.raises(ConfigError, match="other settings .config.starts: 4 -> 2"):
        judge_run(root / "model", root / "out", replace(ASKED, starts=2))


OWN = """
import numpy as np


class Still:
    def reset(self, episodes=None, *, seeds=None): ...

    def act(self, images):
        return np.full((len(images), 4), {value})


def policies(robot):
    return {{"still": Still()}}
"""


def test_policies_of_ones_own_are_judged_beside_the_random_one_and_told_from_changed_ones(judged, tmp_path):
    root, before = judged
    out, file = tmp_path / "out", tmp_path / "mine.py"
    file.write_text(OWN.format(value=0.0))
    shutil.copytree(root / "out" / "head", out / "head")  # what is the same in any judgement of this seed
    for kept in (p for p in (root / "out" / "rollouts").iterdir() if p.name.startswith(("random.", "hma."))):
        (out / "rollouts").mkdir(exist_ok=True)
        shutil.copy(kept, out / "rollouts" / kept.name)
    alone = replace(ASKED, ladder=replace(ASKED.ladder, cloned=0))
    found = judge_run(root / "model", out, alone, file)
    assert found.policies == ("random", "hma", "still") and found.user_policies == ("still",)
    assert not (out / "policies").exists() and (out / "own_policies.py").read_text() == file.read_text()
    assert (found.rollouts("still", TRUE).actions == 0).all()
    assert found.clipped["still"] == 0
    assert [o for o in found.outcomes if o.policy == "random"] == [o for o in before.outcomes if o.policy == "random"]

    kept = out / "rollouts" / "still.learned.npz"
    kept.unlink()
    again = judge_run(root / "model", out, alone, file)
    assert again.outcomes == found.outcomes and kept.exists()
    file.write_text(OWN.format(value=9.0))
    with pytest.raises(ConfigError, match="other settings .contents of --policies: '[0-9a-f]+' -> '[0-9a-f]+'"):
        judge_run(root / "model", out, alone, file)


def test_actions_in_other_units_are_told():
    said = {"robot": "arm", "own": ["a", "b"], "actions beyond the range": {"a": 0.5, "b": 0.05, "random": 1.0}}
    assert "outside what arm was ever given, and were clipped to it: of a (50%)." in describe_clipping(said)
    assert not describe_clipping(said | {"own": ["b"]})


def test_a_policy_without_right_actions_is_refused_before_anything_is_made(judged, tmp_path):
    root, file = judged[0], tmp_path / "mine.py"
    file.write_text(OWN.format(value="0"))
    with pytest.raises(ConfigError, match=r"mine.py: policy 'still': .*float32 \[2, 4\].* it returned int64 \[2, 4\]"):
        judge_run(root / "model", tmp_path / "out", ASKED, file)
    file.write_text(OWN.format(value="images.widht"))
    with pytest.raises(
        ConfigError, match=r"mine.py, line 9: AttributeError: 'numpy.ndarray' object has no attribute 'widht'"
    ):
        judge_run(root / "model", tmp_path / "out", ASKED, file)
    assert not (tmp_path / "out").exists()


def test_frames_that_no_policy_could_look_at_are_refused_before_anything_is_recorded(judged):
    root = judged[0]
    for part in ("ladder", "head"):
        larger = replace(ASKED, **{part: replace(getattr(ASKED, part), encoder=EncoderConfig())})
        with pytest.raises(ConfigError, match="policies and success heads need images of 32 x 32 pixels, but 8 x 8"):
            judge_run(root / "model", root / "small", larger)
    assert not (root / "small").exists()


def test_table_summary_and_page(judged, few_draws):
    root, found = judged
    out = root / "out"
    write_outcomes(found.outcomes, out / "outcomes.csv")
    assert read_outcomes(out / "outcomes.csv") == list(found.outcomes)
    summary = summarise(found)
    assert list(summary["policies"]["random"]) == list(COLUMNS)
    head = summary["agreement"]["the head alone, on true frames"]["starts"]["bias"]
    assert head["low"] <= head["mean"] <= head["high"]
    draw_scatter(summary, out / "scatter.png")
    page = write_page(found, summary, out, "hma judge").read_text()
    assert page.count("<figure class=trio>") == 4 == page.count("<figure class=strip>"), "the latter on paper"
    assert "cloned-3" in page and "http" not in page
    assert ">Pearson</th>" in page and "<em>bias</em>: success rate minus the true one" in page
    assert "<em>true, by state</em>: in the true simulator" in page and "after N training steps" in page


def test_labels_of_a_person_are_compared_with_the_judges(judged, tmp_path, capsys):
    root, found = judged
    page = write_blind(found, root / "out", clips=10).read_text()
    assert page.count("<img") == 10 and not any(name in page for name in ("cloned", "random", LEARNED))
    key = json.loads((root / "out" / "blind.json").read_text())
    said = {(o.policy, o.world, o.start): o.success for o in found.outcomes if o.judge == HEAD}
    labels = {str(n): said[tuple(clip)] for n, clip in enumerate(key["clips"])}
    path = tmp_path / "labels.json"
    path.write_text(json.dumps({"page": key["page"], "labels": labels}))
    agreed = compare_labels(read_labels(path, root / "out"), found.outcomes)
    assert agreed["head, learned world"].mean == 1 == agreed["head, true world"].mean
    write_outcomes(found.outcomes, root / "out" / "outcomes.csv")
    asked = ["--robot", "any", "--out", str(root / "out"), "--starts", "3", "--labels", str(path)]
    assert main(["judge", str(tmp_path / "nowhere"), *asked]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "1.00" in told and "nothing was evaluated again, and all other options were ignored" in told
    path.write_text(json.dumps({"page": "another", "labels": labels}))
    with pytest.raises(ConfigError, match="labels of another page"):
        read_labels(path, root / "out")


@pytest.mark.parametrize("content", ["[]", "null", "{", '{"labels": []}'])
def test_what_is_no_file_of_labels_is_said(content, tmp_path):
    """A list ended in a traceback."""
    (tmp_path / "labels.json").write_text(content)
    (tmp_path / "blind.json").write_text('{"page": "mine", "clips": []}')
    with pytest.raises(ConfigError, match=r"labels\.json cannot be read as labels of .*blind\.html"):
        read_labels(tmp_path / "labels.json", tmp_path)


def test_labels_that_are_not_there_and_a_directory_without_results_are_said(tmp_path):
    with pytest.raises(ConfigError, match=f"^{tmp_path} holds no results of `hma judge`"):
        read_labels(tmp_path / "labels.json", tmp_path)
    (tmp_path / "blind.json").write_text("{}")
    with pytest.raises(ConfigError, match=r"labels\.json: no such file; give the file that the page"):
        read_labels(tmp_path / "labels.json", tmp_path)


def test_outcomes_that_were_cut_short_are_said(tmp_path):
    path = tmp_path / "outcomes.csv"
    write_outcomes([Outcome("mine", 0, 1, 2, TRUE, HEAD, True)], path)
    path.write_text(path.read_text() + "mine,1")
    with pytest.raises(ConfigError, match=r"outcomes\.csv cannot be read as outcomes .*; run `hma judge` again"):
        read_outcomes(path)


@pytest.mark.usefixtures("ascii_locale")
def test_names_of_policies_are_read_in_any_locale(tmp_path):
    made = [Outcome("größer", 0, 1, 2, TRUE, HEAD, True)]
    write_outcomes(made, tmp_path / "outcomes.csv")
    assert read_outcomes(tmp_path / "outcomes.csv") == made


def test_the_head_judges_environments_and_forgets_with_them(judged):
    head = load_head(judged[0] / "out" / "head")
    assert set(head.measured) >= {"frame accuracy", "frame AUROC", "episode accuracy"}
    judge, simulator = HeadJudge(head, hold=2), Showing(0, 0)
    head.reached = brighter
    with pytest.raises(ConfigError, match="no episode has begun"):
        judge(simulator)
    judge.begin(simulator, [0, 1])
    done = [judge(simulator.show(*f))[1].tolist() for f in ([1, 0], [1, 1], [1, 0], [0, 1], [1, 1])]
    assert done == [[False, False], [True, False], [True, False], [False, False], [False, True]]
    judge.begin(simulator.show(1, 0), [0])
    assert judge(simulator.show(1, 1))[1].tolist() == [False, True]
    assert judge(simulator)[1].tolist() == [False, True]


def test_a_head_looks_at_a_few_frames_without_looking_at_many(judged):
    head, rng = load_head(judged[0] / "out" / "head"), np.random.default_rng(0)
    pairs, apply, looked_at = rng.integers(0, 256, (PIECE + 1, 2, 8, 8, 3), np.uint8), head._apply, []

    def looking(params, frames):
        looked_at.append(len(frames))
        return apply(params, frames)

    head._apply = looking
    few, one, many = head.predict_pairs(pairs[:3]), head.predict_pairs(pairs[:1]), head.predict_pairs(pairs)
    assert looked_at == [4, 1, PIECE, PIECE] and len(many) == PIECE + 1
    np.testing.assert_allclose(few, many[:3], rtol=1e-5)
    np.testing.assert_allclose(one, many[:1], rtol=1e-5)


def brighter(images: np.ndarray, first: np.ndarray) -> np.ndarray:
    """What a head takes for reached."""
    return images[:, 0, 0, 0] > first[:, 0, 0, 0]


class Showing:
    """A simulator that shows a grey level in each episode."""

    def __init__(self, *levels: int):
        self.show(*levels)

    def show(self, *levels: int):
        self.images = np.broadcast_to(np.array(levels)[:, None, None, None], (len(levels), 8, 8, 3))
        return self


def test_simulators_that_share_a_judge_do_not_disturb_each_other():
    judge = HeadJudge(SimpleNamespace(reached=brighter), hold=2)
    trained, evaluated = Showing(0, 3), Showing(2)
    judge.begin(trained, [0, 1])
    judge.begin(evaluated, [0])
    judge(trained.show(1, 3))
    assert judge(evaluated.show(1))[1].tolist() == [False]
    judge.begin(evaluated.show(0), [0])
    assert judge(trained)[1].tolist() == [True, False]
    del evaluated
    assert len(judge._states) == 1, "what is kept of a simulator goes with it"
