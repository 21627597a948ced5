"""What is said of the axes of cpu-full and of its model on latents, and of where things stand in models of eight
robots, follows from what is kept of them."""

import csv
import itertools
import json
import math
import re
from collections import defaultdict

import numpy as np
import pytest
from scipy import stats

from experiments.analysis.compare import Side, overall_difference
from experiments.analysis.controllability import ROUNDING
from experiments.analysis.preregistered import FILE, Expected, read_expected
from experiments.analysis.rows import OVERALL, CurvePoint, all_series, curve, difference
from experiments.applications.detector import CLOSE_PX
from experiments.applications.in_place import in_place
from experiments.report.findings import read_findings
from experiments.running.result_file import read_result
from experiments.running.trial import trial_id
from experiments.running.workspace import Workspace, load_record
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import CONTROL, POINT, STANDARD
from hma_jax.evaluation.windows import FILE as WINDOWS
from hma_jax.evaluation.windows import WindowTable
from tests.experiments.committed_findings import (
    ACTING,
    RESULTS,
    ROOT,
    counts,
    findings,
    in_place_rows,
    paired,
    readme,
    robots_at,
    rows_of,
)
from tests.pages import table


def test_the_first_axis_by_how_much_data_a_robot_has_is_as_its_findings_say():
    folder = RESULTS / "cpu-full-horizon"
    windows = {name: d["windows"] for name, d in json.loads((folder / "data.json").read_text()).items()}
    rows = [r for r in rows_of(folder.name) if r.metric == "cross_entropy" and r.role == "point"]
    page = findings("cpu-full-horizon")
    for least, most in ((0, 400), (400, 2000), (2000, 10**9)):
        mine = [r for r in rows if least <= windows.get(r.scope, -1) < most]
        means = [np.mean([r.mean for r in mine if r.x == n]) for n in (500, 1000, 2000, 4000, 8000, 16_000)]
        line = " | ".join([str(len({r.scope for r in mine})), *(f"{mean:.2f}" for mean in means)])
        assert f"| {line} |" in page, line


def horizon_rows() -> list[str]:
    """The lines of findings.md on the axis `horizon` of cpu-full."""
    curves = {m: {p.x: p for p in curve(rows_of(), "horizon", m)} for m in ("cross_entropy", "psnr")}
    lines = []
    for x, (robots, trials) in robots_at("cpu-full", "horizon").items():
        follow = [r.follows for r in robots if r.name in ACTING]
        cells = [
            f"{x:,}", trials if trials > 1 else f"{trials} †", *(f"{points[x].mean:.2f}" for points in curves.values()), *counts(robots),
            *(f"{np.mean([f[metric].mean for f in follow]):.2f}" for metric in ("action_nats", "retrieval")),
        ]  # fmt: skip
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines


def test_the_axis_horizon_is_as_findings_say():
    page, lines = findings(), horizon_rows()
    for line in lines:
        assert line in page, line
    of_steps = next(line for line in lines if "| 16,000 |" in line).strip("| ").split(" | ")
    steps, seeds, _, psnr, ahead, follow, changed, *_ = of_steps
    table = rows_of()
    (copying,) = {f"{r.mean:.2f}" for r in table if (r.sweep, r.scope, r.metric) == ("horizon", OVERALL, "psnr_copy")}
    said = f"three seeds of {steps} steps: {psnr} dB, copying {copying}; better on {ahead} of 40 robots |"
    assert seeds == "3" and said in readme()
    ((control, _),) = robots_at("cpu-full", "horizon", CONTROL).values()
    _, *by_chance = counts(control)
    said = (
        f"raise the loss by more than 3 standard errors on all {follow} robots with actions (control of 4,000 steps: "
        f"{by_chance[0]}); random ones lower PSNR by more than 2 on {changed} (control: {by_chance[1]}) |"
    )
    assert follow == "36" and said in readme(), said
    trained = {steps: trials for steps, (_, trials) in robots_at("cpu-full", "horizon").items()}
    ((_, controls),) = robots_at("cpu-full", "horizon", CONTROL).values()
    assert trained[16_000] == 3 and trained[32_000] == controls == 1
    assert "three seeds (one for controls and ≥32,000 steps);" in readme()
    assert f"PSNR, copying {copying} dB" in page
    alone = [counts(robots_at("cpu-full", "horizon", seed=seed, at=16_000)[16_000][0])[2] for seed in (0, 1, 2)]
    said = "Counted so, the single seeds of 16,000 steps have ΔPSNR beyond 2 on {}, {} and {} robots."
    assert said.format(*alone) in " ".join(page.split())


def test_robots_that_do_not_stay_robots_are_as_findings_say():
    page, shares, medians = " ".join(findings().split()), {}, {}
    for steps in (4000, 32_000):
        rows = in_place_rows(str(steps))
        kinds = {"all": rows, "tool": [r for r in rows if r["what"].startswith("tool")]}
        kinds["object"] = [r for r in rows if r["what"].startswith("colour")]
        for kind, mine in kinds.items():
            for view in ("model", "true", "still"):
                share, half, robots = in_place(mine, view)
                assert robots == 36
                shares[steps, kind, view] = f"{share:.1%} ± {half:.1%}".replace("% ±", " ±").replace("%", " %")
        moved = [r for r in rows if float(r["moved_px"]) > CLOSE_PX]
        off = [[float(r[f"{view}_px"]) for r in moved] for view in ("model", "still")]
        medians[steps] = [f"{np.median(pixels) / 2:.1f}" for pixels in off]
    said = (
        "finds {true} of what moved within 2 pixels of 32 of its place in the last true frame of a window, in the "
        "model's {late} after 32,000 steps and {early} after 4,000 (36 robots, each weighed alike, 95 %), in a still "
        "picture {still}. Of tools it is {tools}, of objects {objects}:"
    ).format(
        true=shares[32_000, "all", "true"], still=shares[32_000, "all", "still"],
        late=shares[32_000, "all", "model"], early=shares[4000, "all", "model"],
        tools=shares[32_000, "tool", "model"], objects=shares[32_000, "object", "model"],
    )  # fmt: skip
    assert said in page, said
    late = float(shares[32_000, "all", "model"].split()[0])
    assert f"do moving parts end in the right place? | {late:.0f} % after 32,000 steps;" in readme()
    assert "half of it is more than {} pixels off, in a still picture {}".format(*medians[32_000]) in page


def test_what_knowing_robots_is_worth_to_new_ones_is_as_findings_say():
    rows, page = rows_of(), " ".join(findings().split())
    found = {
        name: curve(rows, "fewshot", "cross_entropy", series=series)
        for name, series in {
            "new": "from scratch", "5": "after 5 robots", "20": "after 20 robots", "40": "after 40 robots",
            "whole": "after 40 robots, everything trained",
        }.items()
    }  # fmt: skip

    def behind(a: str, b: str) -> list[tuple[float, float]]:
        return [difference(p, q) for p, q in zip(found[a], found[b], strict=True)]

    four, sixteen, all_of_them = (f"{mean:.2f} ± {error:.2f}" for mean, error in behind("new", "40"))
    assert f"**Knowing 40 robots is worth {four}, {sixteen} and {all_of_them} nats**" in page
    for a, b in (("20", "40"), ("5", "20")):
        steps = [mean for mean, _ in behind(a, b)]
        assert f"{min(steps):.2f} to {max(steps):.2f} ahead" in page, (a, b, steps)
    _, (worse, error), (level, beside) = behind("5", "new")
    assert f"({level:.2f} ± {beside:.2f} behind) and {worse:.2f} ± {error:.2f} behind it with 16" in page
    first, second, third = (mean for mean, _ in behind("whole", "40"))
    said = (
        f"training all is {-third:.2f} ahead with 64 trajectories, {second:.2f} behind with 16, and {first:.2f} behind"
    )
    assert f"{said} with 4" in page, said


def rates_rows() -> list[str]:
    """The lines of findings.md on the axis `lr` of cpu-full, of held-out nats."""
    with open(RESULTS / "cpu-full" / "optima.csv", newline="") as file:
        found = [r for r in csv.DictReader(file) if (r["sweep"], r["metric"]) == ("lr", "cross_entropy")]
    lines = []
    for r in found:
        best, low, high, nats, moved = (float(r[name]) for name in ("x", "near_low", "near_high", "loss", "moved"))
        mean, least, most = (f"{float(r[f'penalty{which}']):z.3f}" for which in ("", "_low", "_high"))
        near = "" if low == high else f"{low:.3g} to {high:.3g}"
        words = {"point": "muP", "standard": "standard"}[r["role"]]
        cells = [words, r["series"].removeprefix("width "), f"{best:.3g}", near, f"{moved:+.0f}" if moved else "0"]
        lines.append(f"| {' | '.join([*cells, f'{nats:.3f}', f'{mean} ({least} to {most})'])} |")
    return lines


def test_the_axis_lr_is_as_findings_say():
    page, lines = findings(), rates_rows()
    assert len(lines) == 6
    for line in lines:
        assert line in page, line
    moved = {"muP": [], "standard": []}
    for line in lines:
        cells = line.strip("| ").split(" | ")
        moved[cells[0]].append(int(cells[4]))
    assert {way: max(steps) - min(steps) for way, steps in moved.items()} == {"muP": 1, "standard": 4}


def test_how_far_the_best_rate_moves_seed_by_seed_is_as_findings_say():
    page, curves = " ".join(findings().split()), {}
    for role, width in itertools.product((POINT, STANDARD), (16, 64)):
        curves[role, width] = curve(rows_of(), "lr", "cross_entropy", role, series=f"width {width}")
    best = {key: [min(points, key=lambda p: p.seeds[s]).x for s in range(3)] for key, points in curves.items()}
    down = {
        role: [round(2 * math.log2(a / b)) for a, b in zip(best[role, 16], best[role, 64], strict=True)]
        for role in (POINT, STANDARD)
    }
    assert down == {POINT: [1, -1, 1], STANDARD: [4, 2, 4]}
    assert "moves one step down, one up and one down. **Without muP it falls, by two to four steps**" in page
    assert (
        "moves by one step of √2 with muP, by two to four without, seed by seed |"
        in (ROOT / "docs" / "results.md").read_text()
    )
    said = "from {:.3g}, {:.3g} and {:.3g} at width 16 to {:.3g}, {:.3g} and {:.3g} at 64."
    assert said.format(*best[STANDARD, 16], *best[STANDARD, 64]) in page
    at = {round(p.x, 4): p.seeds for p in curves[STANDARD, 64]}
    behind = [at[0.0113][s] - at[0.0057][s] for s in range(3)]
    said = f"by {np.mean(behind):.2f} nats ({min(behind):.2f} to {max(behind):.2f}, seed by seed)"
    assert said in page, said


def test_which_width_is_ahead_at_equal_compute_is_as_findings_say():
    workspace = Workspace(RESULTS / "cpu-full")
    record = load_record(workspace)
    (sweep,) = plan_sweeps(record.study, ("compute",))
    found: dict[str, dict[float, dict[int, WindowTable]]] = {}
    for p in sweep.points:
        if p.role == POINT and p.x in (24, 32):
            table = WindowTable.load(workspace.trials / trial_id(p.trial, record.provenance) / WINDOWS)
            found.setdefault(p.series, {}).setdefault(p.x, {})[p.trial.train.seed] = table
    ahead = [
        overall_difference(Side("32", of[32], ""), Side("24", of[24], ""), "cross_entropy", sweep.scope)
        for of in found.values()
    ]
    first, second, third, last = (f"{d.mean:.2f} ({d.low:.2f} to {d.high:.2f})" for d in ahead)
    assert [d.low > 0 for d in ahead] == [False, True, False, False]
    said = f"significantly only at 3.2 TFLOP: it is ahead of 32 by {first}, {second}, {third} and {last} nats (95 %,"
    assert said in " ".join(findings().split()), said


IDS = {"cross_entropy": 3, "psnr": 2, "action_nats": 2, "delta_psnr": 2}
LATENTS = {"diffusion_loss": 4, "psnr": 2, "action_nats": 4, "delta_psnr": 2}
"""Metrics of a table in findings.md, and their digits."""


def axis_rows(sweep: str, study: str = "cpu-full", metrics: dict[str, int] = IDS) -> list[str]:
    """The lines of findings.md on an axis of a study with one curve: means over seeds and judged robots."""
    rows, digits = rows_of(study), tuple(metrics.values())
    lines = []
    for role in (POINT, CONTROL):
        curves = [curve(rows, sweep, m, role) for m in metrics]
        for points in zip(*curves, strict=True):
            x = points[0].label or f"{points[0].x:,.0f}"
            cells = [x + ", control" * (role == CONTROL), str(len(points[0].seeds))]
            # no minus before zero
            cells += [f"{round(p.mean, n) + 0.0:.{n}f}" for p, n in zip(points, digits, strict=True)]
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def gains() -> dict[str, dict[int, str]]:
    """{sweep: {robots: nats beside those of forty, mean and standard error over seeds}} of the designs over robots."""
    rows = rows_of()
    found: dict[str, dict[int, str]] = {}
    for sweep in ("dilution", "transfer"):
        *fewer, forty = curve(rows, sweep, "cross_entropy")
        apart = {round(point.x): difference(point, forty) for point in fewer}
        found[sweep] = {count: f"{mean:+.2f} ± {error:.2f}" for count, (mean, error) in apart.items()}
    return found


def exponents() -> list[float]:
    """a of every trial of N robots: after S steps it has the loss of forty after S (40 / N)^a."""
    rows = [r for r in rows_of() if (r.metric, r.role) == ("cross_entropy", POINT)]
    robots = [r for r in rows if r.scope != OVERALL]
    steps = {"dilution": lambda x: 4000.0, "transfer": lambda x: 100 * x}
    found = []
    for seed in (0, 1, 2):
        five = {r.scope for r in robots if (r.sweep, r.x, r.seed) == ("dilution", 5, seed)}
        nats = {}
        for r in robots:
            if r.sweep == "horizon" and r.scope in five:
                nats.setdefault(r.x, []).append(r.mean)
        along = sorted(nats)
        means = [-np.mean(nats[x]) for x in along]  # of all seeds of the forty
        for r in rows:
            if r.sweep in steps and (r.scope, r.seed) == (OVERALL, seed) and r.x < 40:
                as_far = np.exp(np.interp(-r.mean, means, np.log(along)))
                found.append(np.log(as_far / steps[r.sweep](r.x)) / np.log(40 / r.x))
    return found


def test_how_many_robots_a_deaf_model_has_far_above_zero_is_as_findings_say():
    with open(RESULTS / "cpu-full" / "controllability.csv", newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["role"] == CONTROL and float(r["sem"]) > ROUNDING]
    page = " ".join(findings().split())

    def counted(metric: str, bound: int) -> tuple[int, float, float]:
        """How many robots are above this many standard errors, how many by chance, and how often as many by chance."""
        own = [r for r in rows if r["metric"] == metric]
        assert len(own) == 36
        found, chances = sum(float(r["errors"]) > bound for r in own), np.ones(1)
        by_chance = [stats.t.sf(bound, int(r["episodes"]) - 1) for r in own]
        for p in by_chance:
            chances = np.convolve(chances, [1 - p, p])
        return found, sum(by_chance), 100 * chances[found:].sum()

    nats, expected, often = counted("action_nats", 3)
    assert f"action-nats beyond 3 of them on {nats} of the 36" in page
    assert f"{expected:.1f} of them beyond 3 standard errors (two or more in {often:.0f} of 100 cases)" in page
    psnr, expected, often = counted("delta_psnr", 2)
    assert f"ΔPSNR beyond 2 on {psnr} (one of these at 2.01" in page and (nats, psnr) == (2, 4)
    assert f"{expected:.1f} beyond 2 (four or more in {often:.0f} of 100)" in page


@pytest.mark.parametrize("study", ["cpu", "cpu-full", "cpu-full-continuous", "cpu-full-horizon"])
def test_intervals_of_retrieval_are_those_of_a_share(study):
    """Some reached beyond 1, some had no width at 1, and rounding made errors of 1e-16."""
    with open(RESULTS / study / "controllability.csv", newline="") as file:
        rows = [{k: float(r[k]) for k in ("sem", "low", "high", "mean")} for r in csv.DictReader(file)]
        file.seek(0)
        retrieval = [row for row, r in zip(rows, csv.DictReader(file), strict=True) if r["metric"] == "retrieval"]
    assert all(row["sem"] == 0 or row["sem"] > 1e-14 for row in rows)
    assert retrieval and all(0 <= row["low"] <= row["mean"] <= row["high"] <= 1 for row in retrieval)
    assert all(row["low"] < row["high"] for row in retrieval if row["mean"] in (0, 1))


def test_what_sharing_and_company_cost_is_as_findings_say():
    found, page = gains(), findings().splitlines()
    expected = expectations()
    for count in (5, 10, 20):
        cells = [str(count)]
        for sweep in ("dilution", "transfer"):
            e = expected[sweep, "", str(count)]
            cells += [f"{e.mean:+.2f} ({e.low:+.2f} to {e.high:+.2f})", f"**{found[sweep][count]}**"]
        assert f"| {' | '.join(cells)} |" in page, cells
    a = exponents()
    said = f"a = {min(a):.1f} to {max(a):.1f}, {np.mean(a):.1f} on average"
    assert said in " ".join(" ".join(page).split()), said


def test_what_was_found_is_as_readme_says():
    root = RESULTS / "cpu-full"
    text = readme()
    width_64 = json.loads((root / "predictions" / "width-64.json").read_text())
    predicted = "{mean:.3f} nats ({low:.3f} to {high:.3f}, 90 %)".format(**width_64)
    came = next(line for line in axis_rows("width") if line.startswith("| 64 |")).split(" | ")[2]
    assert f"predicted at {predicted} before it ran, came to {came}" in text
    alone, company = (gains()[sweep][5].split()[0][1:] for sweep in ("dilution", "transfer"))
    bring = f"lower it by {company} if they bring their own (the five alone, trained as long, are {alone} ahead)"
    assert f"raise the loss of five by {alone} nats if they share" in text and bring in text
    poor = {p.label: p for p in curve(rows_of(root.name), "newcomers", "cross_entropy")}
    gained, error = difference(poor["alone"], poor["all robots"])
    (control,) = curve(rows_of(root.name), "newcomers", "cross_entropy", CONTROL)
    assert control.mean < poor["all robots"].mean
    claimed = "(no transfer claimed: shuffled actions do better)"
    assert f"{gained:.2f} if the five have 8 trajectories each {claimed}" in text
    assert f"**Training with all robots is worth {gained:.2f} ± {error:.2f} nats**" in findings()


def test_which_size_is_best_for_a_budget_is_as_readme_and_findings_say():
    """It was said to grow, with an interval that the form of the fit had made: the lowest loss is at one width."""
    budgets = all_series(rows_of(), "compute")[POINT]
    curves = [curve(rows_of(), "compute", "cross_entropy", series=series) for series in budgets]
    assert {min(points, key=lambda p: p.mean).x for points in curves} == {24}
    assert {len(points) for points in curves} == {5} and len(curves) == 4
    assert "best of five widths: 24 at all four budgets; whether it grows is undecided |" in readme()
    with open(RESULTS / "cpu-full" / "fits.csv", newline="") as file:
        law, near = (
            {name: float(r[name]) for name in ("value", "low", "high")} | {"doubts": r["doubts"]}
            for r in csv.DictReader(file)
            if r["curve"] == "isoflop"
        )
    for doubt in ("the three sizes around each best one alone give", "have the lowest loss at every budget"):
        assert doubt in law["doubts"]
    said = "as C^{value:.2f} ({low:.2f} to {high:.2f} with 90 %) by parabolas through all five sizes, as".format(**law)
    said += " C^{value:.2f} ({low:.2f} to {high:.2f}) by those through the three around the best one".format(**near)
    assert said in " ".join(findings().split()), said


def test_the_curve_over_robots_in_the_mixture_is_as_findings_say():
    with open(RESULTS / "cpu-full" / "fits.csv", newline="") as file:
        rows = {r["coefficient"]: r for r in csv.DictReader(file) if r["curve"] == "transfer"}
    e, alpha = ([f"{float(rows[name][column]):.2f}" for column in ("value", "low", "high")] for name in ("E", "alpha"))
    said = f"flattens to {e[0]} nats ({e[1]} to {e[2]} with 90 %; exponent {alpha[0]}, {alpha[1]} to {alpha[2]})"
    assert said in " ".join(findings().split()), said


OF_ONE_CURVE = [
    (sweep, "cpu-full") for sweep in ("width", "dilution", "transfer", "newcomers", "settings", "conditioning")
]


@pytest.mark.parametrize(("sweep", "study"), [*OF_ONE_CURVE, ("ladder", "ladder")])
def test_an_axis_of_one_curve_is_as_findings_say(sweep, study):
    page, lines = findings(study), axis_rows(sweep, study)
    assert len(lines) >= 4
    for line in lines:  # further columns may follow
        assert line.removesuffix("|") in page, line


def test_what_was_predicted_of_conditioning_is_as_findings_say():
    page = findings()
    lines = page.splitlines()
    for (sweep, _, x), e in expectations().items():
        if sweep == "conditioning":
            d = paired("cpu-full", "conditioning", x, e.against, "cross_entropy")
            said = f"{e.mean:.2f}" if e.low <= d.mean <= e.high else f"**{e.mean:.2f}**"
            line = f" | {d.mean:+.3f} ± {d.sem:.3f} | {said} ({e.low:.2f} to {e.high:.2f}) |"
            assert any(row.startswith(f"| {x} |") and row.endswith(line) for row in lines), line
    d = paired("cpu-full", "conditioning", "cross_attention", "add", "cross_entropy")
    said = f"`cross_attention` is {-d.mean:.3f} ± {d.sem:.3f} nats ahead of `add`"
    assert said in " ".join(page.split()) and d.high < 0


def test_what_seeing_and_predicting_actions_is_worth_is_as_findings_say():
    page = " ".join(findings().split())
    passive, full = (
        paired("cpu-full", "settings", name, "forward dynamics", "cross_entropy")
        for name in ("passive", "full dynamics")
    )
    assert f"worth {passive.mean:.2f} ± {passive.sem:.2f} nats** after 8,000 windows" in page
    assert f"full dynamics is {full.mean:.2f} ± {full.sem:.2f} nats behind forward" in page


def test_what_doublings_of_steps_gain_is_as_findings_say():
    """Means over the seeds of both, of the last the one seed that it has."""
    points = {p.x: p for p in curve(rows_of(), "horizon", "cross_entropy")}
    first, *later, last = (difference(points[x], points[2 * x])[0] for x in sorted(points)[:-1])
    assert first < min(later) and max(later) == later[-1] and last < first
    said = (
        f"gains {first:.2f} nats on average, each of those up to 16,000 steps more, the one from 8,000 the most, "
        f"{later[-1]:.2f}; the last, to 32,000, one seed, gains {last:.2f}."
    )
    assert said in " ".join(findings().split()), said


def test_what_was_predicted_of_newcomers_and_settings_is_as_findings_say():
    page = findings()
    for (sweep, _, x), e in expectations().items():
        interval = f"({e.low:g} to {e.high:g})" if not e.against else f"({e.low:.2f} to {e.high:.2f})"
        if sweep == "newcomers":
            [line] = [line for line in page.splitlines() if line.startswith(f"| {x} |")]
            assert line.endswith(f"| {e.mean:g} {interval} |"), line
        if sweep == "settings":
            section = " ".join(page[page.index("## `settings`") :].split())
            assert re.search(rf"{e.mean:.2f}( nats| behind it)? {re.escape(interval)}", section), (x, interval)


def test_the_reference_on_latents_is_as_its_findings_say():
    study = "cpu-full-continuous"
    page = " ".join(findings(study).split())
    told = [counts(robots) for role in (POINT, CONTROL) for robots, _ in robots_at(study, "horizon", role).values()]
    lines = axis_rows("horizon", study, LATENTS)
    for line, said in zip(lines, told, strict=True):
        assert f"{line.removesuffix(' |')} | {' | '.join(map(str, said))} |" in page, (line, said)
    ((robots, _),) = robots_at(study, "horizon").values()
    beyond = sum(r.follows["delta_psnr"].errors > 3 for r in robots if r.name in ACTING)
    gain = np.mean([r.ahead for r in robots])
    assert f"{gain:.2f} dB ahead of copying" in page and f"ΔPSNR beyond 3 on {beyond} of the 36" in page
    (psnr,) = curve(rows_of(study), "horizon", "psnr")
    ids = next(p for p in curve(rows_of(), "horizon", "psnr") if p.x == psnr.x)
    said = "| three seeds of {:,.0f} steps: {:.2f} dB, ids {:.2f} by another recipe; undecided ("
    assert said.format(psnr.x, psnr.mean, ids.mean) in readme() and len(psnr.seeds) == len(ids.seeds) == 3
    for e in read_expected(RESULTS / study / "predictions" / FILE):
        (point,) = curve(rows_of(study), "horizon", e.metric)
        came = f"{point.mean:.2f}" if e.low <= point.mean <= e.high else f"**{point.mean:.2f}**"
        assert f"| {e.metric} | {e.mean:g} ({e.low:g} to {e.high:g}) | {came} |" in page, (e.metric, came)


def test_where_things_stand_at_the_end_is_as_the_page_on_designs_says():
    page = table(ROOT / "docs" / "designs.md", "| model | in place |")
    found = {re.search(r"in_place/([\w-]+)\.csv", label)[1]: cells for label, cells in page.items() if ".csv" in label}
    assert found.keys() == {"32000", "ladder-64000", "weighed", "grown"}
    for name, cells in found.items():
        rows = in_place_rows(name)
        kinds = (rows, *([r for r in rows if r["what"].startswith(kind)] for kind in ("tool", "colour")))
        (whole, half, _), (tools, *_), (objects, *_) = (in_place(kind, "model") for kind in kinds)
        assert cells == [f"{100 * whole:.0f} ± {100 * half:.0f} %", f"{100 * tools:.0f} %", f"{100 * objects:.0f} %"], (
            name
        )
    served = in_place_rows("grown")
    assert (
        page["true frames as the last one's tokenizer shows them"][0] == f"{100 * in_place(served, 'tokens')[0]:.0f} %"
    )
    for name in ("weighed", "grown"):
        rows = in_place_rows(name)
        (true, _, robots), (still, *_) = in_place(rows, "true"), in_place(rows, "still")
        assert robots == 8 and true == 1 and still < 0.01


def test_the_stronger_recipe_is_as_good_as_the_pages_say_that_measured_it():
    """docs/own_data.md beside the tables that its rows link to, which other tests hold."""
    rows = table(ROOT / "docs" / "own_data.md", "| setting | what it did, on simulated robots |")
    effects = {re.search(r"`(\w+)", setting)[1]: cells[0] for setting, cells in rows.items()}
    header = "| | seeds | nats per token | PSNR | action-nats | ΔPSNR, dB |"
    conditioning = table(RESULTS / "cpu-full" / "findings.md", f"{header} nats behind")
    ladder = table(RESULTS / "ladder" / "findings.md", header)
    nats = [conditioning[f"concat+modulate{how}"][3] for how in ("", ", released alignment")]
    assert f"{nats[0]} nats per token instead of {nats[1]}" in effects["action_alignment"]
    teacher = (ROOT / "docs" / "models.md").read_text()
    forced, released = (
        re.search(rf"\| {how} \| {steps} \| [^|]+ \| ([\d.]+) \| ([\d.]+) \|", teacher).groups()
        for how, steps in (("teacher forcing", "4,000"), ("as released", "8,000"))
    )
    assert f"perplexity {forced[0]} instead of {released[0]}" in effects["teacher_forcing"]
    assert f"action-nats {forced[1]} instead of {released[1]}" in effects["teacher_forcing"]
    plain, both = (ladder[f"{name}, 4,000 steps"] for name in ("reference", "recall, Muon"))
    assert f"{float(plain[1]) - float(both[1]):.2f} nats less after 4,000 steps, {both[6]} robots" in effects["recall"]
    assert both[6] == plain[6]
    changes, long = (
        [ladder[f"recall, Muon{more}, {steps} steps"] for more in (", changes thrice", "")]
        for steps in ("4,000", "32,000")
    )
    page = " ".join((ROOT / "docs" / "own_data.md").read_text().split())
    said = (
        f"ΔPSNR came to {changes[0][4]} dB instead of {changes[1][4]} after 4,000 steps, and to {long[0][4]} instead of "
        f"{long[1][4]} after 32,000 (one seed), with {{}} nats more"
    )
    nats = {f"{float(thrice[1]) - float(once[1]):.2f}" for thrice, once in (changes, long)}
    assert len(nats) == 1 and said.format(*nats) in page, said
    assert "change_weight" not in "".join(re.findall("```sh(.*?)```", page))


def expectations() -> dict[tuple[str, str, str], Expected]:
    """{(axis, curve, x): what was written down before}."""
    return {(e.sweep, e.series, e.x): e for e in read_expected(RESULTS / "cpu-full" / "predictions" / FILE)}


def grid_rows(sweep: str, digits: int) -> list[str]:
    """The lines of findings.md on an axis of several curves: held-out nats along each, or how far behind another point
    where that was predicted, in brackets what was predicted, bold where that did not hold."""
    rows, expected = rows_of(), expectations()
    lines = []
    for series in dict.fromkeys(r.series for r in rows if (r.sweep, r.role) == (sweep, POINT)):
        cells = [series]
        points = {f"{p.x:g}": p for p in curve(rows, sweep, "cross_entropy", series=series)}
        for x, point in points.items():
            e = expected.get((sweep, series, x))
            mean = difference(point, points[e.against])[0] if e is not None and e.against else point.mean
            came = f"{mean:.{digits}f}"
            if e is not None:
                came += f" ({e.mean:.{digits}f})" if e.low <= mean <= e.high else f" (**{e.mean:.{digits}f}**)"
            cells.append(came)
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def test_what_stands_between_the_tables_is_as_findings_say():
    """Single numbers that no line of a table holds."""
    page, rows = " ".join(findings().split()), rows_of()

    def point(sweep: str, metric: str, x: float | str, role: str = POINT, series: str = "") -> CurvePoint:
        return next(p for p in curve(rows, sweep, metric, role, series=series) if x in (p.x, p.label))

    *others, narrowest = (point("compute", "action_nats", x, series="1.3e+13 FLOP").mean for x in (24, 32, 48, 64, 16))
    said = "{:.2f} at width 24, {:.2f} at 32, {:.2f} at 48 and {:.2f} at 64".format(*others)
    assert said in page and f"a model is too narrow: {narrowest:.2f} at 16." in page
    early = point("horizon", "delta_psnr", 2000)
    assert f"told from zero after 2,000 steps, {early.mean:.2f} ± {early.sem:.2f} dB" in page
    whole = point("fewshot", "delta_psnr", 4, series="after 40 robots, everything trained")
    few = [
        p for series in all_series(rows, "fewshot")[POINT] for p in curve(rows, "fewshot", "delta_psnr", series=series)
    ]
    few = [p for p in few if p.x == 4]
    assert max(few, key=lambda p: p.mean) == whole and all(abs(p.mean) < 2 * p.sem for p in few) and len(few) == 5
    assert f"the highest, where everything is trained, is {whole.mean:.2f} ± {whole.sem:.2f} dB" in page

    there = json.loads((RESULTS / "cpu-full" / "data.json").read_text())
    judged = {r.scope for r in rows if r.sweep == "newcomers" and r.of_robot}
    eight = [8 * there[name]["windows"] / there[name]["episodes"] for name in judged]
    assert f"have 8 trajectories each, on average {min(eight):.0f} to {max(eight):.0f} windows;" in page

    def seed_0(sweep: str, metric: str, x: float | str, series: str = "") -> tuple[float, float]:
        """Of the control and of the same seed on true actions."""
        return tuple(point(sweep, metric, x, role, series).seeds[0] for role in (CONTROL, POINT))

    rich = [difference(*(point("newcomers", m, x) for x in ("all robots", "alone"))) for m in ("psnr", "delta_psnr")]
    said = "{:.2f} ± {:.2f} dB of PSNR ({:.2f} ± {:.2f} dB of ΔPSNR)".format(*rich[0], *rich[1])
    assert said in page, said
    shuffled, true = seed_0("newcomers", "cross_entropy", "all robots")
    said = f"come to {shuffled:.2f} nats on its five, {true - shuffled:.2f} *better* than the same seed with true ones"
    assert f"{said} ({true:.2f}), at the same PSNR" in page
    shuffled, true = (
        point("episodes", "cross_entropy", 160, *of).seeds[0] for of in ((CONTROL,), (POINT, "4,000 steps"))
    )
    frames = [point("episodes", "psnr", 160, *of).seeds[0] for of in ((CONTROL,), (POINT, "4,000 steps"))]
    said = f"4 trajectories come to {shuffled:.2f} nats where true ones come to {true:.2f}, at {frames[0]:.2f} and"
    shuffled, true = seed_0("horizon", "cross_entropy", 4000)
    assert f"{said} {frames[1]:.2f} dB. With all trajectories true ones are {shuffled - true:.2f} ahead." in page


WRITTEN = {
    "cf4c56d": "2026-11-23 19:28:07",
    "8eb94f8": "2026-11-23 22:56:16",
    "3b2a34a": "2026-11-24 02:15:29",
    "57fc8b1": "2026-11-24 02:45:13",
    "e228d04": "2026-11-24 02:47:35",
    "ceeb3d9": "2026-11-24 09:55:45",
    "48418f4": "2026-11-24 12:30:01",
    "f6dfe0d": "2026-11-25 01:17:35",
    "27d7987": "2026-11-24 21:25:20",
    "1828eaa": "2026-11-24 22:06:09",
    "b067155": "2026-11-25 00:33:35",
    "8663244": "2026-11-25 04:31:55",
    "e323bb1": "2026-11-25 16:48:04",
    "0c65072": "2026-11-25 21:27:03",
    "64e33cf": "2026-11-25 21:35:14",
}
"""Commit of an expectation -> when it was made, as `git log` has it."""


@pytest.mark.parametrize("study", ["cpu-full", "cpu-full-continuous", "ladder"])
def test_what_had_run_when_it_was_expected_is_marked_as_known(study):
    """Two intervals for three seeds were written around the first, which had run: both counted as predictions."""
    points = defaultdict(dict)
    for r in rows_of(study):
        if r.role == POINT:
            points[r.sweep, r.series, r.label or f"{r.x:g}"][r.seed] = r.trial
    for e in read_expected(RESULTS / study / "predictions" / FILE):
        trials = points[e.sweep, e.series, e.x]
        ended = {s: read_result(RESULTS / study / "trials" / trials[s])["run"]["finished"] for s in e.seeds or trials}
        before = {s for s, end in ended.items() if end < f"{WRITTEN[e.commit]} +0000"}
        assert before == set(e.known) and all(end.endswith(" +0000") for end in ended.values()), e


@pytest.mark.parametrize("study", ["cpu-full", "cpu-full-continuous", "ladder"])
def test_the_page_of_a_study_shows_its_findings(study):
    """As they are, and not as they were when it was drawn."""
    workspace = Workspace(RESULTS / study)
    said = read_findings(workspace.root / "findings.md", load_record(workspace).axes)
    page = workspace.report.read_text()
    assert said.of_axes and all(text in page for text in (*said.of_axes.values(), said.rest))


FAMILIES = [("lr_horizon", 3, 2), ("compute", 2, 4), ("episodes", 2, 3), ("fewshot", 2, 5)]


@pytest.mark.parametrize(("sweep", "digits", "curves"), FAMILIES)
def test_an_axis_of_several_curves_is_as_findings_say(sweep, digits, curves):
    page, lines = findings(), grid_rows(sweep, digits)
    assert len(lines) == curves
    for line in lines:
        assert line in page, line
