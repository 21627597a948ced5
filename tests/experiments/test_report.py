"""CSV, figures and page from finished trials; what failed stays visible in all of them."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from experiments.analysis.changes import find_changes
from experiments.analysis.optima import find_optima
from experiments.analysis.rows import OVERALL, curve, read_csv, read_rows, tally, write_rows
from experiments.analysis.scaling import curves_of, fit_curve, trunk_parameters
from experiments.data_size import read_data
from experiments.presets import CPU_FULL
from experiments.report import page, plots
from experiments.report.draw import draw
from experiments.report.findings import read_findings
from experiments.report.numbers import Numbers
from experiments.report.pieces import picture, pm
from experiments.report.plot_families import plot_family
from experiments.report.plot_names import plot_names
from experiments.report.plot_style import ONE_SEED, LogTicks, count, drawn_curve, save
from experiments.report.robots import describe_robots, robots_of
from experiments.report.style import CSS
from experiments.report.sweeps import AxisStatistics, describe
from experiments.report.validity import Check, check_study
from experiments.running.trial import trial_id
from experiments.running.workspace import Workspace
from experiments.sweeps.conditioning import plan as plan_conditioning
from experiments.sweeps.datasets import plan as plan_datasets
from experiments.sweeps.horizon import plan as plan_horizon
from experiments.sweeps.newcomers import plan as plan_newcomers
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import CONTROL, POINT, unique_trials
from experiments.sweeps.width import plan as plan_width
from hma_jax.config import ConfigError
from tests.experiments.fakes import PROVENANCE, STUDY, finished_study, record_of, rows_of
from tests.experiments.judged import WIDE, windows_of
from tests.full_disk import full_disk


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """A study in which one width diverged, with everything drawn."""
    root = tmp_path_factory.mktemp("study")
    workspace = finished_study(root, broken={"width 8 · seed 1": "diverged"})
    draw(workspace, record_of())
    return workspace


def test_rows_carry_hashes_and_average_over_the_scope(drawn):
    rows = rows_of(drawn, [plan_datasets(STUDY)])
    first = next(r for r in rows if r.metric == "perplexity" and r.scope == OVERALL)
    each = [r for r in rows if r.trial == first.trial and r.metric == "perplexity" and r.scope != OVERALL]
    assert [r.scope for r in each] == ["arm", "rover"]  # the reference knows three, the axis judges two
    assert first.mean == pytest.approx(sum(r.mean for r in each) / 2)
    assert first.sem == pytest.approx(0.2 / math.sqrt(2)) and (first.n, first.episodes) == (20, 8)
    assert (first.store, first.results, first.code) == (PROVENANCE.store, PROVENANCE.results, "c0de")


def test_the_time_of_a_trial_is_said_to_be_that_of_its_last_attempt(drawn):
    """After it was stopped at 95 % the page says minutes."""
    assert "<th scope=col>time, last attempt</th>" in drawn.report.read_text()


def test_tables_read_back_what_was_written(drawn, tmp_path):
    rows, a, b = rows_of(drawn, [plan_width(STUDY)]), Workspace(tmp_path / "a"), Workspace(tmp_path / "b")
    a.root.mkdir(), b.root.mkdir()
    write_rows(a, rows)
    again = read_rows(a)
    write_rows(b, again)
    assert a.results.read_bytes() == b.results.read_bytes() and a.robots.read_bytes() == b.robots.read_bytes()
    assert {repr(r) for r in again} == {repr(r) for r in rows}
    assert {r.scope for r in read_csv(a.results)} == {OVERALL, "training", ""}
    a.robots.write_bytes(a.robots.read_bytes()[:-100])
    with pytest.raises(ConfigError, match="robots.parquet: not a table of rows.*`hma report`"):
        read_rows(a)
    head, first, *others = a.results.read_bytes().splitlines(keepends=True)
    unclosed, other_bytes = b'"' + first + 140_000 * b" ", first.replace(b"width", b"w\xefdth", 1)
    for damaged in (b'"' + first, unclosed, other_bytes, first[:20]):
        a.results.write_bytes(head + damaged + b"".join(others[:5]))
        with pytest.raises(ConfigError, match="results.csv, line 2: not a row of results .*`hma report`"):
            read_csv(a.results)


@pytest.mark.parametrize("text", [b"", b"null", b'{"arm": 3}', b'{"arm": {"windows": 2}}', b"\xff"])
def test_a_damaged_count_of_the_data_is_named(tmp_path, text):
    (tmp_path / "data.json").write_bytes(text)
    with pytest.raises(ConfigError, match="data.json does not say how much there is of each robot .*; remove it"):
        read_data(tmp_path / "data.json")


@pytest.mark.parametrize("text", ["", "null", '{"mean": 20.0}', '{"mean": "x", "sem": 0.1}'])
def test_a_damaged_quality_of_the_tokenizer_is_named(tmp_path, text):
    workspace = Workspace(tmp_path)
    assert page._tokenizer_quality(workspace) is None
    workspace.tokenizer.mkdir()
    (workspace.tokenizer / "quality.json").write_text(text)
    with pytest.raises(ConfigError, match="quality.json: no quality of a tokenizer can be read .*; restore the file"):
        page._tokenizer_quality(workspace)


def test_findings_of_another_encoding_are_named_and_a_mark_of_utf_8_is_none_of_them(tmp_path):
    path = tmp_path / "findings.md"
    path.write_text("## `width`\n\nΔPSNR falls\n", encoding="utf-8-sig")
    assert "ΔPSNR falls" in read_findings(path, ("width",)).of_axes["width"]
    path.write_text("## `width`\n\ndéjà\n", encoding="latin-1")
    with pytest.raises(ConfigError, match="findings.md is not UTF-8 .*; save it in this encoding"):
        read_findings(path, ("width",))


def test_curve_joins_seeds_and_windows(drawn):
    points = curve(rows_of(drawn, [plan_width(STUDY)]), "width", "perplexity")
    assert [p.x for p in points] == [8, 16]
    assert len(points[0].seeds) == 1 and len(points[1].seeds) == 2  # one seed of width 8 diverged
    both = points[1]
    assert both.mean == pytest.approx(sum(both.seeds.values()) / 2)
    spread = (both.seeds[0] - both.seeds[1]) ** 2 / 4
    assert both.sem == pytest.approx(math.sqrt(spread + 0.04 / 3))


def test_errors_of_robots_drawn_for_every_seed_count_their_windows_once(drawn, tmp_path, monkeypatch):
    """What windows do to the mean of a seed is within the spread over seeds, if they are others for each."""
    rows, sweep = rows_of(drawn, [plan_width(STUDY)]), plan_width(STUDY)
    one, several = curve(rows, "width", "cross_entropy", robots_vary=True)
    assert several.sem == several.seed_sem > 0 and one.sem == curve(rows, "width", "cross_entropy")[0].sem > 0
    kept = []
    monkeypatch.setattr(plots, "save", lambda figure, _: kept.append(figure))
    points = [replace(p, scope=STUDY.dataset_names()[p.trial.train.seed :]) for p in sweep.points]
    plots.plot_sweep(rows, replace(sweep, points=tuple(points)), tmp_path / "width.png")
    bars = {c.get_label(): c for c in kept[0].axes[0].containers}["mean ± s.e. over seeds, each with its own robots"]
    low, high = bars.lines[2][0].get_segments()[0][:, 1]
    assert high - low == pytest.approx(2 * several.seed_sem * math.exp(several.mean))


def test_control_and_untrained_stay_off_the_curve(drawn):
    rows = rows_of(drawn, [plan_width(STUDY)])
    assert curve(rows, "width", "delta_psnr", "control")[0].mean == pytest.approx(1.0)  # 0 + 1 + 2 over 3
    assert curve(rows, "width", "perplexity", "untrained")[0].mean == 256
    assert all(r.role == "point" for r in rows if r.metric == "delta_psnr" and r.seed == 1)


def test_diverged_trial_is_in_csv_and_tally(drawn):
    rows = read_csv(drawn.results)
    lost = [r for r in rows if r.status == "diverged"]
    assert [(r.sweep, r.x, r.seed, r.metric) for r in lost] == [("width", 8, 1, "")]
    assert tally(rows, "width") == (4, 5)  # two widths, two seeds, one control


def test_page_is_self_contained_and_names_what_failed(drawn):
    page = drawn.report.read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page) and "http" not in page
    assert page.count("data:image/png;base64,") >= 1 + 3 * 3  # curves, and three strips of three datasets
    assert 'class="diverged"' in page and "the loss is &lt;nan&gt; at step 2; output in trials/" in page
    assert str(drawn.root) not in page
    for fact in ("hma study", PROVENANCE.tokenizer, "abacus", "1 trial has no result"):
        assert fact in page


def test_a_page_has_links_to_its_sections_and_what_its_parts_are(drawn):
    """For who reads on a phone, or by ear; links without an id, or to one of two, lead nowhere."""
    page = drawn.report.read_text()
    ids, links = re.findall(r' id="?([\w-]+)', page), re.findall(r'href="#([^"]+)"', page)
    assert len(links) == page.count("<h2>") >= 5 and set(links) <= set(ids) and len(set(ids)) == len(ids)
    assert page.count("<th ") == len(re.findall("<th scope=(?:row|col)", page)) and "<th>" not in page
    assert 'alt="Scaling curves, of which the tables below have the numbers"' in page
    assert page.count("<span class=still>") == page.count("<span class=moving>") == 3


def test_a_page_bears_the_name_of_its_directory_and_no_card_without_a_number(drawn):
    """Studies of one preset had one title, and a tokenizer that was given a card with a dash."""
    page = drawn.report.read_text()
    assert f"<h1>HMA study <em>{STUDY.name} ({drawn.root.name})</em></h1>" in page
    assert f"<title>HMA-JAX study: {STUDY.name} ({drawn.root.name})</title>" in page
    assert "tokenizer PSNR" not in page


def test_a_page_is_dated_by_all_of_its_trials():
    """It had the day of one of them alone, months before the last."""
    days = {"a": "2026-02-03 23:00:00 +0000", "b": "2026-02-04 00:10:00 +0200", "c": "2025-12-31 12:00:00 +0000"}
    results = {id: {"run": {"finished": day}} for id, day in days.items()}
    assert page._finished_when(results, "abc") == "trials finished 2025-12-31 to 2026-02-03"
    assert page._finished_when(results, "a") == "trials finished 2026-02-03"


def test_paper_has_what_a_page_unfolds_and_no_line_ends_before_an_error():
    paper = CSS[CSS.index("@media print") :]
    assert "details::details-content { content-visibility: visible" in paper and "h3, h4, summary { break-af" in paper
    assert " " not in pm(1.0, 0.1).replace("<span class", "")
    assert "table:has(th:nth-child(13)) { font-size: 6pt; }" in paper  # else the widest one shrinks all of the page


def test_a_figure_on_a_phone_keeps_the_size_of_its_text(drawn):
    """All were equally high: text of the highest was half as high as that of the others."""
    with Image.open(drawn.figures / "width.png") as image:
        points = 72 * image.width / image.info["dpi"][0]
    assert f'style="--wide: {points:.0f}px"' in picture(drawn.figures / "width.png", "")


def test_figures_are_pictures(drawn):
    for name in ("datasets", "trajectories", "width", "scaling"):
        assert (drawn.figures / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_a_full_disk_is_said_of_the_figure_and_leaves_nothing(tmp_path):
    with full_disk(100), pytest.raises(OSError, match="width.png"):
        save(plots.plt.figure(), tmp_path / "width.png")
    assert not list(tmp_path.iterdir())


def test_figures_show_what_the_table_says(drawn, tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(plots, "save", lambda figure, _: kept.append(figure))
    rows, sweep = rows_of(drawn, [plan_width(STUDY)]), plan_width(STUDY)
    plots.plot_sweep(rows, sweep, tmp_path / "width.png")
    (figure,) = kept
    figure.canvas.draw()
    panels = dict(zip(("perplexity", "delta_psnr"), figure.axes, strict=True))
    for metric, panel in panels.items():
        bars = {c.get_label(): c for c in panel.containers}
        points = drawn_curve(rows, sweep, metric)
        one, several = (bars[name].lines[0] for name in (ONE_SEED, "mean ± s.e. over seeds and episodes"))
        shown = [*one.get_xydata(), *several.get_xydata()]
        np.testing.assert_allclose(shown, [(p.x, p.mean) for p in points])
        assert one.get_markerfacecolor() == "white" != several.get_markerfacecolor()
        assert bars["trained on shuffled actions, one seed"].lines[0].get_xdata().tolist() == [sweep.reference_x]
        low, high = sorted(panel.get_ylim())
        labelled = [t for t in panel.yaxis.get_ticklabels() if t.get_text() and low <= t.get_position()[1] <= high]
        assert len(labelled) >= 3
        trunks = [count(trunk_parameters(replace(STUDY.model, width=p.x))) for p in points]
        assert [t.get_text().split("\n")[1] for t in panel.get_xticklabels() if t.get_text()] == trunks


@pytest.mark.parametrize(
    ("n", "words"), [(999.6, "999.6"), (999_499, "999k"), (999_600, "1.0M"), (999_999_999, "1.0G"), (1_234_567, "1.2M")]
)
def test_a_count_that_rounds_to_a_thousand_of_a_unit_is_one_of_the_next(n, words):
    """It was 1e+03k."""
    assert count(n) == words


@pytest.mark.parametrize("span", [1.5, 3, 5, 15, 50, 250, 400, 900, 2e3, 1e6])
@pytest.mark.parametrize("low", [0.011, 1.04, 105, 7e4])
def test_an_axis_has_at_least_three_ticks(low, span):
    high = low * span
    ticks = [t for t in LogTicks().tick_values(low, high) if low <= t <= high]
    assert 3 <= len(set(ticks)) <= 9, ticks


def test_what_lines_are_is_said_outside_of_panels(drawn, tmp_path, monkeypatch):
    """Within one it lay on the curves of `compute`."""
    kept = []
    monkeypatch.setattr(plots, "save", lambda figure, _: kept.append(figure))
    rows, width, steps = rows_of(drawn, [plan_width(STUDY)]), plan_width(STUDY), plan_horizon(CPU_FULL)
    plots.plot_sweep(rows, width, tmp_path / "width.png")
    plots.plot_overview(rows, [width, steps], tmp_path / "scaling.png")
    plots.plot_overview(rows, [steps, width], tmp_path / "scaling.png")  # nothing of the first has finished
    several = replace(width, points=tuple(replace(p, series=f"width {p.x}") for p in width.points))
    plots.plot_sweep([replace(r, series=f"width {r.x}") for r in rows], several, tmp_path / "several.png")
    for figure in kept:
        figure.canvas.draw()
        (legend,) = figure.legends
        box = legend.get_window_extent()
        assert 0 <= box.x0 and box.x1 <= figure.bbox.x1
        assert not any(panel.get_legend() or box.overlaps(panel.get_window_extent()) for panel in figure.axes)


@pytest.mark.parametrize("series", ["", "of two"])
def test_a_point_at_zero_is_drawn(drawn, series, tmp_path, monkeypatch):
    """As of an axis of one's own over a dropout or a decay: a log axis left it out without a word."""
    kept, width = [], plan_width(STUDY)
    monkeypatch.setattr(plots, "save", lambda figure, _: kept.append(figure))
    rows = [replace(r, sweep="decay", x=16 - r.x, series=series) for r in rows_of(drawn, [width])]
    points = tuple(replace(p, x=16 - p.x, series=series) for p in width.points)
    plots.plot_sweep(rows, replace(width, name="decay", points=points), tmp_path / "decay.png")
    kept[0].canvas.draw()
    for panel in kept[0].axes:
        low, high = panel.get_xlim()
        assert low < 0 < high and any(line.get_marker() == "o" and 0 in line.get_xdata() for line in panel.lines)
        assert [t.get_text() for t in panel.get_xticklabels()] == ["0", "8"]


@pytest.mark.parametrize(
    ("measured", "shown", "title"),
    [
        ({"perplexity": "diffusion_loss", "delta_psnr": "delta_psnr"}, ["diffusion loss", "ΔPSNR"], "untrained: 256"),
        ({"perplexity": "action_error"}, ["squared error of actions"], ""),
    ],
    ids=["latents", "policy"],
)
def test_what_a_model_was_trained_for_is_drawn(drawn, measured, shown, title, tmp_path, monkeypatch):
    """Latents had no curve of their loss; a policy had one of the perplexity of a head that nothing trains."""
    kept, sweep = [], plan_width(STUDY)
    monkeypatch.setattr(plots, "save", lambda figure, _: kept.append(figure))
    rows = [replace(r, metric=measured[r.metric]) for r in rows_of(drawn, [sweep]) if r.metric in measured]
    plots.plot_sweep(rows, sweep, tmp_path / "width.png")
    assert all(p.get_ylabel().startswith(name) for p, name in zip(kept[0].axes, shown, strict=True))
    assert kept[0].axes[0].get_title(loc="left") == title
    assert (kept[0].axes[0].get_yscale() == "log") == bool(title)
    several = replace(sweep, points=tuple(replace(p, series=f"width {p.x}") for p in sweep.points))
    plots.plot_sweep([replace(r, series=f"width {r.x}") for r in rows], several, tmp_path / "several.png")
    assert {p.get_ylabel() for p in kept[1].axes} == {p.get_ylabel() for p in kept[0].axes}
    said = describe(sweep, rows)
    assert "perplexity" not in said and all(name.removeprefix("squared ") in said for name in shown)
    checked = check_study([sweep], rows, [], {}, [], "reference", [], [], Check("", "good", ""), None)
    assert any("copying" in check.name for check in checked) == ("delta_psnr" in measured)
    cards = page._headline(drawn, record_of(), [sweep], rows, {}, page._ShownTrials(sweep, "reference"), "")
    assert "perplexity" not in cards and ("diffusion loss, untrained" in cards) == bool(title)
    listed = describe_robots(rows, sweep, robots_of(rows, sweep, PROVENANCE, {}), tmp_path / "data.json")
    assert ("s.e. above zero" in listed) == ("delta_psnr" in measured) and "ahead of copying" not in listed


def test_the_page_speaks_of_fits_where_a_trial_has_the_loss_that_is_fitted(drawn):
    """Of policies and of latents it explained a fit in nats per token, of which there was none."""
    sweep = plan_width(STUDY)
    windows = {id: windows_of(trial) for id, trial in unique_trials([sweep], PROVENANCE).items()}
    [curve] = curves_of([sweep], PROVENANCE)
    for there, said in (({}, False), (windows, True)):  # two widths: a fit that is refused, with its reason
        section = page._fits(drawn, Numbers({}, there, [fit_curve(curve, there)], None, []))
        assert ("No fit: 2 distinct trunk parameters" in section) == bool(section) == said


def test_the_error_of_one_seed_is_not_said_to_be_over_seeds(drawn):
    sweep = plan_width(STUDY)
    rows = rows_of(drawn, [sweep])
    for own, said in ((rows, "seeds and episodes"), ([r for r in rows if r.seed == 0], "episodes of one seed")):
        cards = page._headline(drawn, record_of(), [sweep], own, {}, page._ShownTrials(sweep, "reference"), "")
        assert f"s.e. over {said}<" in cards


@pytest.mark.parametrize("base", ["", "width 16"])
def test_a_control_beside_one_of_several_curves_is_no_curve(drawn, base, tmp_path):
    """Drawing such an axis of one's own ended with a KeyError, after all its trials had run."""
    width = plan_width(STUDY)
    several = replace(
        width, base=base, points=tuple(replace(p, series=f"width {p.trial.model.width}") for p in width.points)
    )
    rows = [replace(r, series=f"width {r.x}") for r in rows_of(drawn, [width])]
    assert any(r.role == CONTROL for r in rows)
    plots.plot_sweep(rows, several, tmp_path / "width.png")
    optima = find_optima(rows, [several])
    assert {o.role for o in optima} == ({POINT} if base else set())
    assert "width 16" in describe(several, rows, AxisStatistics(optima=optima))


@pytest.mark.parametrize("status", ["finished", "diverged"])
def test_a_cross_of_a_curve_is_explained_where_there_is_one(status, drawn):
    width = plan_width(STUDY)
    several = replace(width, points=tuple(replace(p, series="one") for p in width.points))
    rows = [replace(r, series="one", status=status if r.x == 8 else r.status) for r in rows_of(drawn, [width])]
    assert any(r.x == 8 for r in rows)
    caption = plot_family(rows, several).get_supxlabel()
    assert ("cross: a seed diverged, the point is left out" in caption) == (status == "diverged")


def test_variants_that_each_seed_judges_on_robots_of_its_own_are_said_to_be():
    for plan, own in ((plan_newcomers, True), (plan_conditioning, False)):
        sweep = plan(CPU_FULL)
        caption = plot_names([], sweep).get_supxlabel()
        said = describe(sweep, [])
        assert ("each seed judged on robots of its own" in caption) == ("evaluates robots of its own" in said) == own
        assert ("all judged on the same windows" in caption) != own
        assert ("one seed and its robots: do not compare it with the means" in caption) == own


def test_the_default_may_be_written_as_a_float():
    sweep = replace(plan_conditioning(CPU_FULL), reference_x=1.0)
    names = plot_names([], sweep).axes[0].get_yticklabels()
    assert [name.get_fontweight() == "bold" for name in names] == [i == 1 for i in range(len(names))]


def test_robots_that_are_others_for_every_seed_are_shown_of_the_seed_that_judges_them():
    """Of `newcomers` alone no page could be drawn: two seeds' windows do not fit together."""
    sweep = plan_newcomers(replace(CPU_FULL, seeds=(0, 1)))
    points = [p for p in sweep.points if p.role == POINT]
    assert len({p.scope for p in points}) == 2
    windows = {trial_id(p.trial, PROVENANCE): windows_of(p.trial) for p in points}
    robots = robots_of([], sweep, PROVENANCE, windows)
    assert {r.name for r in robots} == set(sweep.scope) == set(points[0].scope)
    assert all(line.seeds == 1 for r in robots for line in r.follows.values()) and not any(
        np.isnan(r.ahead) for r in robots
    )


def test_robots_of_one_seed_are_not_averaged_with_those_of_others(drawn, tmp_path):
    """A robot that two seeds judge was shown over both, and the line of all robots over all that any seed judges."""
    sweep, names = plan_width(STUDY), STUDY.dataset_names()
    sweep = replace(sweep, points=tuple(replace(p, scope=names[p.trial.train.seed :]) for p in sweep.points))
    rows = rows_of(drawn, [sweep])
    lines = describe_robots(rows, sweep, robots_of(rows, sweep, PROVENANCE, {}), tmp_path / "data.json")
    assert "Each seed judges robots of its own: these are those of seed 0." in lines
    at = [r for r in rows if (r.x, r.role, r.metric) == (sweep.reference_x, POINT, "perplexity")]
    for scope, shown in ((names[1], names[1]), (OVERALL, "<b>all</b>")):
        first, _ = sorted((r for r in at if r.scope == scope), key=lambda r: r.seed)
        line = lines[lines.index(f">{shown}<") :]
        assert f">{pm(first.mean, first.sem)}<" in line[: line.index("</tr>")]


@pytest.mark.parametrize("axes", [("settings", "width"), ("conditioning", "horizon"), ("newcomers", "horizon")])
def test_the_page_shows_the_reference_in_whichever_order_axes_come(axes):
    """The ablations of cpu-full have a default of their own, for fewer steps; where all robots are poor, so has
    that."""
    for order in (axes, axes[::-1]):
        shown = page._choose_shown(plan_sweeps(CPU_FULL, order), CPU_FULL)
        assert (shown.sweep.name, shown.name) == (axes[1], "reference")
    shown = page._choose_shown(plan_sweeps(CPU_FULL, axes[:1]), CPU_FULL)
    assert shown.name == f"default of {axes[0]}"
    assert page._choose_shown(plan_sweeps(CPU_FULL, ("lr",)), CPU_FULL) is None


def test_what_is_not_the_reference_is_not_called_so(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.report.draw.draw_figures", lambda *_: None)
    study = replace(STUDY, designs=replace(STUDY.designs, ablation_steps=1))
    workspace = finished_study(tmp_path, study, axes=("settings",))
    draw(workspace, record_of(study, ("settings",)))
    text = workspace.report.read_text().split("<details><summary>Configuration")[0]
    for name in ("perplexity, {}", "ΔPSNR, {}", "What it predicts ({})", "first ({})", "robots the {} is ahead"):
        assert name.format("default of settings") in text, name
    assert ", reference" not in text and "perplexity, untrained" not in text


@pytest.mark.parametrize(
    ("typed", "shown"),
    [
        ("hma study --preset cpu --replace study --accept-code --set 'axes=[\"lr\"]'", "hma study --preset cpu --set 'axes=[\"lr\"]'"),
        ("hma sweep lr --retry-failed --replace=windows --out 'a b'", "hma sweep lr --out 'a b'"),
    ],
)  # fmt: skip
def test_a_command_to_repeat_replaces_nothing(typed, shown):
    assert page._repeatable(typed) == shown


def test_what_is_not_found_any_more_does_not_stay_beside_new_results(tmp_path):
    workspace = finished_study(tmp_path, axes=("trajectories",), broken={"": "failed"})
    workspace.figures.mkdir()
    (tmp_path / "axes").mkdir()
    (tmp_path / "axes" / "own.py").touch()
    tables = [workspace.changes, workspace.best_steps, workspace.growth, workspace.optima, workspace.controllability]
    old = [*tables, *(workspace.figures / f"{name}.png" for name in ("lr", "own"))]
    for path in (*old, workspace.figures / "of_mine.png"):
        path.touch()
    draw(workspace, record_of(axes=("trajectories",)))
    assert not [path.name for path in old if path.exists()]
    assert {path.name for path in workspace.figures.iterdir()} == {"trajectories.png", "scaling.png", "of_mine.png"}


def test_a_point_without_one_of_the_metrics_has_a_dash(drawn):
    sweep = plan_width(STUDY)
    lost = {(8, "delta_psnr"), (16, "perplexity")}
    rows = [r for r in rows_of(drawn, [sweep]) if (r.x, r.metric) not in lost]
    lines = re.findall(
        r"<tr><th scope=row class=text>(\d+)</th>(.*?)<td>([\d,]+)</td></tr>",
        describe(sweep, rows),
    )
    assert [(x, cells.count("–"), parameters) for x, cells, parameters in lines] == [
        ("8", 1, "6,400"),
        ("16", 1, "25,600"),
    ]


def test_numbers_of_parameters_stand_below_a_table_in_which_they_are_one_number(drawn):
    """They stood before the results, in every line."""
    rows = rows_of(drawn, [plan_datasets(STUDY)])
    said = describe(plan_datasets(STUDY), rows)
    (number,) = {f"{r.parameters:,}" for r in rows if r.parameters}
    assert f"</table></div><p>All have {number} parameters, all robots together.</p>" in said
    assert said.count(number) == 1 and "parameters, all robots</th>" not in said


def test_one_held_out_episode_per_robot_has_no_interval_on_the_page():
    (sweep,) = plan_sweeps(WIDE, ("width",))
    alone = {}
    for id, trial in unique_trials([sweep], PROVENANCE).items():
        windows = windows_of(trial)
        alone[id] = replace(windows, episode=np.zeros_like(windows.episode), start=np.arange(len(windows)))
    said = describe(sweep, [], AxisStatistics(changes=find_changes([sweep], PROVENANCE, alone)))
    assert "nats per token \u22120." in said and "One held-out episode per robot gives no interval." in said
    assert "nan" not in said


def test_the_table_of_finished_trials_is_folded_and_what_lacks_a_result_is_not(drawn):
    """Of the largest study a fifth of the page was lines that all said "finished"."""
    page = drawn.report.read_text()
    trials = page[page.index("<h2>Trials</h2>") : page.index("<h2>How to repeat it</h2>")]
    unfolded, folded = trials.split("<details><summary>Finished trials</summary>")
    assert unfolded.count("<tr>") == 2 and 'class="diverged"' in unfolded and "10 of 11 finished." in unfolded
    assert folded.count("<tr>") == 1 + 10 and "<th scope=col>parameters</th>" in folded


def test_page_without_any_finished_trial(unrendered, tmp_path):
    workspace = finished_study(tmp_path, broken={"": "failed"})
    draw(workspace, record_of())
    page = workspace.report.read_text()
    assert "0 of 11 finished" in page and "Finished trials" not in page


def test_unreadable_result_names_its_file(tmp_path):
    workspace = finished_study(tmp_path)
    broken = next(workspace.trials.glob("*/result.json"))
    broken.write_text("{")
    with pytest.raises(ConfigError, match=str(broken)):
        draw(workspace, record_of())
