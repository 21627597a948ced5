"""The committed tables of how long the models before the served one hold are what docs/endurance_small.md shows."""

from __future__ import annotations

import re
from functools import partial

from experiments.applications.endurance.tables import over_robots, read_rows
from tests.experiments.applications.endurance.committed import (
    RESULTS,
    SMALL,
    by_label,
    by_place,
    check_tables,
    gain,
    gains,
    mean_in,
    percent_in,
    rows_of_trained,
    words_of,
)
from tests.pages import table


def test_the_page_shows_what_was_measured():
    ten, unlike = (read_rows(RESULTS / name) for name in ("endurance.csv", "unlike.csv"))
    check_tables(
        SMALL,
        {
            "| minute |": lambda label: [row for row in ten if row["part"] == float(label)],
            "| trained, seconds |": by_label(rows_of_trained()),
            "| drive |": lambda label: [row for row in unlike if row["drive"] == label and row["part"] == 3],
        },
    )


MINUTE = {
    "greedy decoding": ("variants model/likeliest", "variants model/shipped"),
    "temperature 0.4": ("variants model/temperature_0.4", "variants model/shipped"),
    "order by confidence": ("variants model/confidence", "variants model/shipped"),
    "streaming window": ("variants model/streaming", "variants model/shipped"),
    "its own past, sampled once": ("own_past own_past/shipped", "variants model/shipped"),
    "its own past, sampled once, greedy decoding": ("own_past own_past/likeliest", "variants model/likeliest"),
    "chained factors": ("chained chained", "chained shipped"),
    'changed tokens with weight 3: "weighed"': ("weighed", "chained shipped"),
    '"weighed", greedy decoding': ("weighed_likeliest", "weighed"),
    '24,000 steps: "long"': ("long", "weighed"),
    'half the bits per token: "coarse"': ("coarse", "weighed"),
    'its own past, sampled three times: "mended"': ("mended", "long"),
    '"mended", greedy decoding': ("mended_likeliest", "long_likeliest"),
    'more data and its own past: "resumed"': ("resumed", "weighed"),
    'also a displaced past: "displaced"': ("displaced", "resumed"),
    '"displaced", greedy decoding': ("displaced_likeliest", "resumed_likeliest"),
}
"""Line of the table of what was tried -> (table and variant of the change, of what it is beside)."""

TEN = {
    'changed tokens with weight 3: "weighed"': ("endurance", "first_ten"),
    '24,000 steps: "long"': ("long_ten", "endurance"),
    '"mended", greedy decoding': ("mended_ten", "endurance"),
    'also a displaced past: "displaced"': ("displaced_ten", "endurance"),
}
"""Of ten minutes."""


def later(name: str) -> dict[tuple, dict]:
    """(robot, start, part) -> row after the first part of a table, and of one of its variants where it is named."""
    file, _, variant = name.partition(" ")
    rows = [row for row in read_rows(RESULTS / f"{file}.csv") if row["part"] > 1 and variant in ("", row["variant"])]
    places = {(row["robot"], row["start"], row["part"]): row for row in rows}
    assert len(places) == len(rows)
    return places


def beside(measure: str, name: str, other: str) -> tuple[float, float]:
    of, before = later(name), later(other)
    assert of.keys() == before.keys()
    return gain(measure, [(row, before[place]) for place, row in of.items()])


def test_what_each_change_brings_is_as_the_page_says():
    columns = ("object_found", 2), ("tool_found", 2), ("psnr", 1)
    shown = {
        re.sub(r"\]\([^)]*\)|[\[*]", "", label): cells
        for label, cells in table(SMALL, "| change | compared with |").items()
    }
    assert shown.keys() == MINUTE.keys()
    for label, (_, *cells) in shown.items():
        pair = MINUTE[label]
        gained = [(*beside(measure, *pair), digits) for measure, digits in columns]
        found = [f"{mean:+.{digits}f} ± {half:.{digits}f}" for mean, half, digits in gained]
        ten = "{:+.2f} ± {:.2f}".format(*beside("object_found", *TEN[label])) if label in TEN else ""
        assert cells == [*found, ten], label
    starts = [{start for _, start, _ in later(pair[0])} for pair in MINUTE.values()]
    assert starts == [{0}] * 6 + [{0, 1, 2, 3}] * 10


def test_streaming_loses_motion_at_once():
    page, rows = words_of(SMALL), [row for row in read_rows(RESULTS / "variants.csv") if row["part"] == 1]
    each = {(row["variant"], row["robot"]): row for row in rows}
    pairs = [(row, each["model/shipped", robot]) for (v, robot), row in each.items() if v == "model/streaming"]
    psnr, follows = gain("psnr", pairs), gain("follows", pairs)
    assert f"it costs {-psnr[0]:.1f} ± {psnr[1]:.1f} dB in the first 20 seconds" in page
    assert 'hardly follows ("follows" {:.2f} ± {:.2f} there)'.format(*follows) in page


def test_chained_factors_keep_bodies():
    page, found = words_of(SMALL), partial(gains, "chained")
    for measure, words in (
        ("variance", "nearer to the truth's by {:.2f} ± {:.2f}, at the limit of significance"),
        ("tool_close", "no better in place ({:.2f} ± {:.2f})"),
    ):
        assert words.format(*found(measure)) in page, measure


def test_changes_counted_thrice_keep_bodies():
    page, found = words_of(SMALL), partial(gains, "weighed")
    for measure, words in (
        ("variance", "nearer to the truth's by {:.2f} ± {:.2f}."), ("tool_close", "in place do not change ({:+.2f} ± {:.2f})"),
    ):  # fmt: skip
        assert words.format(*found(measure)) in page, measure


def test_longer_training_and_a_past_of_its_own_keep_no_more_objects():
    page = words_of(SMALL)
    drawn = beside("object_found", "long_likeliest", "long")
    assert "sooner than with sampled decoding ({:.2f} ± {:.2f})".format(*drawn) in page
    three = [beside(measure, "mended_likeliest", "weighed") for measure in ("object_found", "object_close", "psnr")]
    said = "(objects found {:.2f} ± {:.2f}, in place {:+.2f} ± {:.2f}, PSNR {:.1f} ± {:.1f} dB)"
    assert said.format(abs(three[0][0]), three[0][1], *three[1], *three[2]) in page
    last = over_robots([row for place, row in later("long_ten").items() if place[2] == 10], "object_found")[0]
    ten = [x for measure in ("psnr", "follows") for x in beside(measure, "long_ten", "endurance")]
    said = (
        'in {:.0f} % of the frames of the last minute. Compared with "weighed", from the second minute on, PSNR changes by '
        '{:.1f} ± {:.1f} dB and "follows" by {:.2f} ± {:.2f}.'
    )
    assert said.format(100 * last, *ten) in page


def test_a_displaced_past_keeps_objects_for_a_minute_where_tokens_are_drawn():
    page = words_of(SMALL)
    control, before = partial(gains, "displaced", beside="resumed"), partial(gains, "displaced", beside="weighed")
    (more, half), (less, off) = control("object_found"), control("psnr")
    assert more > half and less < -off
    said = 'compared with "weighed", too, the share of frames in which they are found is higher by {:.2f} ± {:.2f}.'
    assert said.format(*before("object_found")) in page
    places = *control("object_close"), *before("object_close")
    said = 'Objects in place: {:+.2f} ± {:.2f} (compared with "resumed") and {:+.2f} ± {:.2f} ("weighed").'
    assert said.format(*places) in page
    assert 'compared with "weighed" it changes by {:+.1f} ± {:.1f} dB;'.format(*before("psnr")) in page
    assert '"follows" does not change ({:.2f} ± {:.2f} compared with "resumed")'.format(*control("follows")) in page
    back = [
        over_robots([r for r in read_rows(RESULTS / f"{name}_hidden.csv") if r["kind"] == "hidden"], "found")[0]
        for name in ("displaced", "resumed")
    ]
    said = "Memory is no better**: hidden objects reappear in {:.0f} % of the cases ("
    assert said.format(100 * back[0]) in page
    assert f'with "resumed" in {100 * back[1]:.0f} % (' in page
    weighed, ten = by_place("endurance.csv"), by_place("displaced_ten.csv")
    assert len(weighed) == 8 * 10 and weighed.keys() == ten.keys()

    said = 'found in {} % of the frames of the first minute ("weighed": {}), {} of the second ({}), {} of the last ({})'
    assert said.format(*(percent_in(minute, of) for minute in (1, 2, 10) for of in (ten, weighed))) in page
    kept = [[of[robot, 0, 4]["object_found"] for of in (ten, weighed)] for robot in ("pusher_sand", "omni_chalk")]
    assert kept[0][0] > 0.95 and kept[1][0] < 0.05 < 0.95 < kept[1][1]


def test_ten_minutes_with_a_past_of_its_own_depend_on_the_robot():
    page = words_of(SMALL)
    served, ten = by_place("endurance.csv"), by_place("mended_ten.csv")
    assert len(served) == 8 * 10 and served.keys() == ten.keys()
    last = over_robots([row for row in ten.values() if row["part"] == 10], "object_found")[0]
    assert f"found in {100 * last:.0f} % of the frames of the last minute; pusher_sand keeps" in page
    for robot, measure, words in (
        ("pusher_sand", "object_found", '({:.0f} % of the last minute, "weighed" {:.0f})'),
        ("picker_slate", "tool_found", 'its own body (found in {:.0f} %, "weighed" {:.0f})'),
    ):
        assert words.format(*(100 * of[robot, 0, 10][measure] for of in (ten, served))) in page
    back = over_robots([row for row in read_rows(RESULTS / "mended_hidden.csv") if row["kind"] == "hidden"], "found")[0]
    assert f"Hidden objects reappear in {100 * back:.0f} % of the cases" in page


def test_ten_minutes_are_as_the_page_says():
    page = words_of(SMALL)
    mine, first = (
        {(robot, minute): row for (robot, _, minute), row in by_place(name).items()}
        for name in ("endurance.csv", "first_ten.csv")
    )
    assert len(mine) == 8 * 10 and mine.keys() == first.keys()
    tools, objects = percent_in(10, mine, "tool_found"), [percent_in(minute, mine) for minute in (1, 2, 10)]
    assert f"Tools are found in {tools} % of the frames of the last minute" in page
    said = '"Follows" is {:.2f} in the first minute and {:.2f} in the last.'
    assert said.format(mean_in(1, mine, "follows"), mean_in(10, mine, "follows")) in page
    assert (
        f"found in {objects[0]} % of frames of the first minute, in {objects[1]} % of those of the second, in" in page
    )
    assert f"Objects are found in {objects[2]} % of the frames of the last minute" in page
    variance = sum(mean_in(minute, mine, "variance") for minute in range(2, 11)) / 9
    assert f"variance ({variance:.2f} of the truth's)" in page
    level, half, _ = over_robots([row for (_, minute), row in mine.items() if minute > 1], "level")
    assert f"Mean level ({level:.1f} ± {half:.1f} grey levels too high)" in page
    colours = mean_in(1, mine, "histogram"), mean_in(10, mine, "histogram")
    assert "({:.2f} of the histogram differs in the first minute, {:.2f} in the last)".format(*colours) in page
    before = percent_in(10, first, "tool_found"), percent_in(10, first)
    said = "of the last minute (first model: {} %), objects in {} % ({} %);"
    assert said.format(before[0], objects[2], before[1]) in page
    arm = [each["arm_sand", 10]["follows"] for each in (mine, first)]
    assert f'("follows" {arm[0]:.2f}, first model {arm[1]:.2f})' in page
    following = [robot for robot, minute in mine if minute == 1 and mine[robot, 1]["follows"] > 0.5]
    assert len(following) == 6 and all(mine[r, 10]["follows"] > mine[r, 1]["follows"] / 2 for r in following)
    places = [f"{100 * mine[robot, 10]['tool_close']:.0f}" for robot in ("gripper_wood", "gripper_night")]
    assert f"in {places[0]} and {places[1]} % of the last minute for the two grippers" in page
    pusher = mine["pusher_sand", 10]
    assert f'pusher_sand ("follows" {pusher["follows"]:.2f}) is {pusher["tool_px"]:.0f} pixels off' in page
    last = [(mine[robot, 10], mine[robot, 2]) for robot, minute in mine if minute == 10]
    later = [(row, first[place]) for place, row in mine.items() if place[1] > 1]
    for measure, words, pairs in (
        ("psnr", "PSNR {:.1f} ± {:.1f} dB, follows", last), ("follows", "follows {:.2f} ± {:.2f})", last),
        ("follows", '"follows" is higher by {:.2f} ± {:.2f},', later), ("psnr", "PSNR is equal ({:.1f} ± {:.1f} dB)", later),
    ):  # fmt: skip
        assert words.format(*gain(measure, pairs)) in page, measure


def test_what_was_hidden_for_long_does_not_come_back():
    rows, page = read_rows(RESULTS / "hidden.csv"), words_of(SMALL)
    hidden, control = ([row for row in rows if row["kind"] == kind] for kind in ("hidden", "control"))
    assert len(hidden) == len(control) == 48
    for mine in (hidden, control):
        found, close = ([round(100 * x) for x in over_robots(mine, name)[:2]] for name in ("found", "close"))
        assert f"{found[0]} ± {found[1]} " in page and f"{close[0]} ± {close[1]} %" in page
    short, long = ([r["found"] for r in hidden if (r["gone"] >= 4) == late] for late in (False, True))
    assert f"shows {sum(short):.0f} of {len(short)} objects, after four or more {sum(long):.0f} of {len(long)}" in page
