"""The committed tables of how long the served model holds are what docs/endurance.md shows."""

from __future__ import annotations

import csv

import numpy as np

from experiments.applications.detector import COMMITTED as DETECTOR
from experiments.applications.detector import WEIGHTS, Detector
from experiments.applications.endurance.tables import over_robots, read_rows
from tests.experiments.applications.endurance.committed import (
    PAGE,
    RESULTS,
    ROOT,
    by_label,
    by_place,
    check_tables,
    gain,
    gains,
    of_three_starts,
    rows_of_trained,
    words_of,
)


def test_the_page_shows_what_was_measured():
    ten = read_rows(RESULTS / "grown_ten.csv")
    drawn = list(of_three_starts("drawn").values())
    minutes = {
        "| minute |": lambda label: [row for row in ten if row["part"] == float(label)],
        "| minute, drawn |": lambda label: [row for row in drawn if row["part"] == float(label)],
    }
    check_tables(PAGE, minutes | {"| trained, seconds |": by_label(rows_of_trained())})


def test_ten_minutes_are_as_the_page_says():
    page, mine = words_of(PAGE), {(robot, minute): row for (robot, _, minute), row in by_place("grown_ten.csv").items()}
    small = {(robot, minute): row for (robot, _, minute), row in by_place("endurance.csv").items()}
    assert len(mine) == 8 * 10 and mine.keys() == small.keys()

    def mean(measure: str, minute: int, of: dict = mine) -> float:
        found, _, robots = over_robots([row for (_, at), row in of.items() if at == minute], measure)
        assert robots == 8
        return found

    def objects(of: dict) -> list[str]:
        return [f"{100 * mean('object_found', minute, of):.0f}" for minute in (1, 2, 10)]

    first, second, last = objects(mine)
    said = f"found in {first} % of frames of the first minute, in {second} % of those of the second, in {last} % of the last"
    assert said in page
    assert "two cores train in {}, {} and {} (".format(*objects(small)) in page
    tools = f"{100 * mean('tool_found', 10):.0f}"
    assert f"Tools are found in {tools} % of the frames of the last minute" in page
    assert f"commands by {mean('follows', 10):.2f} after {mean('follows', 1):.2f} in the first minute" in page
    following = [robot for robot, minute in mine if minute == 1 and mine[robot, 1]["follows"] > 0.5]
    keeping = [robot for robot in following if mine[robot, 10]["follows"] >= mine[robot, 1]["follows"] / 2]
    assert f"Of {len(following)} robots that follow at all (above 0.5 in the first minute) {len(keeping)} keep" in page
    places = {robot: round(100 * row["tool_close"]) for (robot, minute), row in mine.items() if minute == 10}
    grippers, arms, pusher_in_place = (
        [places.pop(f"{kind}_{name}") for name in names]
        for kind, names in (("gripper", ("wood", "night")), ("arm", ("chalk", "sand")), ("pusher", ("sand",)))
    )
    assert "{} and {} % of the last minute of the two grippers".format(*grippers) in page
    said = "in place in {} %, the two arms in {} and {}, the other three in {} at most"
    assert said.format(*pusher_in_place, *arms, max(places.values())) in page and len(places) == 3
    pusher = mine["pusher_sand", 10]
    assert f"follows by {pusher['follows']:.2f}, stands {pusher['tool_px']:.0f} pixels beside the truth" in page
    change = [(mine[robot, 10], mine[robot, 2]) for robot, minute in mine if minute == 10]
    for measure, words in (
        ("psnr", "PSNR changes by {:+.1f} ± {:.1f} dB"), ("follows", "follows by {:+.2f} ± {:.2f}"),
        ("object_found", "objects found by {:+.2f} ± {:.2f}"),
    ):  # fmt: skip
        assert words.format(*gain(measure, change)) in page, measure
    variance = sum(mean("variance", minute) for minute in range(2, 11)) / 9
    colours = mean("histogram", 1), mean("histogram", 10)
    assert f"variance is {variance:.2f} of the truth's" in page
    assert "{:.2f} of the histogram of colours differs in the first minute, {:.2f} in the last".format(*colours) in page
    lasting = {robot: round(100 * row["object_found"]) for (robot, minute), row in mine.items() if minute == 10}
    assert lasting["pusher_sand"] == lasting["omni_chalk"] == 100
    assert sorted(lasting[robot] for robot in ("arm_chalk", "arm_sand", "picker_slate"))[::2] == [0, 3]
    later = [(row, small[place]) for place, row in mine.items() if place[1] > 1]
    beside = [x for measure in ("object_found", "psnr", "follows") for x in gain(measure, later)]
    said = (
        "From the second minute on, paired by robot, objects are found in {:.2f} ± {:.2f} more of the frames, PSNR is "
        "{:.1f} ± {:.1f} dB and follows {:.2f} ± {:.2f} higher."
    )
    assert said.format(*beside) in page


def test_robots_that_lose_their_heading_steer_to_the_end_as_the_page_says():
    rows, page = read_rows(RESULTS / "steers.csv"), words_of(PAGE)
    assert {(row["robot"], row["start"], row["part"]) for row in rows} == {
        (robot, start, minute) for robot in ("rover_road", "omni_chalk") for start in (0, 1) for minute in range(1, 11)
    }

    def steers(robot: str, minute: int) -> float:
        return np.mean([row["steers"] for row in rows if (row["robot"], row["part"]) == (robot, minute)])

    ends = [steers(robot, minute) for robot in ("rover_road", "omni_chalk") for minute in (1, 10)]
    assert min(ends[1] / ends[0], ends[3] / ends[2]) > 0.5
    truly, worst = np.mean([row["true_steers"] for row in rows]), min(row["steers"] for row in rows)
    said = "minute {:.2f} and {:.2f} for rover_road, {:.2f} and {:.2f} for omni_chalk, in no minute below {:.2f}; in the true"
    assert said.format(*ends, worst) in page and f"simulator's own frames {truly:.2f}" in page
    last = [f"{100 * row['object_found']:.0f}" for row in rows if (row["robot"], row["part"]) == ("rover_road", 10)]
    assert (
        "shows its own in {} % of the last; from the other starts in the third minute, and in {} %".format(*last)
        in page
    )
    lost = [
        [r["part"] for r in rows if r["robot"] == "omni_chalk" and r["start"] == s and r["object_found"] < 0.1]
        for s in (0, 1)
    ]
    assert [min(parts) for parts in lost] == [4, 3]
    follows = [row["follows"] for row in rows]
    assert f'"follows" wanders from {min(follows):.2f} to {max(follows):.2f}' in page


def test_what_a_displaced_past_adds_to_the_served_model_is_as_the_page_says():
    page = words_of(PAGE)
    ten, grown = by_place("kept_ten.csv"), by_place("grown_ten.csv")
    assert len(ten) == 8 * 10 and ten.keys() == grown.keys()

    def found(minute: int, of: dict) -> str:
        rows = [row for row in of.values() if row["part"] == minute]
        return f"{100 * over_robots(rows, 'object_found')[0]:.0f}"

    kept, before = ([found(minute, of) for minute in (1, 2, 10)] for of in (ten, grown))
    said = "in {} % of the frames of the first minute, in {} % of those of the second and in {} % of the last, where"
    assert said.format(*kept) in page and '"grown" has {}, {} and {}.'.format(*before) in page
    assert f"trained on a displaced past has {kept[2]} % from the first starts" in page
    last, later = ([(row, grown[k]) for k, row in ten.items() if k[2] >= first] for first in (10, 2))
    more, half = gain("object_found", last)
    assert more > half
    said = "that is {:.2f} ± {:.2f} more, from the second on {:.2f} ± {:.2f}:"
    assert said.format(more, half, *gain("object_found", later)) in page
    lost = [robot for (robot, _, minute), row in ten.items() if minute == 10 and row["object_found"] < 0.1]
    assert lost == ["arm_sand"]
    objects, tools, psnr = (gain(measure, later) for measure in ("object_close", "tool_close", "psnr"))
    said = "in place are {:.2f} ± {:.2f} fewer over the ten minutes, tools {:.2f} ± {:.2f} fewer, PSNR is {:.1f} ± {:.1f} dB"
    assert said.format(-objects[0], objects[1], -tools[0], tools[1], -psnr[0], psnr[1]) in page

    drawn = by_place("drawn_ten.csv")
    training = [gain("object_found", [(row, drawn[k]) for k, row in ten.items() if k[2] >= first]) for first in (10, 2)]
    psnr = gain("psnr", [(row, drawn[k]) for k, row in ten.items() if k[2] >= 2])
    said = (
        "found in {:.2f} ± {:.2f} more of the frames of the last minute, from the second on in {:.2f} ± {:.2f} more "
        "(PSNR {:+.1f} ± {:.1f} dB)"
    )
    assert said.format(*training[0], *training[1], *psnr) in page

    minute, drawing = gains("kept", "object_found", "grown"), gains("drawn", "object_found", "grown")
    assert "objects are found in {:.2f} ± {:.2f} more of the frames than with".format(*minute) in page
    assert '"drawn" finds {:.2f} ± {:.2f} more, and'.format(*drawing) in page
    said = "training gains {:.2f} ± {:.2f}, which eight robots do not decide"
    assert said.format(*gains("kept", "object_found", "drawn")) in page


def test_what_drawing_tokens_does_is_as_the_page_says():
    page, drawn, grown = words_of(PAGE), of_three_starts("drawn"), of_three_starts("grown")
    assert len(drawn) == 8 * 3 * 10 and drawn.keys() == grown.keys()

    def percent(rows: list[dict], measure: str = "object_found") -> str:
        mean, _, robots = over_robots(rows, measure)
        assert robots == 8
        return f"{100 * mean:.0f}"

    def share(of: dict, minutes: range, starts: tuple = (0, 1, 2), measure: str = "object_found") -> str:
        return percent([row for (_, start, at), row in of.items() if at in minutes and start in starts], measure)

    def more(measure: str, first: int, starts: tuple = (0, 1, 2)) -> tuple[float, float]:
        return gain(measure, [(row, grown[k]) for k, row in drawn.items() if k[2] >= first and k[1] in starts])

    later, end = range(2, 11), range(10, 11)
    last, tools = [share(of, end) for of in (drawn, grown)], share(drawn, end, measure="tool_found")
    readme = words_of(ROOT / "README.md")
    assert f"| {last[0]} % of objects, {tools} % of tools | objects, greedy decoding: {last[1]} % |" in readme
    said = "objects are found in {} % of the frames of the last minute, in {} with the likeliest tokens"
    assert said.format(*last) in words_of(ROOT / "docs" / "results.md")
    said = (
        "Objects are found in {} % of the frames of the last minute, not in all, and in {} % with the likeliest tokens"
    )
    assert said.format(*last) in page
    said = "in {} % of the frames, by the likeliest tokens in {}, paired by robot {:+.2f} ± {:.2f}. In the last minute it is"
    assert said.format(share(drawn, later), share(grown, later), *more("object_found", 2)) in page
    gained, half = more("object_found", 10)
    assert (
        "minute it is {} % and {}, {:+.2f} ± {:.2f}, which eight".format(*last, gained, half) in page and gained < half
    )
    by_start = [share(of, end, (start,)) for of in (drawn, grown) for start in (0, 1, 2)]
    said = "in {}, {} and {} % of the frames from the first, second and third starts, by the likeliest tokens in {}, {} and {}."
    assert said.format(*by_start) in page
    kept = {robot: [round(100 * drawn[robot, start, 10]["object_found"]) for start in (0, 1, 2)] for robot, *_ in drawn}
    assert "(arm_chalk: {}, {} and {} %)".format(*kept["arm_chalk"]) in page
    assert [robot for robot, shares in kept.items() if max(shares) < 10] == ["picker_slate"]
    assert "in the last minute, {:+.2f} ± {:.2f}.".format(*more("object_found", 10, (0,))) in page
    said = "where drawing alone has {}, and is further"
    assert said.format(by_start[0]) in page
    cost = [x for measure in ("psnr", "tool_close", "follows") for x in more(measure, 2)]
    said = "PSNR {:+.1f} ± {:.1f} dB, tools in place {:+.2f} ± {:.2f}, follows {:+.2f} ± {:.2f};"
    assert said.format(*cost) in page

    less = read_rows(RESULTS / "drawn_less.csv")
    each = [[r for r in less if r["variant"] == v and r["part"] >= 2] for v in ("temperature 0.4", "two likeliest")]
    beside = [
        x for rows in each for x in gain("object_found", [(r, grown[r["robot"], r["start"], r["part"]]) for r in rows])
    ]
    assert "({:+.2f} ± {:.2f} and {:+.2f} ± {:.2f}), where temperature 0.7 has".format(*beside) in page
    shares = [percent(rows) for rows in each]
    shares += [share(of, range(2, 6), (0,)) for of in (grown, drawn)]
    said = (
        "in {} % of the frames from the second minute to the fifth at temperature 0.4 and in {} % where one of the two "
        "likeliest entries of each factor is drawn, as in {} % by the likeliest tokens ("
    )
    assert said.format(*shares[:3]) in page and f"where temperature 0.7 has {shares[3]} %" in page


def test_size_and_data_keep_objects():
    page = words_of(PAGE)
    larger, grown = (
        [
            x
            for measure in ("object_found", "object_close", "tool_close", "psnr")
            for x in gains(name, measure, "weighed")
        ]
        for name in ("larger", "grown")
    )
    said = (
        '"larger" finds objects in {:.2f} ± {:.2f} more of the frames than "weighed" (in place {:.2f} ± {:.2f}), has '
        "tools in place in {:.2f} ± {:.2f} more and {:.1f} ± {:.1f} dB more PSNR"
    )
    assert said.format(*larger) in page
    said = (
        '"grown" finds objects in {:.2f} ± {:.2f} more (in place {:.2f} ± {:.2f}), tools in place in {:.2f} ± {:.2f} more, '
        "PSNR {:+.1f} ± {:.1f} dB"
    )
    assert said.format(*grown) in page
    assert "from chance (objects found {:+.2f} ± {:.2f})".format(*gains("grown", "object_found", "larger")) in page


def test_half_of_what_was_hidden_comes_back():
    rows, page = read_rows(RESULTS / "grown_hidden.csv"), words_of(PAGE)
    hidden, control = ([row for row in rows if row["kind"] == kind] for kind in ("hidden", "control"))
    assert len(hidden) == len(control) == 48
    found, close, stay, stay_close = (
        [round(100 * x) for x in over_robots(mine, name)[:2]]
        for mine in (hidden, control)
        for name in ("found", "close")
    )
    assert (
        f"in {found[0]} ± {found[1]} % of the cases, in {close[0]} ± {close[1]} % in place; of those never hidden"
        in page
    )
    assert f"of those never hidden {stay[0]} ± {stay[1]} and {stay_close[0]} ± {stay_close[1]} %." in page
    short, long = ([r["found"] for r in hidden if (r["gone"] >= 4) == late] for late in (False, True))
    assert f"it is {sum(short):.0f} of {len(short)}, after four or more {sum(long):.0f} of {len(long)}" in page


def test_the_detector_finds_what_is_there():
    detector = Detector.load(DETECTOR / WEIGHTS)
    with (DETECTOR / "errors.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["robot"] for row in rows} == set(detector.robots) and len(detector.robots) == 8
    for row in rows:
        if row["frames_of"] == "true":
            assert float(row["within_4px"]) > 0.9 and float(row["median_px"]) < 0.6, row
