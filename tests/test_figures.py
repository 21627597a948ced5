"""Figures of README and docs/ are those of the committed tables and records, to the last digit that is shown."""

from __future__ import annotations

import csv
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from data_pipelines.suite.world import World
from experiments.analysis.bootstrap import Panel, bootstrap_intervals
from experiments.analysis.compare import Difference, Side, compare
from experiments.analysis.intervals import Interval
from experiments.analysis.rows import OVERALL, Row, curve, read_csv
from experiments.applications import DRIVEN
from experiments.applications.plan_actions import Settings, read_trials
from experiments.applications.policies.tasks import Task
from experiments.presets import PRESETS
from hma_jax.config import EvalConfig, TrainConfig
from hma_jax.evaluation.effects import MIN_EPISODES
from hma_jax.evaluation.summary import summarise
from hma_jax.evaluation.windows import WindowTable
from tests.pages import table

ROOT = Path(__file__).parents[1]
README, RESULTS = ROOT / "README.md", ROOT / "docs" / "results.md"
STUDY = ROOT / "experiments" / "results" / "cpu"

TRAINED = {
    "untrained (vocabulary 65,536)": ("width", 48, "untrained"),
    "copying the last prompt frame": ("width", 48, "point"),
    "**reference**: 40 robots, all trajectories, width 48": ("width", 48, "point"),
    "control: actions of other episodes": ("width", 48, "control"),
    "at most 4 trajectories per robot": ("trajectories", 4, "point"),
    "at most 32 trajectories per robot": ("trajectories", 32, "point"),
    "width 16": ("width", 16, "point"),
    "width 32": ("width", 32, "point"),
    "5 robots, judged on these five": ("datasets", 5, "point"),
    "20 robots, judged on the first five": ("datasets", 20, "point"),
    "40 robots, judged on the first five": ("datasets", 40, "point"),
}
"""Row of the table -> (sweep, x, role)."""

METRICS = ("perplexity", "action_nats", "delta_psnr", "psnr")
DIGITS = {"perplexity": 2, "action_nats": 3, "delta_psnr": 3, "psnr": 2}


def shown(row: Row, digits: int) -> str:
    return f"{row.mean:,.{digits}f} ± {row.sem:.{digits}f}"


def test_the_study_s_figures():
    rows = {(r.sweep, r.x, r.role, r.metric): r for r in read_csv(STUDY / "results.csv") if r.scope == OVERALL}
    for label, cells in table(RESULTS, "| trained model |").items():
        for metric, cell in zip(METRICS, cells, strict=True):
            found = "psnr_copy" if label.startswith("copying") and metric == "psnr" else metric
            assert cell in ("", shown(rows[(*TRAINED[label], found)], DIGITS[metric])), (label, metric)
        assert cells[-1], f"{label} shows nothing"


def test_the_figure_beside_the_study_s_table_has_the_perplexity_that_the_page_says():
    (nats,) = (
        r.mean
        for r in read_csv(STUDY / "results.csv")
        if (r.sweep, r.x, r.role, r.scope, r.metric) == ("width", 48, "point", OVERALL, "cross_entropy")
    )
    said = f"The figure draws exp of the mean nats (the reference: {np.exp(nats):.0f}); the table"
    assert said in " ".join(RESULTS.read_text().split())


def test_errors_of_settings_and_conditioning_are_over_what_the_page_says():
    """It said that they treated windows as independent; they have none."""
    rows = read_csv(ROOT / "experiments" / "results" / "ablations" / "results.csv")
    metrics = {"perplexity": 2, "delta_psnr": 3, "psnr": 2}
    found = {m: {p.label: p for s in ("settings", "conditioning") for p in curve(rows, s, m)} for m in metrics}
    for label, cells in table(RESULTS, "| | perplexity | ΔPSNR (dB) | PSNR (dB) |").items():
        points = {m: of[label] for m, of in found.items()}
        shown = [f"{p.mean:.{metrics[m]}f} ± {p.seed_sem:.{metrics[m]}f}" for m, p in points.items()]
        assert cells == [text.replace("-0.000", "0.000") for text in shown], label
    whole = [p.sem for p in found["perplexity"].values()]
    said = f"as if these were independent, those of a perplexity would be {min(whole):.2f} to {max(whole):.2f}"
    assert said in " ".join(RESULTS.read_text().split()), said


def test_a_power_law_is_quoted_with_an_interval_and_with_what_is_doubtful():
    """README gave three digits of a law that lost a third of its exponent with one of five points."""
    with (ROOT / "experiments" / "results" / "cpu-full" / "fits.csv").open(newline="") as file:
        (row,) = (r for r in csv.DictReader(file) if (r["curve"], r["coefficient"]) == ("width", "alpha"))
    value, low, high = (f"{float(row[name]):.2f}" for name in ("value", "low", "high"))
    without = re.fullmatch(r"without the first position alpha is ([\d.]+) and E [\d.]+", row["doubts"])[1]
    said = (
        f"falls as N^-{value} in trunk parameters N ({low} to {high} with 90 %; {without} without the narrowest width,"
    )
    assert said in RESULTS.read_text()
    for path in (README, RESULTS):
        for line in path.read_text().splitlines():
            for law in re.finditer(r"\b[NDC]\^-?\d\.\d+", line):
                assert re.search(r"\d to \d", line), f"{path.name}: {law[0]} without its interval"


@pytest.mark.parametrize("path", sorted((ROOT / "experiments" / "results").rglob("results.csv")), ids=str)
def test_committed_tables_are_read(path):
    rows = read_csv(path)
    assert rows and all(row.status == "finished" for row in rows)


def test_the_model_that_is_driven_is_as_good_as_readme_says():
    report = json.loads((ROOT / DRIVEN / "report.json").read_text())
    model, still, shuffled = (
        sum(sum(robot[kind]) / len(robot[kind]) for robot in report["robots"].values()) / len(report["robots"])
        for kind in ("model", "still", "shuffled")
    )
    cores = ("one core", "two cores")[report["machine"]["cores"] - 1]
    text = " ".join(README.read_text().split())
    assert f"{report['frames']} frames of held-out episodes" in text
    assert f"| {model:.1f} dB | a still picture {still:.1f}, other actions {shuffled:.1f} |" in text
    assert f"| {report['frames_per_second']:.0f} frames a second on {cores} |" in text


def test_the_glossary_names_the_simulators_that_there_are():
    """It said four when there were five."""
    shipped = (path.parent.name for path in (ROOT / "experiments" / "results").glob("simulator*/checkpoints"))
    names = {name.partition("_")[2] or "first" for name in shipped}
    (label,) = (label for label in table(ROOT / "docs" / "glossary.md", "| term |") if "weighed" in label)
    assert set(label.strip("*").split(", ")) == names


def test_how_many_episodes_are_held_out_is_as_the_page_on_own_data_says():
    page = " ".join((ROOT / "docs" / "own_data.md").read_text().split())
    for name, study in PRESETS.items():
        kept, enough = study.store.held_out, {"paper": 350}.get(name, 70)
        if kept.min_val == 8:
            assert name.startswith(("cpu", "play")) and (kept.count(16), kept.count(32)) == (4, 8)
            enough = 16
        assert (kept.count(enough - 1), kept.count(enough)) == (MIN_EPISODES - 1, MIN_EPISODES), name
        assert kept.count(7) == 1
    assert (
        "Of fewer than 70 episodes (fewer than 350 with `paper`, which holds out 1 % instead of 5 %) at most 3" in page
    )
    assert f"of fewer than 8 a single one: too few for `hma check`, which needs {MIN_EPISODES}." in page


def test_presets_differ_from_the_release_in_training_as_the_page_on_own_data_says():
    def differing(name: str) -> set[str]:
        train, released = PRESETS[name].train, TrainConfig()
        return {
            f"{group}{key}"
            for group, ours, theirs in (("", train, released), ("optimizer.", train.optimizer, released.optimizer))
            for key, value in vars(ours).items()
            if key != "optimizer" and value != vars(theirs)[key]
        }

    page = " ".join((ROOT / "docs" / "own_data.md").read_text().split())
    said = (
        "Its learning rate is five times the release's and falls over the last fifth of the steps, of which there are "
        "20,000 instead of 60,000; AdamW's ε is smaller, as in `paper`, which otherwise trains as the release does."
    )
    assert said in page
    rate = {"optimizer.learning_rate", "optimizer.schedule"}
    assert differing("accelerator") == {"steps", "optimizer.epsilon"} | rate
    assert differing("paper") == {"optimizer.epsilon"}
    ours, released = PRESETS["accelerator"].train, TrainConfig()
    assert ours.optimizer.learning_rate == pytest.approx(5 * released.optimizer.learning_rate)
    assert (ours.optimizer.schedule, ours.optimizer.decay_fraction) == ("wsd", 0.2)
    assert (ours.steps, released.steps) == (20_000, 60_000)


JUDGED = {
    "fifteen policies, a pusher reaches": ("pusher_sand-reach-grown", 15),
    "eleven, an arm reaches": ("arm_chalk-reach-grown", 11),
    "eleven, a MuJoCo arm opens a drawer": ("metaworld_drawer", 11),
}
"""Beginning of a row of README -> (what was judged, how many policies)."""


def test_policies_and_plans_are_as_readme_says():
    rows = table(README, "| | model |")
    for said, (task, policies) in JUDGED.items():
        judged = json.loads((ROOT / f"experiments/results/judge-{task}/agreement.json").read_text())
        learned, control = correlations(task)
        (cells,) = (cells for label, cells in rows.items() if label.startswith(said))
        assert len(judged["policies"]) == policies
        assert cells[0] == f"r = {learned['mean']:.2f} ({learned['low']:.2f} to {learned['high']:.2f})"
        assert cells[1].partition(",")[0] == f"other actions: {control['mean']:.2f}"
    learned, _ = correlations("metaworld_drawer-without_actions")
    assert cells[1].endswith("; trained without actions: undefined") and learned["mean"] is None
    (cells,) = (cells for label, cells in rows.items() if label.startswith("goals reached by MPPI"))
    said = f"behaviour cloning, mean of sixteen: {100 * cloned().mean():.0f} %"
    assert cells == [f"{100 * planned_by_mppi().mean():.0f} %", said] and len(cloned()) == 16


def test_generated_trajectories_are_worth_what_readme_says():
    with (ROOT / "experiments/results/tuned_night_two/summary.csv").open(newline="") as file:
        found = {
            row["what"]: [round(100 * float(row[x])) for x in ("mean", "low", "high")] for row in csv.DictReader(file)
        }
    mean, low, high = found["success: share of the gap: 10 + 90 generated"]
    alone = found["success: share of the gap: recorded first frames only"][0]
    (cells,) = (cells for label, cells in table(README, "| | model |").items() if "90 generated trajectories" in label)
    assert cells == [f"{mean} % ({low} to {high}) of the gap to 100", f"recorded first frames alone: {alone} %"]


def correlations(task: str) -> list[dict[str, float | None]]:
    """Pearson's r, over policies and starts, of true success and that in the model or under other episodes' actions."""
    judged = json.loads((ROOT / f"experiments/results/judge-{task}/agreement.json").read_text())["agreement"]
    worlds = "learned model", "control: actions of other episodes"
    return [judged[world]["policies and starts"]["pearson"] for world in worlds]


def planned_by_mppi() -> np.ndarray:
    """Success [starts] in the served model, from the further starts."""
    trials = read_trials(ROOT / "experiments/results/planning_more/trials.csv")
    return np.array([float(trial["success"]) for trial in trials["MPPI in the model"]])


def cloned() -> np.ndarray:
    """Success [trainings, starts] of the policies cloned from 1,000 trajectories, from the same starts."""
    place = ROOT / "experiments/results/planning_more"
    first = read_trials(place / "trials.csv")["behaviour cloning of 1000 trajectories"]
    found = {0: [trial["success"] for trial in first]}
    with (place / "cloned.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            found.setdefault(int(row["seed"]), []).append(row["success"] == "1")
    return np.array(list(found.values()), float)


def begins_there(task: Task, seeds: np.ndarray) -> np.ndarray:
    """bool [starts]: the goal is reached before anything is done."""
    return World(task.spec, seeds).success()


def begun_of_thirty() -> int:
    settings = Settings()
    return int(begins_there(settings.make_task(), settings.start_seeds()).sum())


def test_plans_from_further_starts_are_as_their_page_says():
    page = " ".join((ROOT / "docs" / "planning.md").read_text().split())
    rows = table(ROOT / "docs" / "planning.md", "| way of acting |")
    summary, plans, policies = planned("planning_more"), planned_by_mppi(), cloned()
    assert policies.shape == (16, 120) and plans.shape == (120,)

    def crossed(values: np.ndarray, which: np.ndarray = np.ones(120, bool)) -> Interval:
        starts = np.flatnonzero(which)
        panel = Panel(np.zeros(len(starts), str), starts, (values[:, starts],), (tuple(range(len(values))),))
        return bootstrap_intervals(panel)[0]

    def told(mean: float, low: float, high: float) -> list[str]:
        return [f"{mean:.2f}", f"{low:.2f} to {high:.2f}"]

    for way in ("MPPI in the model", "random actions"):
        assert rows[way] == told(*map(float, summary[way].values()))
    of_all = crossed(policies)
    many = rows["behaviour cloning of 1000 trajectories, sixteen trainings"]
    assert many == told(of_all.mean, of_all.low, of_all.high)
    assert of_all.high < float(summary["MPPI in the model"]["low"])
    gain = crossed(plans - policies)
    assert f"by {gain.mean:.2f} ({gain.low:.2f} to {gain.high:.2f}), paired by start" in page
    settings = Settings(starts=120, skip=30)
    away = ~begins_there(settings.make_task(), settings.start_seeds())
    less = crossed(plans - policies, away)
    assert f"Of these starts {120 - away.sum()} begin on the mark (of the thirty {begun_of_thirty()})" in page
    assert (
        f"From the other {away.sum()} MPPI has {plans[away].mean():.2f}, cloning {policies[:, away].mean():.2f}" in page
    )
    assert f"the difference is {less.mean:.2f} ({less.low:.2f} to {less.high:.2f})" in page
    rates = policies.mean(1)
    first = f"the first, the one in the table of thirty, has {rates[0]:.2f}"
    assert f"from {rates.min():.2f} to {rates.max():.2f}; {first}" in page
    assert "came to {:.2f}, {:.2f} and {:.2f}".format(*rates[:3]) in page
    best = policies[rates.argmax()]
    alone = (best > plans).sum(), (plans > best).sum()
    assert "From {} of the starts only the best of the sixteen succeeds, from {} only MPPI;".format(*alone) in page
    thirty = planned_from_thirty("MPPI in the model")
    counts = [[tried.sum(), len(tried) - tried.sum()] for tried in (thirty, plans)]
    chance = scipy.stats.fisher_exact(counts)[1]
    assert (
        f"where it had {thirty.mean():.2f}, a difference that chance makes in {100 * chance:.0f} of 100 cases" in page
    )
    assert f"which came to {plans.mean() - rates[:3].mean():.2f}." in page


def planned_from_thirty(way: str) -> np.ndarray:
    """Success [starts] in the served model, from the first starts."""
    trials = read_trials(ROOT / "experiments/results/planning_grown/trials.csv")
    return np.array([float(trial["success"]) for trial in trials[way]])


def test_ways_of_acting_are_compared_start_by_start_as_their_page_says():
    page = " ".join((ROOT / "docs" / "planning.md").read_text().split())
    mppi, cem, true, cloned = map(
        planned_from_thirty,
        (
            "MPPI in the model", "CEM in the model", "CEM in the true simulator",
            "behaviour cloning of 1000 trajectories",
        ),
    )  # fmt: skip
    assert f"at the mark from {mppi.sum():.0f} of 30 starts**, CEM from {cem.sum():.0f}." in page
    assert f"only MPPI succeeds {(mppi > cloned).sum()} times, only the policy {(cloned > mppi).sum()} times" in page
    assert f"(only it succeeds {(true > cem).sum()} times, only CEM in the model {(cem > true).sum()} times)" in page


MODELS = {"first": "planning", "weighed": "planning_weighed", "grown, served": "planning_grown"}


def test_plans_in_each_model_are_as_their_page_says():
    page = ROOT / "docs" / "planning.md"
    assert (ROOT / "experiments/results/planning_grown/table.md").read_text().strip() in page.read_text()
    served = planned("planning_grown")
    for label, cells in table(page, "| model | CEM |").items():
        name = MODELS[label.split(" ([")[0]]
        rows, settings = planned(name), json.loads((ROOT / "experiments/results" / name / "settings.json").read_text())
        decoding = label.rsplit(", ", 1)[1]  # rows of other decoding are not compared unawares
        assert decoding in ("greedy", "sampled at 0.7")
        if "simulator" in settings:
            assert (settings["simulator"]["decode"]["temperature"] == 0) == (decoding == "greedy")
        assert all(rows[way] == served[way] for way in rows if not way.endswith("in the model"))
        for way, cell in zip(("CEM", "MPPI", "random shooting"), cells, strict=True):
            mean, low, high = (float(rows[f"{way} in the model"][key]) for key in ("mean", "low", "high"))
            assert cell == f"{mean:.2f} ({low:.2f} to {high:.2f})"


def planned(name: str) -> dict[str, dict[str, str]]:
    """Rows of a committed summary by way of acting, without how long a plan took."""
    with (ROOT / "experiments" / "results" / name / "summary.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {row["way"]: {key: row[key] for key in ("mean", "low", "high")} for row in rows}


def told_apart(row: Difference) -> bool:
    return not row.low <= 0 <= row.high


def test_the_page_of_the_simulator_gives_what_its_windows_say():
    by_label = {
        "perplexity": ("perplexity", 2),
        "PSNR (dB)": ("psnr", 2),
        "SSIM": ("ssim", 3),
        "LPIPS": ("lpips", 3),
        "ΔPSNR (dB)": ("delta_psnr", 2),
        "action-nats": ("action_nats", 2),
        "counterfactual gain (dB, [what it is](statistics.md))": ("counterfactual_gain", 2),
    }
    cells = table(ROOT / "docs" / "simulator.md", "| | simulator_grown | simulator_hours |")
    assert cells.keys() == by_label.keys()
    place = ROOT / "experiments" / "results" / "simulator_protocol"
    judged = {
        name: WindowTable.load(place / name / "windows.parquet") for name in ("grown", "hours", "weighed", "first")
    }
    of = {name: summarise(windows, EvalConfig.perplexity_group) for name, windows in judged.items()}
    for label, (metric, digits) in by_label.items():
        shown_of = [of[name].overall[metric] for name in judged]
        if copied := of["grown"].overall.get(f"{metric}_copy"):
            shown_of.append(copied)
        texts = [f"{stat.mean:.{digits}f} ± {stat.sem:.{digits}f}" for stat in shown_of]
        assert [cell for cell in cells[label] if cell] == texts, label
    assert all((windows.metrics["retrieval"] == 1).all() for windows in judged.values())
    sides = [Side(name, {0: windows}, "") for name, windows in judged.items()]
    *better, apart = (
        {row.metric: row for row in compare(*pair) if row.scope == OVERALL} for pair in itertools.pairwise(sides)
    )
    measured = "cross_entropy", *(metric for metric, _ in by_label.values() if metric != "perplexity")
    assert all(told_apart(rows[metric]) for rows in better for metric in measured)
    told = {
        metric
        for metric in ("cross_entropy", *dict(by_label.values()))
        if metric in apart and told_apart(apart[metric])
    }
    assert told == {"cross_entropy", "action_nats", "lpips", "counterfactual_gain"}
    psnr, page = apart["psnr"], " ".join((ROOT / "docs" / "simulator.md").read_text().split())
    assert (
        f"differences in PSNR ({psnr.mean:.2f} ± {(psnr.high - psnr.low) / 2:.2f}, 95 %), SSIM and ΔPSNR are not significant"
        in page
    )
    beaten = {
        name: [d for d, s in by.datasets.items() if s["lpips"].mean > s["lpips_copy"].mean] for name, by in of.items()
    }
    assert beaten == {"grown": [], **dict.fromkeys(("hours", "weighed", "first"), ["omni_chalk"])}


def test_claims_of_robots_and_actions_come_with_their_controls():
    """The gain of more robots and of actions stood without what the same page says of it."""
    rows = table(RESULTS, "| the paper | here |")
    robots, actions, new = (
        next(said for claim, (said, _) in rows.items() if claim.startswith(start))
        for start in ("more robots", "models conditioned", "pre-training")
    )
    assert "alone, trained for as long, are 0.61 ahead" in robots and "no transfer is claimed" in robots
    assert "0.08 also come with shuffled actions" in actions
    assert "After 5 robots it is 0.09 behind" in new and "Frames do not show a difference yet" in new


def test_readme_is_read_in_a_few_minutes():
    words = [word for word in README.read_text().replace("|", " ").split() if word.strip("-:")]  # no rules of tables
    assert len(words) <= 900


def test_the_page_of_simulators_gives_the_nats_of_its_table():
    rows = read_csv(ROOT / "experiments" / "results" / "sim" / "results.csv")
    nats = {(r.sweep, r.x, r.role): r.mean for r in rows if (r.scope, r.metric) == (OVERALL, "cross_entropy")}
    page = " ".join((ROOT / "docs" / "simulators.md").read_text().split())
    assert f"The reference has {nats['width', 64, 'point']:.3f} and" in page
    assert f"**the control {nats['width', 64, 'control']:.3f}, which is better**" in page
    few, more, all_there = (nats["trajectories", x, "point"] for x in (4, 8, 480))
    assert f"({few:.3f}, {more:.3f} and {all_there:.3f} nats" in page
    sixteen = nats["trajectories", 16, "point"]
    assert sixteen == all_there and "the caps of 16 and of 480 in the CSV are one training under two names" in page
    widths = ", ".join(f"{nats['width', x, 'point']:.3f}" for x in (24, 32, 64, 96))
    assert f"({widths} at widths 24, 32, 64 and 96)" in page
    assert f"from {nats['datasets', 5, 'point']:.3f} nats alone to {nats['datasets', 40, 'point']:.3f} when" in page


def test_what_the_table_of_claims_says_stands_on_the_pages_that_it_links():
    for claim, (said, link) in table(RESULTS, "| the paper | here |").items():
        page = (RESULTS.parent / re.search(r"\]\(([^)#]+)", link)[1]).resolve()
        text = " ".join(page.read_text().split())
        for figure in re.findall(r"\d+\.\d+", said):
            assert figure in text, (claim, figure, page.name)
