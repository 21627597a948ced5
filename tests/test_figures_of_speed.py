"""Figures of docs/performance.md, and of README's section on speed, are those of the committed records."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

from experiments.bench.against_release import OUR_PREFIX, RELEASE_PREFIX, RELEASE_STAGES
from experiments.bench.models import EXECUTION
from experiments.bench.record import read_record
from experiments.presets import get_preset
from hma_jax.config import ExecutionConfig
from tests.pages import table

ROOT = Path(__file__).parents[1]
README, SPEED = ROOT / "README.md", ROOT / "docs" / "performance.md"
BENCH = ROOT / "experiments" / "results" / "bench" / "cpu"

STAGES = {
    "a frame while the window fills": "fill",
    "a frame past the window, exact": "slide",
    "a training step": "step",
}
"""Row of README, of the page's summary and of its products -> stage, and program."""

PROGRAMS = {"forward": "a pass over the window"} | {stage: label for label, stage in STAGES.items()}
"""Program -> row of the page's table of products."""


def test_the_speed_beside_the_release():
    record = json.loads((BENCH / "release-base-float32-cpu.json").read_text())
    median = {stage["name"]: stage["timing"]["median"] for stage in record["stages"]}
    rows = table(README, "| | release | here |")
    assert rows.keys() == STAGES.keys()
    for label, (release, here, times, avx512) in rows.items():
        stage = STAGES[label]
        theirs, ours = median[RELEASE_PREFIX + RELEASE_STAGES[stage]], median[OUR_PREFIX + stage]
        assert (release, here) == (f"{theirs:.2f} s", f"{ours:.2f} s"), label
        for cell, records, digits in (
            (times, (NEWEST, AGAIN, *EARLIER), 2 if stage == "step" else 1),
            (avx512, WITH_AVX512, 1),
        ):
            ratios = [times_longer(run, stage) for run in beside_the_release(*records)]
            assert cell.replace("**", "") == f"{min(ratios):.{digits}f} to {max(ratios):.{digits}f}", label
            assert ("**" in cell) == (min(ratios) < 1), f"{label}: bold where it is slower"
    assert f"`{record['machine']['commit']}`" in README.read_text() and record["date"] in README.read_text()


def test_the_speed_on_a_gpu_beside_the_release():
    gpu, text = ROOT / "experiments" / "results" / "bench" / "gpu", " ".join(README.read_text().split())
    page = (ROOT / "docs" / "performance.md").read_text()
    names = ("base-float32", "base-batch-8-bfloat16")
    frames, steps = (read_record(gpu / f"release-{name}-nvidia-h100-80gb-hbm3.json") for name in names)
    fill, slide, train = (
        record.stage(RELEASE_PREFIX + RELEASE_STAGES[stage], rows).timing.median
        / record.stage(OUR_PREFIX + stage, rows).timing.median
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


WEIGHTS = re.compile(r"\d+ times 1 of (\d+) x (\d+) x (\d+)")
"""A product without batch: of a weight, or of its gradient."""


NEWEST, AGAIN = (BENCH / f"release-{name}-float32-cpu.json" for name in ("base", "again-base"))
EARLIER = [
    BENCH.parent / "release-before" / f"{commit}.json"
    for commit in ("ff60a14d7648", "9d42fe38d6dc", "beb6b0eed88e", "3aced3ab6e6a")
]
"""Records of comparisons with the release on two cores, in the order of the page."""
WITH_AVX512 = [
    BENCH.parent / "avx512" / f"{name}.json"
    for name in ("release-base-float32-cpu", "release-before-1-efeaa246e532", "release-before-2-efeaa246e532")
]
"""The same on a processor with AVX-512, the newest first."""


def beside_the_release(*records: Path) -> list[dict[str, tuple[float, float]]]:
    """Stage -> (median, p90), of each."""
    return [{s.name: (s.timing.median, s.timing.p90) for s in read_record(record).stages} for record in records]


def times_longer(run: dict[str, tuple[float, float]], stage: str) -> float:
    return run[RELEASE_PREFIX + RELEASE_STAGES[stage]][0] / run[OUR_PREFIX + stage][0]


def test_the_page_of_speed_shows_the_release_on_two_cores():
    newest, again, *before = beside_the_release(NEWEST, AGAIN, *EARLIER)
    rows = table(SPEED, "| stage | the release | here |")
    few = "continuous fill, 10 evaluations by dpm++"
    shown = {"continuous few" if label == few else label: cells for label, cells in rows.items()}
    assert shown.keys() == RELEASE_STAGES.keys()
    for stage, cells in shown.items():
        times = [
            ", ".join(f"{1e3 * x:,.0f} ms" for x in newest[name])
            for name in (RELEASE_PREFIX + RELEASE_STAGES[stage], OUR_PREFIX + stage)
        ]
        others = ", ".join(f"{times_longer(run, stage):.2f}" for run in before)
        repeated = f"{times_longer(again, stage):.2f}" if OUR_PREFIX + stage in again else ""
        assert cells == [*times, f"{times_longer(newest, stage):.2f}", repeated, others], stage
    page = " ".join(SPEED.read_text().split())
    for name, words in (
        (
            "forward",
            "forward pass took {:.2f} s (earlier {:.2f} to {:.2f} s), ours {:.2f} s (earlier {:.2f} to {:.2f} s)",
        ),
        ("step", "its median was {:.2f} and {:.2f} s in the two runs, ours {:.2f} and {:.2f} s"),
    ):
        figures = []
        for whose in (RELEASE_PREFIX, OUR_PREFIX):
            first, second, *others = (run[whose + name][0] for run in (newest, again, *before))
            figures += [first, min(others), max(others)] if name == "forward" else [first, second]
        assert words.format(*figures) in page
    first, second, *plain = (read_record(path).matmul_flops_per_second / 1e9 for path in (NEWEST, AGAIN, *EARLIER))
    assert f"ran at {first:.0f} and {second:.0f} GFLOP/s, earlier at {min(plain):.0f} to {max(plain):.0f}." in page
    huge = (before[0][f"release{how}: {stage}"][0] for stage in ("frame", "step") for how in (" with huge pages", ""))
    assert "its frame took {:.2f} s with and {:.2f} s without, its step {:.2f} and {:.2f} s".format(*huge) in page


def test_the_speed_on_a_processor_with_avx512():
    newest, *before = beside_the_release(*WITH_AVX512)
    (latents,) = beside_the_release(WITH_AVX512[0].parent / "release-continuous-efeaa246e532.json")
    rows = table(SPEED, "| stage | the release, `2df38753e8bf` | here |")
    few = "continuous fill, 10 evaluations by dpm++"
    shown = {"continuous few" if label == few else label: cells for label, cells in rows.items()}
    assert shown.keys() == RELEASE_STAGES.keys()
    for stage, (release, here, times, earlier) in shown.items():
        runs = before if stage in timed_stages(newest) else [latents]
        assert earlier == ", ".join(f"{times_longer(run, stage):.2f}" for run in runs), stage
        if stage in timed_stages(newest):
            theirs, ours = newest[RELEASE_PREFIX + RELEASE_STAGES[stage]][0], newest[OUR_PREFIX + stage][0]
            assert (release, here) == (f"{1e3 * theirs:,.0f} ms", f"{1e3 * ours:,.0f} ms"), stage
            assert times == f"{theirs / ours:.2f}", stage
    most = max(times_longer(run, "fill") for run in (newest, *before, *beside_the_release(NEWEST)))
    assert f" to {most:.1f} times faster ([speed](#speed))" in " ".join(README.read_text().split())
    steps = [times_longer(run, "step") for run in (newest, *before)]
    page = " ".join(SPEED.read_text().split())
    assert f"our step is {min(steps):.1f} to {max(steps):.1f} times as fast" in page


def timed_stages(run: dict[str, tuple[float, float]]) -> set[str]:
    """Our stages that a run timed."""
    return {name.removeprefix(OUR_PREFIX) for name in run if name.startswith(OUR_PREFIX)}


SUMMED = STAGES | {
    "a frame of latents while it fills, as released: DDPM, 100 steps": "continuous fill",
    "the same by DPM++, 10 steps": "continuous few",
}
"""Row of the page's summary -> stage."""


def test_the_summary_of_speed_gives_the_range_of_six_runs():
    newest, again, *before = beside_the_release(NEWEST, AGAIN, *EARLIER)
    rows = table(SPEED, "| base model, M = 2 unmasking steps |")
    gpu = table(SPEED, "| | release | here | the release over ours |")
    on_gpu = dict(zip(("fill", "slide", "step"), gpu.values(), strict=True))
    for label, stage in SUMMED.items():
        took, beside, here, there = rows[label]
        digits = 2 if stage == "step" else 1
        ratios = [times_longer(run, stage) for run in (newest, again, *before) if OUR_PREFIX + stage in run]
        assert took == f"{newest[OUR_PREFIX + stage][0]:.2f} s", label
        assert beside.startswith(f"{min(ratios):.{digits}f} to {max(ratios):.{digits}f}"), label
        assert ("about as long" in beside) == (min(ratios) < 1 < max(ratios)), label
        if stage in on_gpu:
            assert here.startswith(on_gpu[stage][1]) and there.split()[0] == f"{float(on_gpu[stage][2]):.1f}", label
    readme = " ".join(README.read_text().split())
    slowest = min(times_longer(run, "slide") for run in (newest, again, *before))
    assert f"frames {slowest:.1f} to " in readme


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
    assert "Peak memory is {:.1f} GiB for generating and {:.1f} GiB for training.".format(*held) in page


def test_the_page_of_speed_shows_what_loading_gives():
    record = read_record(BENCH / "load-store-none-cpu.json")
    rows = table(SPEED, "| | frames/s | memory growth per thousand |")
    assert rows.keys() == {stage.name for stage in record.stages}
    for stage in record.stages:
        rate, memory = rows[stage.name]
        assert rate == f"{stage.frames_per_second:,.0f}"
        amount, _, over = memory.partition(" over ")
        threads = stage.name.partition(", ")[2]
        assert f"memory over {over}, {threads}: +{amount} per thousand" in record.notes


def test_the_page_of_speed_shows_products_of_two_cores():
    release = beside_the_release(EARLIER[1])[0]
    rates, smallest, plain, within, over_time = [], [], [], [], []
    for program, theirs in (("forward", "forward"), ("fill", "frame"), ("slide", "frame"), ("step", "step")):
        products = read_record(BENCH / f"products-{program}-base-float32-cpu.json")
        plain.append(products.matmul_flops_per_second / 1e9)
        cells = table(SPEED, "| program | time |")[PROGRAMS[program]]
        whole, *each = products.stages
        took, released = sum(stage.timing.median for stage in each), release[RELEASE_PREFIX + theirs][0]
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
    turns = ", ".join(f"{release[OUR_PREFIX + stage][0]:.2f}" for stage in ("forward", "fill", "slide"))
    assert f"at this commit, ours took {turns} and {release[OUR_PREFIX + 'step'][0]:.2f} s" in page
    said = (
        "products with weights: {:.0f} to {:.0f}; the smallest, of one frame and a matrix 256 wide, {:.0f} to {:.0f}; "
        "one in the training step {:.0f}; * a plain square product: {:.0f} to {:.0f}; * attention within frames: "
        "{:.0f} to {:.0f} (a head has 32 values); temporal attention: {:.0f} to {:.0f} (matrices"
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
        "products with weights take {:.0f} % of the time, attention within frames {:.0f} %, temporal attention {:.0f} %, and the "
        "rest {:.0f} %: softmax"
    )
    assert said.format(*shares[0], 100 - sum(shares[0])) in page
    sums = [sum(each) for each in shares]
    assert f"matrix products take {min(sums):.0f} to {max(sums):.0f} % of the time" in page


def test_the_page_of_speed_shows_what_cheaper_decoding_costs():
    with (BENCH.parent / "quality-continuous" / "quality-12.csv").open(newline="") as file:
        judged = {
            row["decoding"]: {k: float(x) for k, x in row.items() if k != "decoding"} for row in csv.DictReader(file)
        }
    rows = table(SPEED, "| sampler | PSNR (dB) | minus DDPM 100 |")
    for label, cells in rows.items():
        row = judged[label.strip("*").removesuffix(", as released").lower()]
        gap = f"{row['psnr_gap']:.2f} ± {row['psnr_gap_sem']:.2f}" if row["psnr_gap"] else ""
        psnr, delta = (f"{row[name]:.2f} ± {row[f'{name}_sem']:.2f}" for name in ("psnr", "delta_psnr"))
        assert cells[:4] == [psnr, gap, f"{row['ssim']:.3f}", delta], label
