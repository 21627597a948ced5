"""What findings.md of the ladder says follows from what is kept of its trials."""

import json
import re

import numpy as np
import pytest

from experiments.analysis.compare import Side, compare
from experiments.analysis.preregistered import FILE, compare_expected, read_expected
from experiments.analysis.rows import OVERALL, curve, difference
from experiments.applications.in_place import in_place
from experiments.sweeps.sweep import CONTROL
from hma_jax.evaluation.windows import FILE as WINDOWS
from hma_jax.evaluation.windows import WindowTable
from tests.experiments.committed_findings import (
    RESULTS,
    counts,
    findings,
    in_place_rows,
    paired,
    readme,
    robots_at,
    rows_of,
)


def test_what_was_predicted_of_the_ladder_is_as_its_findings_say():
    """Bold where it did not hold."""
    page, expected = findings("ladder"), list(read_expected(RESULTS / "ladder" / "predictions" / FILE))
    came_true = [c for c in compare_expected(expected, rows_of("ladder")) if c.inside]
    marked = sum(bool(c.expected.known) for c in came_true)
    said = f"Of {len(expected)} intervals {len(came_true)} hold. {('No', 'One', 'Two')[marked]} of these, marked,"
    assert said in " ".join(page.split()), said
    for c in compare_expected(expected, rows_of("ladder")):
        e, came = c.expected, "not run"
        if c.observed is not None:
            came = f"{c.observed:+.2f}" if e.against else f"{c.observed:.2f}"
            came = came if c.inside else f"**{came}**"
        about = f" beside {e.against}" * bool(e.against) + "".join(f", seed {seed}" for seed in e.seeds)
        about += "".join(f", seed {seed} known" for seed in e.known)
        assert f"| {e.x}{about} | {e.metric} | {e.mean:g} ({e.low:g} to {e.high:g}) | {came} |" in page, (e.x, came)


def test_what_counting_changes_thrice_gives_is_as_findings_of_the_ladder_say():
    page, early, late, tenfold = " ".join(findings("ladder").split()), {}, {}, {}
    for metric in ("cross_entropy", "psnr", "action_nats", "delta_psnr"):
        points = {p.label.removeprefix("recall, Muon, "): p for p in curve(rows_of("ladder"), "ladder", metric)}
        d = paired("ladder", "ladder", *(f"recall, Muon, {x}4,000 steps" for x in ("changes thrice, ", "")), metric)
        assert d.seeds == 3
        early[metric] = f"{d.mean:.3f} ± {d.sem:.3f}"
        late[metric], _ = difference(points["changes thrice, 32,000 steps"], points["32,000 steps"])
        tenfold[metric] = [
            difference(points[f"changes {n}, 4,000 steps"], points["4,000 steps"])[0] for n in ("thrice", "tenfold")
        ]
    said = "{cross_entropy} nats are lost; {psnr} dB of PSNR, {action_nats} action-nats and {delta_psnr} dB of ΔPSNR are gained"
    assert said.format(**early) in page
    said = "{psnr:+.2f} dB of PSNR, {action_nats:+.2f} action-nats, {delta_psnr:+.2f} dB of ΔPSNR, and of what moved"
    assert said.format(**late) in page and f"{late['cross_entropy']:.2f} nats are still lost" in page
    assert 4.5 < tenfold["cross_entropy"][1] / tenfold["cross_entropy"][0] < 5.5
    shares = [in_place(in_place_rows(name), "model") for name in ("ladder-thrice", "ladder")]
    said = "{:.1f} ± {:.1f} % in place, {:.1f} ± {:.1f} % without"
    assert said.format(*(100 * x for mean, half, _ in shares for x in (mean, half))) in page


def test_what_other_steps_of_the_ladder_give_is_as_its_findings_say():
    page, both = " ".join(findings("ladder").split()), "recall, Muon"

    def said(a: str, b: str, metric: str, digits: str = ".3f") -> str:
        d = paired("ladder", "ladder", a, b, metric)
        assert d.seeds == 3
        return f"{abs(d.mean):{digits}} ± {d.sem:{digits}}"

    long, chained = f"{both}, 4,000 steps", f"{both}, chained, 4,000 steps"
    early, late = said(both, "reference", "cross_entropy"), said(long, "reference, 4,000 steps", "cross_entropy")
    assert f"after 2,000 steps ({early} nats) and {late} ahead after 4,000" in page
    nats, frames = (said(chained, long, metric) for metric in ("cross_entropy", "psnr"))
    assert f"{nats} nats and {frames} dB (three seeds, paired)" in page


def test_how_many_robots_of_the_ladder_follow_is_as_its_findings_say():
    page = findings("ladder").splitlines()
    labels = [p.label for p in curve(rows_of("ladder"), "ladder", "psnr")]
    found = {labels[int(x)]: counts(robots) for x, (robots, _) in robots_at("ladder", "ladder").items()}
    ((controls, _),) = robots_at("ladder", "ladder", CONTROL).values()
    for label, said in (found | {"reference, control": counts(controls)}).items():
        [line] = [line for line in page if re.match(rf"\| {label} \| \d", line)]
        assert line.endswith(f" | {' | '.join(map(str, said))} |"), (label, said)
    x = labels.index("recall, Muon, 64,000 steps")
    gain = np.mean([r.ahead for r in robots_at("ladder", "ladder")[x][0]])
    psnr = curve(rows_of("ladder"), "ladder", "psnr")[x].mean
    share, _, _ = in_place(in_place_rows("ladder-64000"), "model")
    assert f"a better recipe and 64,000: {100 * share:.0f} % ({psnr:.2f} dB)" in readme()
    assert f"64,000 steps, is {gain:.2f} dB ahead of copying**, on {found[labels[x]][0]} of 40 robots" in " ".join(page)


SIXTEEN_BITS = {0: "87031510e024dba4", 1: "e0ed9450a3926807", 2: "5be8301a53ed7f53"}
"""Seed -> the trial of the ladder with recall and Muon, 4,000 steps."""


@pytest.mark.parametrize("bits", [8, 24])
def test_what_tokens_of_other_bits_give_is_as_findings_of_the_ladder_say(bits):
    folder = RESULTS / "tokenizers" / f"bits{bits}"
    other = Side(
        folder.name, {s: WindowTable.load(folder / f"seed{s}" / WINDOWS) for s in SIXTEEN_BITS}, f"{bits} bits"
    )
    trials = RESULTS / "ladder" / "trials"
    usual = Side("bits16", {s: WindowTable.load(trials / id / WINDOWS) for s, id in SIXTEEN_BITS.items()}, "16 bits")
    found = {(d.scope, d.metric): d for d in compare(other, usual)}
    quality = json.loads((folder / "quality.json").read_text())["mean"]
    cells = [str(bits), f"{quality:.1f}"]
    for metric in ("psnr", "delta_psnr"):
        d = found[OVERALL, metric]
        cells += [f"{d.a:.2f}", f"{d.mean:+.2f} ({d.low:+.2f} to {d.high:+.2f})"]
    assert f"| {' | '.join(cells)} |" in findings("ladder")


def test_where_robots_of_the_ladder_stand_is_as_its_findings_say():
    """Beside the same robots of cpu-full's long reference."""
    page = " ".join(findings("ladder").split())
    longest, before = in_place_rows("ladder-64000"), in_place_rows("ladder")
    robots = {row["robot"] for row in before}
    of_others = [row for row in in_place_rows("32000") if row["robot"] in robots]

    def share(mine: list[dict[str, str]], view: str = "model") -> str:
        mean, half, count = in_place(mine, view)
        assert count == len(robots) == 12
        return f"{100 * mean:.1f} ± {100 * half:.1f} %"

    tools, objects = ([r for r in longest if r["what"].startswith(kind)] for kind in ("tool", "colour"))
    said = (
        f"of what moved, {share(longest)} stands within 2 pixels of 32 of its place in the last frame of a window after"
    )
    assert f"{said} 64,000 steps, {share(before)} after 32,000" in page
    assert f"{share(of_others)} on the same twelve robots" in page
    assert share(longest, "true") == share(before, "true") and f"true frames {share(longest, 'true')}" in page
    as_tokens = f"in true frames as the tokenizer shows them it is {share(longest, 'tokens')}"
    assert (
        f"Of tools it is {share(tools)}, of objects {share(objects)}. The tokens are not what limits it: {as_tokens}."
        in page
    )
