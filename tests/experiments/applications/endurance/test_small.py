"""The committed tables of how long the models before the served one hold are what docs/endurance_small.md shows."""

from __future__ import annotations

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
    rows_of_trained,
    words_of,
)


def test_the_page_shows_what_was_measured():
    ten, unlike = (read_rows(RESULTS / name) for name in ("endurance.csv", "unlike.csv"))
    tried = [row for name in ("variants.csv", "own_past.csv") for row in read_rows(RESULTS / name)]
    check_tables(
        SMALL,
        {
            "| minute |": lambda label: [row for row in ten if row["part"] == float(label)],
            "| variant, seconds |": by_label(tried),
            "| trained, seconds |": by_label(rows_of_trained()),
            "| drive |": lambda label: [row for row in unlike if row["drive"] == label and row["part"] == 3],
        },
    )


def test_no_way_of_filling_frames_and_no_past_of_its_own_is_better():
    page = words_of(SMALL)
    variants, own_past = (
        {(r["variant"], r["robot"], r["part"]): r for r in read_rows(RESULTS / f"{name}.csv")}
        for name in ("variants", "own_past")
    )

    def beside(measure: str, variant: str, parts: tuple[int, ...], of: dict = variants) -> tuple[float, float]:
        other = "model/shipped" if of is variants else variant.replace("own_past", "model")
        rows = {k[1:]: row for k, row in of.items() if k[0] == variant and k[2] in parts}
        return gain(measure, [(row, variants[other, *k]) for k, row in rows.items()])

    late = [x for v in ("likeliest", "temperature_0.4") for x in beside("object_found", f"model/{v}", (2, 3))]
    assert "by {:+.2f} ± {:.2f} (likeliest), {:+.2f} ± {:.2f} (temperature 0.4)".format(*late) in page
    confidence = beside("object_found", "model/confidence", (2, 3))
    assert "and {:.2f} ± {:.2f} (confidence)".format(*confidence) in page
    objects, tools = (beside(measure, "model/streaming", (2, 3)) for measure in ("object_found", "tool_found"))
    said = "objects are found in {:.2f} ± {:.2f} more of the frames, but tools in {:.2f} ± {:.2f} fewer"
    assert said.format(*objects, -tools[0], tools[1]) in page
    psnr, follows = (beside(measure, "model/streaming", (1,)) for measure in ("psnr", "follows"))
    assert f"it costs {-psnr[0]:.1f} ± {psnr[1]:.1f} dB in the first 20 seconds" in page
    assert "any more ({:.2f} ± {:.2f} there)".format(*follows) in page
    for name, said in (
        ("likeliest", "objects found {:+.2f} ± {:.2f}, PSNR {:.2f} ± {:.2f} dB;"),
        ("shipped", "temperature of 0.7 {:+.2f} ± {:.2f} and {:.2f} ± {:.2f} dB."),
    ):
        found = [x for m in ("object_found", "psnr") for x in beside(m, f"own_past/{name}", (2, 3), own_past)]
        assert said.format(*found) in page, name


def test_chained_factors_keep_bodies_and_cost_decibels():
    page, found = words_of(SMALL), partial(gains, "chained")
    for measure, words in (
        ("tool_found", "in {:.2f} ± {:.2f} more of the frames"), ("object_found", "than chance allows ({:+.2f} ± {:.2f})"),
        ("variance", "nearer to the truth's by {:.2f} ± {:.2f}, at the edge of chance"),
        ("tool_close", "better in place ({:.2f} ± {:.2f})"),
    ):  # fmt: skip
        assert words.format(*found(measure)) in page, measure
    loss, half = found("psnr")
    assert f"at wrong places cost {-loss:.1f} ± {half:.1f} dB" in page


def test_changes_counted_thrice_keep_bodies_and_cost_nothing():
    page, found = words_of(SMALL), partial(gains, "weighed")
    for measure, words in (
        ("tool_found", "tools are found in {:.2f} ± {:.2f} more of the frames"),
        ("variance", "nearer to the truth's by {:.2f} ± {:.2f}. Objects"),
        ("object_found", "Objects are found in {:.2f} ± {:.2f} more"),
        ("tool_close", "places (tools {:+.2f} ± {:.2f})"), ("psnr", "PSNR ({:.1f} ± {:.1f} dB)"),
    ):  # fmt: skip
        assert words.format(*found(measure)) in page, measure


def test_longer_training_and_a_past_of_its_own_keep_no_more_objects():
    page = words_of(SMALL)
    minute = [gains("long", measure, "weighed") for measure in ("object_found", "psnr")]
    assert "robot, {:+.2f} ± {:.2f}; PSNR {:.1f} ± {:.1f} dB)".format(*minute[0], *minute[1]) in page
    rounds = [gains("mended", measure, "long") for measure in ("object_found", "psnr", "follows")]
    said = 'found {:.2f} ± {:.2f} beside "long", PSNR {:.1f} ± {:.1f} dB, follows {:+.2f} ± {:.2f}.'
    assert said.format(*rounds[0], *rounds[1], *rounds[2]) in page
    tables = ("weighed", "long", "long_likeliest", "mended_likeliest")
    weighed, drawn, long, mended = ({k: r for k, r in by_place(f"{n}.csv").items() if k[2] > 1} for n in tables)

    def beside(measure: str, of: dict, other: dict) -> tuple[float, float]:
        assert len(of) == 8 * 4 * 2 and of.keys() == other.keys()
        return gain(measure, [(row, other[place]) for place, row in of.items()])

    assert 'found {:+.2f} ± {:.2f} beside "long" at that'.format(*beside("object_found", mended, long)) in page
    assert "sooner than when it draws ({:.2f} ± {:.2f})".format(*beside("object_found", long, drawn)) in page
    three = [beside(measure, mended, weighed) for measure in ("object_found", "object_close", "psnr")]
    said = "(objects found {:.2f} ± {:.2f}, in place {:+.2f} ± {:.2f}, PSNR {:.1f} ± {:.1f} dB)"
    assert said.format(abs(three[0][0]), three[0][1], *three[1], *three[2]) in page
    served, long = by_place("endurance.csv"), by_place("long_ten.csv")
    assert len(served) == 8 * 10 and served.keys() == long.keys()
    later = [(row, served[place]) for place, row in long.items() if row["part"] > 1]
    last = over_robots([row for row in long.values() if row["part"] == 10], "object_found")[0]
    ten = [gain(measure, later) for measure in ("object_found", "psnr", "follows")]
    assert "found {:.2f} ± {:.2f} from the second minute on, in the last minute".format(*ten[0]) in page
    said = "minute {:.0f} % of frames, PSNR {:.1f} ± {:.1f} dB, follows {:.2f} ± {:.2f}."
    assert said.format(100 * last, *ten[1], *ten[2]) in page


def test_half_the_bits_keep_no_more_objects():
    page = words_of(SMALL)
    found = [x for m in ("object_found", "object_close", "tool_close", "psnr") for x in gains("coarse", m, "weighed")]
    said = "objects found {:.2f} ± {:.2f}, in place {:+.2f} ± {:.2f}, tools in place {:+.2f} ± {:.2f}, PSNR {:+.1f} ± {:.1f} dB"
    assert said.format(*found) in page


def test_a_displaced_past_keeps_objects_for_a_minute_where_tokens_are_drawn():
    page = words_of(SMALL)
    beside, before = partial(gains, "displaced", beside="resumed"), partial(gains, "displaced", beside="weighed")
    (more, half), (less, off) = beside("object_found"), beside("psnr")
    assert more > half and less < -off
    assert f"found in {more:.2f} ± {half:.2f} more of the frames than with" in page
    assert 'in {:.2f} ± {:.2f} more than with "weighed"'.format(*before("object_found")) in page
    places = *beside("object_close"), *before("object_close")
    assert "In place they are {:.2f} ± {:.2f} and {:.2f} ± {:.2f} more.".format(*places) in page
    assert f'PSNR is {-less:.1f} ± {off:.1f} dB lower than with "resumed"' in page
    assert '{:+.1f} ± {:.1f} dB beside "weighed"'.format(*before("psnr")) in page
    tools = *beside("tool_found"), *beside("follows")
    assert '(found {:.2f} ± {:.2f}, follows {:.2f} ± {:.2f} beside "resumed")'.format(*tools) in page
    likeliest, resumed = (by_place(f"{name}_likeliest.csv") for name in ("displaced", "resumed"))
    assert len(likeliest) == 8 * 4 * 3 and likeliest.keys() == resumed.keys()
    later = [(row, resumed[place]) for place, row in likeliest.items() if row["part"] > 1]
    assert "nothing is gained, {:.2f} ± {:.2f}:".format(*gain("object_found", later)) in page
    back = [
        over_robots([r for r in read_rows(RESULTS / f"{name}_hidden.csv") if r["kind"] == "hidden"], "found")[0]
        for name in ("displaced", "resumed")
    ]
    assert f"hidden comes back in {100 * back[0]:.0f} % of the cases" in page
    assert f'with "resumed" in {100 * back[1]:.0f} (' in page
    weighed, ten = by_place("endurance.csv"), by_place("displaced_ten.csv")
    assert len(weighed) == 8 * 10 and weighed.keys() == ten.keys()

    def found(minute: int, of: dict) -> str:
        rows = [row for row in of.values() if row["part"] == minute]
        return f"{100 * over_robots(rows, 'object_found')[0]:.0f}"

    said = 'found in {} % of the frames of the first minute ("weighed": {}), {} of the second ({}), {} of the last ({})'
    assert said.format(*(found(minute, of) for minute in (1, 2, 10) for of in (ten, weighed))) in page
    later = [(row, weighed[place]) for place, row in ten.items() if row["part"] > 1]
    assert "the gain is {:.2f} ± {:.2f}, one".format(*gain("object_found", later)) in page
    kept = [[of[robot, 0, 4]["object_found"] for of in (ten, weighed)] for robot in ("pusher_sand", "omni_chalk")]
    assert kept[0][0] > 0.95 and kept[1][0] < 0.05 < 0.95 < kept[1][1]


def test_ten_minutes_with_a_past_of_its_own_depend_on_the_robot():
    page = words_of(SMALL)
    served, ten = by_place("endurance.csv"), by_place("mended_ten.csv")
    assert len(served) == 8 * 10 and served.keys() == ten.keys()
    last = over_robots([row for row in ten.values() if row["part"] == 10], "object_found")[0]
    later = [(row, served[place]) for place, row in ten.items() if row["part"] > 1]
    gained = gain("object_found", later)
    assert (
        f"found in {100 * last:.0f} % of the frames of the last minute, {gained[0]:.2f} ± {gained[1]:.2f} beside"
        in page
    )
    for robot, measure, words in (
        ("pusher_sand", "object_found", '({:.0f} % of the last minute, "weighed" {:.0f})'),
        ("picker_slate", "tool_found", 'its own body ({:.0f} %, "weighed" {:.0f})'),
    ):
        assert words.format(*(100 * of[robot, 0, 10][measure] for of in (ten, served))) in page
    back = over_robots([row for row in read_rows(RESULTS / "mended_hidden.csv") if row["kind"] == "hidden"], "found")[0]
    assert f"hidden comes back in {100 * back:.0f} % of the cases" in page


def test_likeliest_tokens_are_no_better():
    page = words_of(SMALL)
    drawn, likeliest = by_place("weighed.csv"), by_place("weighed_likeliest.csv")
    assert len(drawn) == 8 * 4 * 3 and drawn.keys() == likeliest.keys()
    later = [(row, drawn[place]) for place, row in likeliest.items() if row["part"] > 1]
    for measure, words in (("object_found", "objects found {:.2f} ± {:.2f}"), ("psnr", "PSNR {:+.1f} ± {:.1f} dB.")):
        assert words.format(*gain(measure, later)) in page, measure


def test_ten_minutes_are_as_the_page_says():
    page = words_of(SMALL)
    mine, first = (
        {(robot, minute): row for (robot, _, minute), row in by_place(name).items()}
        for name in ("endurance.csv", "first_ten.csv")
    )
    assert len(mine) == 8 * 10 and mine.keys() == first.keys()

    def mean(measure: str, minute: int, of: dict = mine) -> float:
        found, _, robots = over_robots([row for (_, at), row in of.items() if at == minute], measure)
        assert robots == 8
        return found

    def percent(*where) -> str:
        return f"{100 * mean(*where):.0f}"

    tools, objects = percent("tool_found", 10), [percent("object_found", minute) for minute in (1, 2, 10)]
    assert f"Tools are found in {tools} % of the frames of the last minute" in page
    assert f"commands by {mean('follows', 10):.2f} after {mean('follows', 1):.2f} in the first minute" in page
    assert (
        f"found in {objects[0]} % of frames of the first minute, in {objects[1]} % of those of the second, in" in page
    )
    assert f"Objects are found in {objects[2]} % of the frames of the last minute" in page
    variance = sum(mean("variance", minute) for minute in range(2, 11)) / 9
    assert f"variance ({variance:.2f} of the truth's)" in page
    level, half, _ = over_robots([row for (_, minute), row in mine.items() if minute > 1], "level")
    assert f"mean level ({level:.1f} ± {half:.1f} grey levels too high)" in page
    colours = mean("histogram", 1), mean("histogram", 10)
    assert "({:.2f} of the histogram differs in the first minute, {:.2f} in the last)".format(*colours) in page
    before = percent("tool_found", 10, first), percent("object_found", 10, first)
    assert f"where it was {before[0]}, objects in {objects[2]}, where it was {before[1]}" in page
    arm = [each["arm_sand", 10]["follows"] for each in (mine, first)]
    assert f"(follows by {arm[0]:.2f}, where the first model has {arm[1]:.2f})" in page
    following = [robot for robot, minute in mine if minute == 1 and mine[robot, 1]["follows"] > 0.5]
    assert len(following) == 6 and all(mine[r, 10]["follows"] > mine[r, 1]["follows"] / 2 for r in following)
    places = [f"{100 * mine[robot, 10]['tool_close']:.0f}" for robot in ("gripper_wood", "gripper_night")]
    assert f"{places[0]} and {places[1]} % of the last minute of the two grippers" in page
    pusher = mine["pusher_sand", 10]
    assert f"follows by {pusher['follows']:.2f} and stands {pusher['tool_px']:.0f} pixels beside the truth" in page
    last = [(mine[robot, 10], mine[robot, 2]) for robot, minute in mine if minute == 10]
    later = [(row, first[place]) for place, row in mine.items() if place[1] > 1]
    for measure, words, pairs in (
        ("psnr", "PSNR {:.1f} ± {:.1f} dB, follows", last), ("follows", "follows {:.2f} ± {:.2f})", last),
        ("follows", "follows by {:.2f} ± {:.2f} more", later), ("psnr", "PSNR is level ({:.1f} ± {:.1f} dB)", later),
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
    assert f"it is {sum(short):.0f} of {len(short)}, after four or more {sum(long):.0f} of {len(long)}" in page
