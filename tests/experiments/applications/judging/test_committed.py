"""The judgements that are committed: table, summary and docs/judging.md say the same."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from experiments.applications.judging.agreement import DRAWS, pearson, rate_interval, share, spearman
from experiments.applications.judging.outcomes import read_outcomes, successes
from experiments.applications.judging.rollouts import make_starts
from experiments.applications.judging.summary import COLUMNS, COMPARED, CONTROL, MODEL, REFERENCE, shown
from experiments.applications.judging.true_rates import draw_rates, noise_of_starts
from experiments.applications.policies import find_task, record
from experiments.applications.policies.tasks import held, world_of
from experiments.simulators import true_worlds
from hma_jax.simulator.folder import DEFAULT_DECODE, find_decode
from hma_jax.simulator.robots import Robot
from tests.pages import rows_below, table

ROOT = Path(__file__).parents[4]
PAGE = ROOT / "docs" / "judging.md"
RESULTS = sorted((ROOT / "experiments" / "results").glob("judge-*"))
OUTCOMES = re.compile(r"results/judge-([\w-]+)/outcomes\.csv")
POLICIES, AGREEMENT = "| policy | true, by state |", "| compared with the true world, by state |"


def summary_of(name: str) -> dict:
    return json.loads((ROOT / "experiments" / "results" / f"judge-{name}" / "agreement.json").read_text())


def rates_of(name: str) -> tuple[list[str], dict[str, np.ndarray]]:
    """(policies, {column: successes [P, M]})."""
    outcomes, names = (
        read_outcomes(ROOT / f"experiments/results/judge-{name}/outcomes.csv"),
        list(summary_of(name)["policies"]),
    )
    return names, {column: successes(outcomes, names, *where) for column, where in COLUMNS.items()}


def tables_of_page() -> Iterator[tuple[str, str, dict[str, list[str]]]]:
    """(judgement whose outcomes are linked last above it, header, rows) of each table of policies and of agreements."""
    name, lines = "", PAGE.read_text().splitlines()
    for i, line in enumerate(lines):
        name = (OUTCOMES.findall(line) or [name])[-1]
        for header in (POLICIES, AGREEMENT):
            if line.startswith(header):
                yield name, header, rows_below(lines[i:])


@pytest.mark.parametrize("directory", RESULTS, ids=lambda path: path.name)
def test_the_summary_is_that_of_the_table(directory):
    name = directory.name.removeprefix("judge-")
    summary, (names, each) = summary_of(name), rates_of(name)
    for i, policy in enumerate(names):
        for column, found in each.items():
            assert summary["policies"][policy][column]["mean"] == pytest.approx(rate_interval(found[i]).mean, abs=1e-4)
    same = each[MODEL] == each[REFERENCE]
    for kind, among in (
        ("all episodes", same | ~same), ("those that truly succeed", each[REFERENCE]),
        ("those that truly fail", ~each[REFERENCE]),
    ):  # fmt: skip
        alike = share(same, among)
        assert summary["episodes alike"][kind] == {
            key: pytest.approx(getattr(alike, key), abs=1e-4) for key in ("mean", "low", "high")
        }
    true = each[REFERENCE].mean(1)
    for kind, column in COMPARED.items():
        agreed, rates = summary["agreement"][kind]["policies and starts"], each[column].mean(1)
        if agreed["pearson"]["mean"] is not None:
            assert agreed["pearson"]["mean"] == pytest.approx(pearson(true, rates), abs=1e-4)
            assert agreed["spearman"]["mean"] == pytest.approx(spearman(true, rates), abs=1e-4)
        alone = summary["agreement"][kind]["starts"]["pearson"]
        if alone["mean"] is not None:
            noise = noise_of_starts(each[REFERENCE], each[column])
            drawn = [pearson(*pair.T) for pair in draw_rates(np.stack([true, rates], 1), noise, DRAWS)]
            low, high = np.quantile(drawn, [0.025, 0.975])
            assert alone["low"] == pytest.approx(min(low, alone["mean"]), abs=5e-3)
            assert alone["high"] == pytest.approx(max(high, alone["mean"]), abs=5e-3)


def test_the_page_shows_every_judgement_that_is_kept():
    rows, kept = table(PAGE, "| what is judged, in which model |"), set()
    for label, cells in rows.items():
        (name,) = OUTCOMES.findall(label)
        kept.add(f"judge-{name}")
        summary = summary_of(name)
        of = {kind: summary["agreement"][kind]["policies and starts"] for kind in COMPARED}
        model, control = of["learned model"], of["control: actions of other episodes"]["pearson"]["mean"]
        alike = [summary["episodes alike"][f"those that truly {what}"] for what in ("succeed", "fail")]
        assert cells == [
            shown(model["pearson"]),
            "–" if control is None else f"{control:.2f}",
            shown(model["bias"]),
            *("{:.0f} % ({:.0f} to {:.0f})".format(*(100 * x[key] for key in ("mean", "low", "high"))) for x in alike),
        ], name
    assert kept == {path.name for path in RESULTS}


def test_the_page_shows_policies_and_agreements_below_the_link_to_their_outcomes():
    seen = set()
    for name, header, rows in tables_of_page():
        summary = summary_of(name)
        seen.add((name, header))
        if header == POLICIES:
            means = {policy: [of[column]["mean"] for column in COLUMNS] for policy, of in summary["policies"].items()}
            assert rows == {policy: [f"{x:.2f}" for x in each] for policy, each in means.items()}, name
        else:
            agreed = {kind: summary["agreement"][kind]["policies and starts"] for kind in COMPARED}
            measures = ("pearson", "spearman", "rank violation")
            assert rows == {kind: [shown(of[m]) for m in measures] for kind, of in agreed.items()}, name
    detailed = "pusher_sand-reach-grown", "arm_chalk-reach-grown", "metaworld_drawer"
    assert seen == {(name, header) for name in detailed for header in (POLICIES, AGREEMENT)}


def test_what_is_said_of_judgements_without_a_table_follows_from_their_outcomes():
    page = " ".join(PAGE.read_text().split())
    starts = [summary_of(f"{robot}-reach")["agreement"]["learned model"]["starts"]["pearson"] for robot in ROBOTS]
    assert "starts alone Pearson's correlation is {} for the pusher, {} for the arm".format(*map(shown, starts)) in page
    _, each = rates_of("metaworld_drawer-without_actions")
    (count,) = {*each[MODEL].sum(1), *each[CONTROL].sum(1)}
    assert f"in {count} of 50 episodes for a random policy as for the best: all rates are {count / 50:.2f}" in page
    (_, carried), (_, reached) = rates_of("gripper_wood-carry"), rates_of("gripper_wood-reach")
    fooled = carried["true, by head"][~carried[REFERENCE]].mean()
    assert f"calls {100 * fooled:.0f} % of the true failures successes" in page
    *others, best = sorted(carried[REFERENCE].mean(1))
    assert (
        f"the best succeeds in {100 * best:.0f} % of episodes, all others in {100 * others[0]:.0f} to {100 * others[-1]:.0f},"
        in page
    )
    few = 100 * reached[REFERENCE].mean(1)
    said = f"truly succeed in {few.min():.0f} to {few.max():.0f} % of episodes, and the model shows a tenth of these"
    assert said in page
    assert reached[MODEL][reached[REFERENCE]].mean() == pytest.approx(0.1, abs=0.005)
    for name, accuracy in (
        ("gripper_wood-carry", "74 %"),
        ("gripper_wood-reach", "57 %"),
        ("gripper_wood-hover-grown", "97 %"),
    ):
        assert f"{100 * summary_of(name)['head']['frame accuracy']:.0f} %" == accuracy
        assert f"right in {accuracy} of held-out frames" in page


def test_what_the_expert_can_do_is_as_the_page_says():
    page = " ".join(PAGE.read_text().split())
    worst, most, fewest, hard = (
        f"{100 * record(find_task(robot, task), 50, noise=0.0, image_size=8).successes.mean():.0f}"
        for robot, task in (
            ("arm_chalk", "reach"), ("gripper_night", "own"), ("arm_sand", "own"), ("arm_chalk", "own"),
        )
    )  # fmt: skip
    assert f"reaches the mark in {worst} to 100 % of 50 true episodes" in page
    assert f"two grippers in {most} and 100 %" in page and f"in {fewest} to {hard} %." in page


@pytest.mark.slow
def test_a_gripper_that_keeps_still_carries_the_puck_from_no_start():
    task = find_task("gripper_wood")
    starts = make_starts(task, 50, 8, 1)
    outcomes = read_outcomes(ROOT / "experiments/results/judge-gripper_wood-carry/outcomes.csv")
    assert {(o.start, o.number) for o in outcomes} == set(enumerate(start.seed for start in starts))
    simulator = true_worlds([Robot(task.robot, 1, (-9.0,) * 4, (9.0,) * 4, (0.0,) * 4)], episodes=50, image_size=8)
    simulator.reset(starts)
    world = world_of(task.spec, [simulator.state(b) for b in range(50)])
    still = np.concatenate([c.encode(world.body, world.q, world.q, world.dt) for c in task.spec.controls], 1)
    reached = []
    for _ in range(task.frames):
        world.step(still)
        reached.append(world.success())
    assert not held(np.stack(reached, 1), task.hold).any()
    assert "a gripper that keeps still succeeds from none" in " ".join(PAGE.read_text().split())


def test_how_each_model_is_decoded_is_as_the_page_says():
    decoded = {
        name: find_decode(ROOT / "experiments" / "results" / name)
        for name in ("simulator", "simulator_weighed", "simulator_grown")
    }
    assert {name: decode.temperature for name, decode in decoded.items()} == {
        "simulator": 0.7, "simulator_weighed": 0.7, "simulator_grown": 0.0,
    }  # fmt: skip
    assert {decode.unmask_steps for decode in decoded.values()} == {8}
    assert (DEFAULT_DECODE.temperature, DEFAULT_DECODE.unmask_steps) == (0.0, 2)
    page = " ".join(PAGE.read_text().split())
    said = 'greedily unless its row says otherwise, "first" and "weighed" at temperature 0.7, all with 8 unmasking'
    assert said in page
    assert (
        "Models without a decode.json, as `hma train` leaves them, are decoded greedily with 2 unmasking steps" in page
    )


ROBOTS = "pusher_sand", "arm_chalk"


@pytest.mark.parametrize("robot", ROBOTS)
def test_another_seed_came_as_the_page_says(robot):
    """And within what had been expected."""
    page = PAGE.read_text()
    for name, label in (("pearson", "Pearson"), ("bias", "bias")):
        first, other = (
            json.loads((ROOT / "experiments" / "results" / f"judge-{robot}-reach-{run}" / "agreement.json").read_text())
            ["agreement"]["learned model"]["policies and starts"][name]["mean"]
            for run in ("weighed", "seed1")
        )  # fmt: skip
        (line,) = [line for line in page.splitlines() if line.startswith(f"| {label}, `{robot}` |")]
        expected, came, before = (cell.strip() for cell in line.strip("|").split("|")[1:])
        low, high = map(float, expected.partition("(")[2].strip(")").split(" to "))
        assert (came, before) == (f"{other:.2f}", f"{first:.2f}") and low <= other <= high
