"""Figures of README and docs/ are those of the committed tables and records, to the last digit that is shown."""

from __future__ import annotations

import csv
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
from experiments.applications import DRIVEN
from experiments.applications.plan_actions import Settings, read_trials
from experiments.applications.policies.tasks import Task
from experiments.bench.beside import OURS, RELEASED, THEIRS
from experiments.bench.models import EXECUTION
from experiments.bench.record import read_record
from experiments.presets import get_preset
from experiments.rows import OVERALL, Row, read_csv
from hma_jax.config import EvalConfig, ExecutionConfig
from hma_jax.evaluation.summary import summarise
from hma_jax.evaluation.windows import WindowTable
from tests.pages import table

ROOT = Path(__file__).parents[1]
README, RESULTS = ROOT / "README.md", ROOT / "docs" / "results.md"
STUDY, BENCH = (ROOT / "experiments" / "results" / name for name in ("cpu", "bench/cpu"))

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

STAGES = {
    "a frame while the window fills": "fill",
    "a frame past the window, exact": "slide",
    "a training step": "step",
}


def shown(row: Row, digits: int) -> str:
    return f"{row.mean:,.{digits}f} ± {row.sem:.{digits}f}"


@pytest.mark.parametrize("page", [README, RESULTS], ids=lambda page: page.name)
def test_the_study_s_figures(page):
    rows = {(r.sweep, r.x, r.role, r.metric): r for r in read_csv(STUDY / "results.csv") if r.scope == OVERALL}
    for label, cells in table(page, "| trained model |").items():
        for metric, cell in zip(METRICS, cells, strict=True):
            found = "psnr_copy" if label.startswith("copying") and metric == "psnr" else metric
            assert cell in ("", shown(rows[(*TRAINED[label], found)], DIGITS[metric])), (label, metric)
        assert cells[-1], f"{label} shows nothing"


def test_the_speed_beside_the_release():
    record = json.loads((BENCH / "release-base-float32-cpu.json").read_text())
    median = {stage["name"]: stage["timing"]["median"] for stage in record["stages"]}
    for label, (release, here, times) in table(README, "| | release | here |").items():
        stage = STAGES[label]
        theirs, ours = median[THEIRS + RELEASED[stage]], median[OURS + stage]
        assert (release, here) == (f"{theirs:.2f} s", f"{ours:.2f} s"), label
        ratio = float(re.search(r"[\d.]+", times)[0])
        digits = len(times.split(".")[1].rstrip("*").split(":")[0])
        assert ratio == round(theirs / ours, digits), label
        assert ("slower" in times) == (theirs < ours), label
    assert f"`{record['machine']['commit']}`" in README.read_text() and record["date"] in README.read_text()


def test_the_speed_on_a_gpu_beside_the_release():
    gpu, text = ROOT / "experiments" / "results" / "bench" / "gpu", " ".join(README.read_text().split())
    page = (ROOT / "docs" / "performance.md").read_text()
    names = ("base-float32", "base-batch-8-bfloat16")
    frames, steps = (read_record(gpu / f"release-{name}-nvidia-h100-80gb-hbm3.json") for name in names)
    fill, slide, train = (
        record.stage(THEIRS + RELEASED[stage], rows).timing.median / record.stage(OURS + stage, rows).timing.median
        for record, stage, rows in ((frames, "fill", 1), (frames, "slide", 1), (steps, "step", 8))
    )
    assert (
        f"frames are {fill:.1f} and {slide:.1f} times faster (float32, batch 1), a training step {train:.1f} times"
        in text
    )
    assert all(f"| {ratio:.2f} |" in page for ratio in (fill, slide, train))
    rollouts = read_record(next(gpu.glob("rollout-base-*.json")))
    one, many = (rollouts.stage("rollout", rows).frames_per_second for rows in (1, 64))
    (shown,) = read_record(next(gpu.glob("simulate-*.json"))).stages
    for rate in (one, many, shown.frames_per_second):
        assert f" {rate:.0f} frames/s" in " ".join(page.split())


SPEED = ROOT / "docs" / "performance.md"
WEIGHTS = re.compile(r"\d+ times 1 of (\d+) x (\d+) x (\d+)")
"""A product without batch: of a weight, or of its gradient."""


def beside_the_release(*earlier: str) -> list[dict[str, tuple[float, float]]]:
    """Stage -> (median, p90), of the newest comparison with the release on two cores, or of earlier ones."""
    paths = [BENCH.parent / "release-before" / f"{commit}.json" for commit in earlier]
    records = map(read_record, paths or [BENCH / "release-base-float32-cpu.json"])
    return [{s.name: (s.timing.median, s.timing.p90) for s in record.stages} for record in records]


def times_longer(run: dict[str, tuple[float, float]], stage: str) -> float:
    return run[THEIRS + RELEASED[stage]][0] / run[OURS + stage][0]


EARLIER = ("ff60a14d7648", "9d42fe38d6dc", "beb6b0eed88e")
"""Commits of the three comparisons of the day before, in the order of the page."""


def test_the_page_of_speed_shows_the_release_on_two_cores():
    (newest,), before = beside_the_release(), beside_the_release(*EARLIER)
    rows = table(SPEED, "| stage | the release | here |")
    few = "continuous fill, 10 evaluations by dpm++"
    shown = {"continuous few" if label == few else label: cells for label, cells in rows.items()}
    assert shown.keys() == RELEASED.keys()
    for stage, cells in shown.items():
        times = [
            ", ".join(f"{1e3 * x:,.0f} ms" for x in newest[name]) for name in (THEIRS + RELEASED[stage], OURS + stage)
        ]
        others = ", ".join(f"{times_longer(run, stage):.2f}" for run in before)
        assert cells == [*times, f"{times_longer(newest, stage):.2f}", others], stage
    page = " ".join(SPEED.read_text().split())
    forward = [[run[whose + "forward"][0] for run in (newest, *before)] for whose in (THEIRS, OURS)]
    for mine, words in zip(forward, ("took {:.2f} s in it", "ours {:.2f} s"), strict=True):
        assert f"{words.format(mine[0])}, before {min(mine[1:]):.2f} to {max(mine[1:]):.2f} s" in page
    plain = [read_record(BENCH.parent / "release-before" / f"{c}.json").matmul_flops_per_second / 1e9 for c in EARLIER]
    now = read_record(BENCH / "release-base-float32-cpu.json").matmul_flops_per_second / 1e9
    assert f"({now:.0f} GFLOP/s, before {min(plain):.0f} to {max(plain):.0f})" in page
    huge = (before[0][f"release{how}: {stage}"][0] for stage in ("frame", "step") for how in (" with huge pages", ""))
    assert "its frame took {:.2f} s with and {:.2f} s without, its step {:.2f} and {:.2f} s".format(*huge) in page


SUMMED = {
    "a frame while the window fills": "fill",
    "a frame past the window, exact": "slide",
    "a training step": "step",
    "a frame of latents while it fills, as released: DDPM, 100 steps": "continuous fill",
    "the same by DPM++, 10 steps": "continuous few",
}
"""Row of the page's summary -> stage."""


def test_the_summary_of_speed_gives_the_range_of_four_runs():
    (newest,), before = beside_the_release(), beside_the_release(*EARLIER)
    rows = table(SPEED, "| base model, M = 2 unmasking steps |")
    gpu = table(SPEED, "| | release | here | the release over ours |")
    on_gpu = dict(zip(("fill", "slide", "step"), gpu.values(), strict=True))
    for label, stage in SUMMED.items():
        took, beside, here, there = rows[label]
        digits = 2 if stage == "step" else 1
        mine, others = times_longer(newest, stage), [times_longer(run, stage) for run in before]
        assert took == f"{newest[OURS + stage][0]:.2f} s", label
        found = re.findall(r"\d+\.\d+", beside)
        assert found == [f"{x:.{digits}f}" for x in (mine, min(others), max(others))], label
        assert ("slower" in beside) == (mine < 1), label
        if stage in on_gpu:
            assert here.startswith(on_gpu[stage][1]) and there.split()[0] == f"{float(on_gpu[stage][2]):.1f}", label
    readme = " ".join(README.read_text().split())
    said = [[times_longer(run, stage) for run in before] for stage in ("fill", "slide", "step")]
    ranges = [f"{min(x):.{d}f}-{max(x):.{d}f}" for x, d in zip(said, (1, 1, 2), strict=True)]
    assert f"Three earlier runs: {', '.join(ranges)} times." in readme
    assert f"frames {min(said[1]):.1f} to " in readme


WITHIN = {
    "recomputing the window, 7,215 ms": ("generate-base", "recompute", "fill"),
    "recomputing the window": ("generate-base", "recompute", "stream"),
    "slide, 4,170 ms": ("generate-base", "slide", "whole"),
    "a pass with plain attention, 4,978 ms": ("generate-base", "plain", "whole"),
    "a training step, 12,385 ms": ("train-base", "step", "forward"),
    "evaluation pass by pass, 31,036 ms": ("eval-recorded-base-layers-2", "literal", "protocol"),
}
"""Row of the page -> (record, stage, over which)."""


def test_the_page_of_speed_shows_ratios_within_one_run():
    rows = table(SPEED, "| what | over what | ratio | record |")
    assert rows.keys() == WITHIN.keys()
    for label, (kind, *names) in WITHIN.items():
        (path,) = BENCH.glob(f"{kind}-float32-cpu.json")
        record = read_record(path)
        one, other = (record.stage(name, 1).timing.median for name in names)
        over, ratio, source = rows[label]
        for cell, seconds in ((label, one), (over, other)):
            assert re.findall(r"[\d,]+ ms", cell) in ([], [f"{1e3 * seconds:,.0f} ms"]), label
        assert ratio == f"{one / other:.2f}", label
        assert source.startswith(record.kind.split("-")[0]), label
        commits = re.findall("`([0-9a-f]+)`", source)
        assert all(commit == record.machine["commit"] for commit in commits), label
    page = " ".join(SPEED.read_text().split())
    held = [
        read_record(BENCH / f"{kind}-base-float32-cpu.json").peak_memory_bytes / 2**30 for kind in ("generate", "train")
    ]
    assert "A process that generates held {:.1f} GiB at most, one that trains {:.1f} GiB".format(*held) in page


def test_the_page_of_speed_shows_what_loading_gives():
    record = read_record(BENCH / "load-store-none-cpu.json")
    rows = table(SPEED, "| | frames/s | memory grows, per thousand |")
    assert rows.keys() == {stage.name for stage in record.stages}
    for stage in record.stages:
        rate, memory = rows[stage.name]
        assert rate == f"{stage.frames_per_second:,.0f}"
        amount, _, over = memory.partition(" over ")
        threads = stage.name.partition(", ")[2]
        assert f"memory over {over}, {threads}: +{amount} per thousand" in record.notes


def test_the_page_of_speed_shows_products_of_two_cores():
    release = beside_the_release("9d42fe38d6dc")[0]
    rates, smallest, plain, within, over_time = [], [], [], [], []
    for program, theirs in (("forward", "forward"), ("fill", "frame"), ("slide", "frame"), ("step", "step")):
        products = read_record(BENCH / f"products-{program}-base-float32-cpu.json")
        plain.append(products.matmul_flops_per_second / 1e9)
        cells = table(SPEED, "| program | time |")[PROGRAMS[program]]
        whole, *each = products.stages
        took, released = sum(stage.timing.median for stage in each), release[THEIRS + theirs][0]
        times = whole.timing.median / took, released / took
        assert cells == [
            f"{whole.timing.median:.2f} s", f"{took:.2f} s", f"{times[0]:.2f}", f"{released:.2f} s", f"{times[1]:.1f}"
        ], program  # fmt: skip
        for stage in each:
            rate = stage.flops / stage.timing.median / 1e9
            sizes = WEIGHTS.fullmatch(stage.name)
            if " times 4 of " in stage.name:
                within.append(rate)
            elif " times 2560 of " in stage.name:
                over_time.append(rate)
            elif sizes and min(map(int, sizes.groups())) >= 256:
                (smallest if sizes.groups() == ("320", "256", "256") else rates).append(rate)
    slow, *others = sorted(rates)
    page = " ".join(SPEED.read_text().split())
    said = (
        "Products with weights run at {:.0f} to {:.0f} GFLOP/s (the smallest, of a matrix 256 wide with one frame, at {:.0f} "
        "to {:.0f}, one of the step's at {:.0f}), a plain square product at {:.0f} to {:.0f}; those of attention within "
        "frames at {:.0f} to {:.0f} (a head has 32 values), those over time at {:.0f} to {:.0f}"
    )
    figures = others[0], others[-1], min(smallest), max(smallest), slow, min(plain), max(plain)
    assert said.format(*figures, min(within), max(within), min(over_time), max(over_time)) in page


def test_pages_say_that_steps_are_timed_with_another_remat_than_training_takes():
    assert (EXECUTION.remat, ExecutionConfig().remat) == ("products", "everything")
    page, launching = (
        " ".join((ROOT / "docs" / name).read_text().split()) for name in ("performance.md", "launching.md")
    )
    assert 'timed with `execution.remat` "products"' in page and "`remat=products`" in README.read_text()
    assert 'timed with `execution.remat=products`; the preset takes "everything"' in launching
    assert get_preset("accelerator").execution.remat == "everything"
    took = {
        name: float(seconds) for seconds, name in re.findall(r'(\d\.\d\d)(?: s a step)? (?:with|and) "(\w+)"', page)
    }
    assert 1 / 7 < took["everything"] / took["products"] - 1 < 1 / 5


def test_the_page_of_speed_says_where_a_pass_goes():
    page, shares = " ".join(SPEED.read_text().split()), []
    for program in PROGRAMS:
        whole, *each = read_record(BENCH / f"products-{program}-base-float32-cpu.json").stages
        of = {" times 1 of ": 0.0, " times 4 of ": 0.0, " times 2560 of ": 0.0}
        for stage in each:
            of[next(kind for kind in of if kind in stage.name)] += 100 * stage.timing.median / whole.timing.median
        shares.append(list(of.values()))
    said = (
        "products with weights are {:.0f} % of the time, those of attention within frames {:.0f} %, those over time {:.0f} %, and "
        "what is no product {:.0f} %"
    )
    assert said.format(*shares[0], 100 - sum(shares[0])) in page
    sums = [sum(each) for each in shares]
    assert f"products of matrices take {min(sums):.0f} to {max(sums):.0f} % of the time" in page


PROGRAMS = {
    "forward": "a pass over the window",
    "fill": "a frame while the window fills",
    "slide": "a frame past the window, exact",
    "step": "a training step",
}


def test_the_page_of_speed_shows_what_cheaper_decoding_costs():
    with (BENCH.parent / "quality-continuous" / "quality-12.csv").open(newline="") as file:
        judged = {
            row["decoding"]: {k: float(x) for k, x in row.items() if k != "decoding"} for row in csv.DictReader(file)
        }
    rows = table(SPEED, "| sampler | PSNR (dB) | beside DDPM 100 |")
    for label, cells in rows.items():
        row = judged[label.strip("*").removesuffix(", as released").lower()]
        gap = f"{row['psnr_gap']:.2f} ± {row['psnr_gap_sem']:.2f}" if row["psnr_gap"] else ""
        psnr, delta = (f"{row[name]:.2f} ± {row[f'{name}_sem']:.2f}" for name in ("psnr", "delta_psnr"))
        assert cells[:4] == [psnr, gap, f"{row['ssim']:.3f}", delta], label


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
        learned, control = (
            judged["agreement"][world]["policies and starts"]["pearson"]
            for world in ("learned model", "control: actions of other episodes")
        )
        (cells,) = (cells for label, cells in rows.items() if label.startswith(said))
        assert len(judged["policies"]) == policies
        assert cells[0] == f"r = {learned['mean']:.2f} ({learned['low']:.2f} to {learned['high']:.2f})"
        assert cells[1] in (f"other actions {control['mean']:.2f}", "without actions: none")
    (cells,) = (cells for label, cells in rows.items() if label.startswith("plans"))
    assert cells == [f"{100 * planned_by_mppi().mean():.0f} %", f"cloned policies {100 * cloned().mean():.0f} %"]


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
    assert f"by {gain.mean:.2f} ({gain.low:.2f} to {gain.high:.2f}), start by start" in page
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
    assert "succeeds alone from {} of them, MPPI from {}.".format(*alone) in page
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
    assert f"MPPI succeeds alone {(mppi > cloned).sum()} times, it alone {(cloned > mppi).sum()} times" in page
    assert f"(alone {(true > cem).sum()} times, CEM in the model alone {(cem > true).sum()} times)" in page


MODELS = {"first": "planning", "weighed": "planning_weighed", "grown, served": "planning_grown"}


def test_plans_in_each_model_are_as_their_page_says():
    page = ROOT / "docs" / "planning.md"
    assert (ROOT / "experiments/results/planning_grown/table.md").read_text().strip() in page.read_text()
    served = planned("planning_grown")
    for label, cells in table(page, "| model | CEM |").items():
        rows = planned(MODELS[label.split(" ([")[0]])
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
    cells = table(ROOT / "docs" / "simulator.md", "| | simulator_grown | simulator_weighed |")
    assert cells.keys() == by_label.keys()
    place = ROOT / "experiments" / "results" / "simulator_protocol"
    judged = {name: WindowTable.load(place / name / "windows.parquet") for name in ("grown", "weighed", "first")}
    of = {name: summarise(windows, EvalConfig.perplexity_group) for name, windows in judged.items()}
    for label, (metric, digits) in by_label.items():
        shown_of = [of[name].overall[metric] for name in judged]
        if copied := of["grown"].overall.get(f"{metric}_copy"):
            shown_of.append(copied)
        texts = [f"{stat.mean:.{digits}f} ± {stat.sem:.{digits}f}" for stat in shown_of]
        assert [cell for cell in cells[label] if cell] == texts, label
    assert all((windows.metrics["retrieval"] == 1).all() for windows in judged.values())
    weighed, first = (Side(name, {0: judged[name]}, "") for name in ("weighed", "first"))
    apart = {row.metric: row for row in compare(weighed, first) if row.scope == OVERALL}
    told = {
        metric
        for metric in ("cross_entropy", *dict(by_label.values()))
        if metric in apart and told_apart(apart[metric])
    }
    assert told == {"cross_entropy", "action_nats", "lpips", "counterfactual_gain"}
    psnr, page = apart["psnr"], " ".join((ROOT / "docs" / "simulator.md").read_text().split())
    assert (
        f"PSNR ({psnr.mean:.2f} ± {(psnr.high - psnr.low) / 2:.2f}, 95 %), SSIM and ΔPSNR do not tell them apart"
        in page
    )
    beaten = {
        name: [d for d, s in by.datasets.items() if s["lpips"].mean > s["lpips_copy"].mean] for name, by in of.items()
    }
    assert beaten == {"grown": [], "weighed": ["omni_chalk"], "first": ["omni_chalk"]}


def test_readme_is_read_in_a_few_minutes():
    words = README.read_text().replace("|", " ").split()
    assert len(words) <= 900


def test_the_page_of_simulators_gives_the_nats_of_its_table():
    rows = read_csv(ROOT / "experiments" / "results" / "sim" / "results.csv")
    nats = {(r.sweep, r.x, r.role): r.mean for r in rows if (r.scope, r.metric) == (OVERALL, "cross_entropy")}
    page = " ".join((ROOT / "docs" / "simulators.md").read_text().split())
    assert f"the reference has {nats['width', 64, 'point']:.3f}" in page
    assert f"**the control {nats['width', 64, 'control']:.3f}, which is better**" in page
    few, more, all_there = (nats["trajectories", x, "point"] for x in (4, 8, 480))
    assert f"({few:.3f}, {more:.3f} and {all_there:.3f} nats" in page
    widths = ", ".join(f"{nats['width', x, 'point']:.3f}" for x in (24, 32, 64, 96))
    assert f"({widths} at 24 to 96)" in page
    assert f"from {nats['datasets', 5, 'point']:.3f} nats alone to {nats['datasets', 40, 'point']:.3f} among" in page


def test_what_the_table_of_claims_says_stands_on_the_pages_that_it_links():
    for claim, (said, link) in table(RESULTS, "| the paper | here |").items():
        page = (RESULTS.parent / re.search(r"\]\(([^)#]+)", link)[1]).resolve()
        text = " ".join(page.read_text().split())
        for figure in re.findall(r"\d+\.\d+", said):
            assert figure in text, (claim, figure, page.name)
