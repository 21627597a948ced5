"""The author's expectations of a study's axes, with their outcomes, and the author's findings.

The first is predictions/preregistered.csv (`experiments.analysis.preregistered`). The second is findings.md beside the
page, a section per axis, shown with its curves:

    ## `width`

    Everything improves with width ...

A section whose heading names several axes in backticks is shown with the last of them; sections that name none, and
text before all sections, come at the end. No other line may begin with `## `.
"""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.analysis.changes import CHANGED
from experiments.analysis.preregistered import ExpectationOutcome, count_inside
from experiments.report.fits import VERDICTS
from experiments.report.pieces import pm, section, table
from experiments.sweeps.sweep import Sweep
from hma_jax.config import ConfigError
from hma_jax.evaluation.measures import METRICS


@dataclass(frozen=True)
class Findings:
    of_axes: dict[str, str]  # HTML, by the axis with which it is shown
    rest: str = ""


def read_findings(path: Path, axes: Sequence[str]) -> Findings:
    """The findings of a study with these axes, in their order on the page; empty without a file. Raises ConfigError
    for a file that is not UTF-8."""
    if not path.exists():
        return Findings({})
    of_axes: dict[str, str] = {}
    rest = []
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not UTF-8 ({error}); save it in this encoding") from error
    before, *parts = re.split(r"^## ", text, flags=re.MULTILINE)
    if before := re.sub(r"\A\s*# .*", "", before).strip():
        rest.append(section("Findings", f"<div class=findings>{_as_html(before)}</div>"))
    for part in parts:
        title, _, text = part.partition("\n")
        anchor = re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")  # as in rendered Markdown pages
        content = f'<div class=findings id="{anchor}">{_as_html(text)}</div>'
        named = [axis for axis in axes if f"`{axis}`" in title]
        if named:
            of_axes[named[-1]] = of_axes.get(named[-1], "") + content
        else:
            rest.append(section(title.replace("`", ""), content))
    return Findings(of_axes, "".join(rest))


def describe_expected(sweep: Sweep, outcomes: Sequence[ExpectationOutcome]) -> str:
    """A table of the preregistered numbers of an axis and their outcomes."""
    own = [c for c in outcomes if c.expected.sweep == sweep.name]
    if not own:
        return ""
    lines = []
    for c in own:
        e = c.expected
        where = f"{e.x} minus {e.against}" if e.against else e.x
        for what, seeds in (("seed {}", e.seeds), ("seed {} known before", e.known)):
            where += f", {what.format(', '.join(map(str, seeds)))}" if seeds else ""
        predicted = f"{e.mean:g} <span class=sem>[{e.low:g}, {e.high:g}]</span>".replace("-", "\u2212")
        observed = c.lacks if c.observed is None else pm(c.observed, c.seed_sem)
        curve = [html.escape(e.series)] if sweep.has_series else []
        metric, seeds = METRICS[e.metric].heading if e.metric in CHANGED else e.metric, f"{c.seeds} of {c.planned}"
        lines.append([*curve, html.escape(where), metric, predicted, observed, VERDICTS[c.inside], seeds])
    inside, ran = count_inside(own)
    outcome = f"{inside} of {ran} intervals contain the outcome." if ran else "None has an outcome yet."
    hold, known = count_inside([c for c in own if c.expected.known])
    less = f" Of {known} of them, {hold} of which hold, some seeds were known by then." * bool(known)
    commits = ", ".join(dict.fromkeys(f"<code>{html.escape(c.expected.commit)}</code>" for c in own))
    head = ["curve"] * sweep.has_series + [sweep.axis, "", "predicted", "observed", "", "seeds"]
    return (
        f"<h4>Preregistered</h4><p>{outcome} According "
        f"to the author they were written before the trials ran, in {commits}.{less} Errors are over seeds.</p>"
        f"<details><summary>Predicted and observed</summary>{table(head, lines, text=2 + sweep.has_series)}</details>"
    )


def _as_html(text: str) -> str:
    """Markdown, with tables, as HTML. Pictures are left out: they are the study's figures, which the page shows
    itself."""
    from markdown_it import MarkdownIt

    reader = MarkdownIt("commonmark", {"html": False}).enable("table")
    rules = {"image": "", "table_open": "<div class=scroll><table>", "table_close": "</table></div>"}
    for rule, written in rules.items():
        reader.add_render_rule(rule, lambda *_, written=written: written)
    return reader.render(text)
