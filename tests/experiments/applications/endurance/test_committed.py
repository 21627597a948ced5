"""The committed tables of how long the served model holds are what docs/endurance.md shows."""

from __future__ import annotations

import csv

import numpy as np

from experiments.applications.detector import CLOSE_PX, MIN_CONFIDENCE, SURE_CONFIDENCE, WEIGHTS, Detector
from experiments.applications.detector import COMMITTED as DETECTOR
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
    mean_in,
    of_three_starts,
    percent_in,
    rows_of_trained,
    words_of,
)
from tests.pages import table

THRESHOLDS = MIN_CONFIDENCE, SURE_CONFIDENCE


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
    (first, second, last), before = ([percent_in(minute, of) for minute in (1, 2, 10)] for of in (mine, small))
    said = f"found in {first} % of the frames of the first minute, {second} % of the second and {last} % of the last; small model: "
    assert said + "{}, {} and {} %.".format(*before) in page
    assert f"Tools are found in {percent_in(10, mine, 'tool_found')} % of the frames of the last minute" in page
    said = f'"Follows" is {mean_in(1, mine, "follows"):.2f} in the first minute and {mean_in(10, mine, "follows"):.2f} in the last. '
    following = [robot for robot, minute in mine if minute == 1 and mine[robot, 1]["follows"] > 0.5]
    keeping = [robot for robot in following if mine[robot, 10]["follows"] >= mine[robot, 1]["follows"] / 2]
    assert len(following) == 6
    assert len(keeping) == 6
    said += "Six robots have more than 0.5 in the first minute, and all six keep at least half of their value."
    assert said in page
    places = {robot: round(100 * row["tool_close"]) for (robot, minute), row in mine.items() if minute == 10}
    grippers, arms, pusher_in_place = (
        [places.pop(f"{kind}_{name}") for name in names]
        for kind, names in (("gripper", ("wood", "night")), ("arm", ("chalk", "sand")), ("pusher", ("sand",)))
    )
    assert "in {} and {} % of the last minute for the two grippers".format(*grippers) in page
    pusher = mine["pusher_sand", 10]
    followed = f'("follows" {pusher["follows"]:.2f}, but {pusher["tool_px"]:.0f} pixels off)'
    said = f"in place in {{}} % for pusher_sand {followed}, {{}} and {{}} % for the two arms, at most {{}} % for the other three."
    assert said.format(*pusher_in_place, *arms, max(places.values())) in page and len(places) == 3
    change = [(mine[robot, 10], mine[robot, 2]) for robot, minute in mine if minute == 10]
    for measure, words in (
        ("psnr", "PSNR changes by {:+.1f} ± {:.1f} dB"), ("follows", '"follows" by {:+.2f} ± {:.2f}'),
        ("object_found", "objects found by {:+.2f} ± {:.2f}"),
    ):  # fmt: skip
        assert words.format(*gain(measure, change)) in page, measure
    variance = sum(mean_in(minute, mine, "variance") for minute in range(2, 11)) / 9
    colours = mean_in(1, mine, "histogram"), mean_in(10, mine, "histogram")
    assert f"The variance of frames is {variance:.2f} of the true one." in page
    said = "The share of the colour histogram that differs is {:.2f} in the first minute, {:.2f} in the last."
    assert said.format(*colours) in page
    lasting = {robot: round(100 * row["object_found"]) for (robot, minute), row in mine.items() if minute == 10}
    assert lasting["pusher_sand"] == lasting["omni_chalk"] == 100
    assert sorted(lasting[robot] for robot in ("arm_chalk", "arm_sand", "picker_slate"))[::2] == [0, 3]
    later = [(row, small[place]) for place, row in mine.items() if place[1] > 1]
    beside = [x for measure in ("object_found", "psnr", "follows") for x in gain(measure, later)]
    said = (
        "From the second minute on, paired by robot, the difference from the small model is {:+.2f} ± {:.2f} in objects "
        'found, {:+.1f} ± {:.1f} dB in PSNR and {:+.2f} ± {:.2f} in "follows".'
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
    said = (
        '"Steers" in the first and last minute is {:.2f} and {:.2f} for rover_road, {:.2f} and {:.2f} for omni_chalk; no '
        "minute is below {:.2f}. The true simulator's own frames give {:.2f}."
    )
    assert said.format(*ends, worst, truly) in page
    last = [f"{100 * row['object_found']:.0f}" for row in rows if (row["robot"], row["part"]) == ("rover_road", 10)]
    said = (
        "rover_road's is found in {} % of the last. From the second starts omni_chalk loses its object in the third minute, "
        "and rover_road's is found in {} % of the last."
    )
    assert said.format(*last) in page
    lost = [
        [r["part"] for r in rows if r["robot"] == "omni_chalk" and r["start"] == s and r["object_found"] < 0.1]
        for s in (0, 1)
    ]
    assert [min(parts) for parts in lost] == [4, 3]
    follows = [row["follows"] for row in rows]
    assert f'"follows" varies from {min(follows):.2f} to {max(follows):.2f}' in page


def test_what_a_displaced_past_adds_to_the_served_model_is_as_the_page_says():
    page = words_of(PAGE)
    ten, grown = by_place("kept_ten.csv"), by_place("grown_ten.csv")
    assert len(ten) == 8 * 10 and ten.keys() == grown.keys()
    kept, before = ([percent_in(minute, of) for minute in (1, 2, 10)] for of in (ten, grown))
    said = (
        'in {} % of the frames of the first minute, {} % of the second and {} % of the last; "grown": {}, {} and {} %.'
    )
    assert said.format(*kept, *before) in page
    assert f'Training on a displaced past ("kept") gives {kept[2]} % from the first starts;' in page
    last, later = ([(row, grown[k]) for k, row in ten.items() if k[2] >= first] for first in (10, 2))
    more, half = gain("object_found", last)
    assert more > half
    said = "the difference is {:+.2f} ± {:.2f} in the last minute, {:+.2f} ± {:.2f} from the second on."
    assert said.format(more, half, *gain("object_found", later)) in page
    lost = [robot for (robot, _, minute), row in ten.items() if minute == 10 and row["object_found"] < 0.1]
    assert lost == ["arm_sand"]
    objects, tools, psnr = (gain(measure, later) for measure in ("object_close", "tool_close", "psnr"))
    said = "objects in place {:+.2f} ± {:.2f}, tools in place {:+.2f} ± {:.2f}, PSNR {:+.1f} ± {:.1f} dB. Over the 24"
    assert said.format(*objects, *tools, *psnr) in page

    drawn = by_place("drawn_ten.csv")
    training = [gain("object_found", [(row, drawn[k]) for k, row in ten.items() if k[2] >= first]) for first in (10, 2)]
    psnr = gain("psnr", [(row, drawn[k]) for k, row in ten.items() if k[2] >= 2])
    said = (
        'compared with "drawn", the difference is {:+.2f} ± {:.2f} in the last minute, {:+.2f} ± {:.2f} from the second '
        "on (PSNR {:+.1f} ± {:.1f} dB)."
    )
    assert said.format(*training[0], *training[1], *psnr) in page

    minute, drawing = gains("kept", "object_found", "grown"), gains("drawn", "object_found", "grown")
    training = gains("kept", "object_found", "drawn")
    assert training[0] < training[1]
    said = (
        'the gain in objects found over "grown" is {:+.2f} ± {:.2f}. About half of it comes from sampling ("drawn" over '
        '"grown": {:+.2f} ± {:.2f}); the gain of training ("kept" over "drawn") is {:+.2f} ± {:.2f}, not significant.'
    )
    assert said.format(*minute, *drawing, *training) in page


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
    greedy = f"objects, greedy decoding: {last[1]} % (difference not significant)"
    assert f"| {last[0]} % of objects, {tools} % of tools | {greedy} |" in readme
    said = "objects are found in {} % of the frames of the last minute, in {} % with greedy decoding"
    assert said.format(*last) in words_of(ROOT / "docs" / "results.md")
    said = "In the last minute objects are found in {} % of the frames, with greedy decoding in {} % (three starts"
    assert said.format(*last) in page
    said = "on in {} % of the frames, greedy {} %; paired by robot {:+.2f} ± {:.2f}. In the last minute "
    assert said.format(share(drawn, later), share(grown, later), *more("object_found", 2)) in page
    gained, half = more("object_found", 10)
    said = "In the last minute {} %, greedy {} %: {:+.2f} ± {:.2f}, not significant over eight robots."
    assert said.format(*last, gained, half) in page and gained < half
    by_start = [share(of, end, (start,)) for of in (drawn, grown) for start in (0, 1, 2)]
    said = (
        "From the first, second and third starts, objects are found in {}, {} and {} % of the frames of the last minute, "
        "greedy {}, {} and {} %."
    )
    assert said.format(*by_start) in page
    kept = {robot: [round(100 * drawn[robot, start, 10]["object_found"]) for start in (0, 1, 2)] for robot, *_ in drawn}
    assert "(arm_chalk: {}, {} and {} %)".format(*kept["arm_chalk"]) in page
    assert [robot for robot, shares in kept.items() if max(shares) < 10] == ["picker_slate"]
    assert "in the last minute would be {:+.2f} ± {:.2f}.".format(*more("object_found", 10, (0,))) in page
    said = 'sampling alone ("drawn") gives {} % there, and "kept" is otherwise further'
    assert said.format(by_start[0]) in page
    cost = [x for measure in ("psnr", "tool_close", "follows") for x in more(measure, 2)]
    said = 'PSNR {:+.1f} ± {:.1f} dB, tools in place {:+.2f} ± {:.2f}, "follows" {:+.2f} ± {:.2f}. Over'
    assert said.format(*cost) in page

    less = read_rows(RESULTS / "drawn_less.csv")
    each = [[r for r in less if r["variant"] == v and r["part"] >= 2] for v in ("temperature 0.4", "two likeliest")]
    beside = [
        x for rows in each for x in gain("object_found", [(r, grown[r["robot"], r["start"], r["part"]]) for r in rows])
    ]
    shares = [percent(rows) for rows in each]
    shares += [share(of, range(2, 6), (0,)) for of in (grown, drawn)]
    said = (
        "From the first starts, minutes 2 to 5, objects are found in {} % of the frames at temperature 0.4 and in {} % "
        "when one of the two likeliest entries of each factor is drawn; greedy {} % (differences {:+.2f} ± {:.2f} and "
        "{:+.2f} ± {:.2f}), temperature 0.7 {} % ("
    )
    assert said.format(*shares[:3], *beside, shares[3]) in page


def test_size_and_data_keep_objects():
    columns = ("object_found", 2), ("object_close", 2), ("tool_close", 2), ("psnr", 1)
    shown = table(PAGE, "| compared |")
    assert shown.keys() == {"larger - weighed", "grown - weighed", "hours - weighed", "grown - hours", "grown - larger"}
    for label, cells in shown.items():
        name, other = label.split(" - ")
        apart = [(*gains(name, of, other), digits) for of, digits in columns]
        found = [f"{mean:+.{digits}f} ± {half:.{digits}f}" for mean, half, digits in apart]
        assert cells == (found[:1] + [""] * 3 if other == "larger" else found), label


def test_robots_of_the_model_that_two_cores_train_stay_and_objects_do_not():
    rows, page = by_place("hours_ten.csv"), words_of(PAGE)
    first, last = ([row for (_, _, minute), row in rows.items() if minute == at] for at in (1, 10))
    tools, *follows = (
        over_robots(of, measure)[0] for of, measure in ((last, "tool_found"), (first, "follows"), (last, "follows"))
    )
    said = f"tools are found in {100 * tools:.0f} % of the frames of the last minute, "
    said += '"follows" is {:.2f} in the first and {:.2f} in the last. '.format(*follows)
    objects = (100 * over_robots(of, "object_found")[0] for of in (first, last))
    assert said + "Objects are found in {:.0f} and {:.0f} % of the frames".format(*objects) in page


def test_half_of_what_was_hidden_comes_back():
    rows, page = read_rows(RESULTS / "grown_hidden.csv"), words_of(PAGE)
    hidden, control = ([row for row in rows if row["kind"] == kind] for kind in ("hidden", "control"))
    assert len(hidden) == len(control) == 48
    found, close, stay, stay_close = (
        [round(100 * x) for x in over_robots(mine, name)[:2]]
        for mine in (hidden, control)
        for name in ("found", "close")
    )
    said = f"shows it in {found[0]} ± {found[1]} % of the cases, and in place in {close[0]} ± {close[1]} %; controls: "
    assert said + f"{stay[0]} ± {stay[1]} and {stay_close[0]} ± {stay_close[1]} %." in page
    short, long = ([r["found"] for r in hidden if (r["gone"] >= 4) == late] for late in (False, True))
    assert f"shows {sum(short):.0f} of {len(short)} objects, after four or more {sum(long):.0f} of {len(long)}" in page
    gone = [row["gone"] for row in hidden]
    assert f"an object is out of view for {min(gone):.0f} to {max(gone):.0f} frames" in page
    moved, stayed, control_moved, control_stayed = (
        (len(those), *(int(sum(row[name] for row in those)) for name in ("found", "close")))
        for mine in (hidden, control)
        for far in (True, False)
        for those in [[row for row in mine if (row["moved_px"] > CLOSE_PX) == far]]
    )
    said = (
        f"of the {{}} objects that end more than {CLOSE_PX:.0f} pixels from where they were last seen, the model shows {{}}, "
        "and {} of these in place; of the other {} it shows {}, and {} of these in place. Controls: of the {} that moved as "
        "far, {} are shown and {} in place; of the other {}, {} and {}."
    )
    assert said.format(*moved, *stayed, *control_moved, *control_stayed) in page


def test_how_much_is_found_depends_on_the_threshold_as_the_page_says():
    page, places = words_of(PAGE), ROOT / "experiments" / "results" / "in_place"

    def found(rows: list[dict], column: str = "confidence") -> list[str]:
        return [f"{100 * np.mean([row[column] >= least for row in rows]):.0f}" for least in THRESHOLDS]

    grown, small = (
        [found([row for row in read_rows(RESULTS / name) if row["kind"] == kind]) for kind in ("hidden", "control")]
        for name in ("grown_hidden.csv", "hidden.csv")
    )
    least, sure = THRESHOLDS
    assert f"the detector's confidence is at least {least:g}." in page
    said = f"At {sure:g} [hidden objects](#ten-minutes) are shown again in {{1}} % of the cases instead of {{0}} %, controls in "
    said += "{3} instead of {2} %; in the small model in {5} instead of {4} %, and {7} instead of {6} %."
    assert said.format(*grown[0], *grown[1], *small[0], *small[1]) in page
    with (places / "grown.csv").open(newline="") as file, (places / "weighed.csv").open(newline="") as other:
        moved = [
            [
                {name: float(row[name]) for name in ("model_confidence", "true_confidence")}
                for row in csv.DictReader(text)
                if row["what"].startswith("colour") and float(row["moved_px"]) > CLOSE_PX
            ]
            for text in (file, other)
        ]
    said = "in a window, {1} % are found instead of {0} %, in the small model {3} instead of {2} %"
    assert said.format(*(x for rows in moved for x in found(rows, "model_confidence"))) in page
    hidden = [row for row in read_rows(RESULTS / "grown_hidden.csv") if row["kind"] == "hidden"]
    true = found(moved[0], "true_confidence"), found(hidden, "true_confidence")
    assert {all_of for all_of, _ in true} == {"100"}
    missed = sorted(100 - int(some) for _, some in true)
    assert f"{least:g} misses none of these objects, {sure:g} misses {missed[0]} to {missed[1]} %." in page


def test_false_detections_are_as_the_page_says():
    with (DETECTOR / "errors.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["frames_of"] == "true"]

    def counts(why: str) -> tuple[int, int]:
        """Detected, and of how many objects."""
        of = [(float(row[f"ghosts_{why}"]), int(row[why])) for row in rows if row["what"] == "object" and int(row[why])]
        return round(sum(share * n for share, n in of)), sum(n for _, n in of)

    absent, hidden, partly = map(counts, ("absent", "hidden", "partly"))
    tools = [100 * float(row["ghosts_hidden"]) for row in rows if row["what"] == "tool" and int(row["hidden"])]
    said = (
        f"{100 * absent[0] / absent[1]:.1f} % of the colours that no object of the episode has, {hidden[0]} of {hidden[1]} "
        f"objects of which nothing is in view, {100 * partly[0] / partly[1]:.0f} % of the {partly[1]} of which less than a "
        f"quarter is, and {min(tools):.0f} to {max(tools):.0f} % of tools out of view (arms and picker)."
    )
    assert said in words_of(PAGE)


def test_the_detector_finds_what_is_there():
    detector = Detector.load(DETECTOR / WEIGHTS)
    with (DETECTOR / "errors.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["robot"] for row in rows} == set(detector.robots) and len(detector.robots) == 8
    for row in rows:
        if row["frames_of"] == "true":
            assert float(row["within_4px"]) > 0.9 and float(row["median_px"]) < 0.6, row
