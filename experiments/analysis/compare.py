"""Two models, or two studies' reference models over their seeds, compared on the windows that both were evaluated on.

Differences are paired window by window. With one seed on either side the error is clustered by episode (`intervals`),
with several it is over seeds and episodes (`bootstrap`), with seeds of the same name paired.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.analysis.bootstrap import Panel, bootstrap_intervals, make_panel
from experiments.analysis.intervals import NATS, OVERALL, UNKNOWN, Interval, interval_of, nats_first, overall
from experiments.analysis.paired import NoNumbers, NotComparable, require_same_windows
from hma_jax.evaluation.measures import OF_TOKENS, OF_WINDOWS, OPTIONAL_METRICS
from hma_jax.evaluation.statistics import mean_and_sem
from hma_jax.evaluation.windows import WindowTable


@dataclass(frozen=True)
class Side:
    """One side of a comparison: {seed: every window's numbers}, and the tokens on which it was judged."""

    name: str
    seeds: Mapping[int, WindowTable]
    tokenizer: str  # "": unknown
    says_seed: bool = True  # False: its seed is unknown, and the key of `seeds` stands in
    of_study: bool = False  # whether `seeds` are the finished ones of a study's reference
    step: int = 0  # step of its training at which it was evaluated; 0: unknown
    steps: int = 0  # planned number of training steps; 0: unknown
    noising_steps: int = 0  # steps of the noising process of a model on latents; 0: on ids, or unknown


@dataclass(frozen=True, kw_only=True)
class Difference:
    """a - b for one metric, over one robot or all, with its interval; for nats also the ratio of perplexities."""

    scope: str  # a robot, or OVERALL
    metric: str
    a: float
    b: float
    mean: float
    sem: float
    low: float
    high: float
    errors: float  # distance from zero in standard errors
    seeds: int
    n: int
    episodes: int
    ratio: float = float("nan")  # exp(mean): the perplexity of a over that of b
    ratio_low: float = float("nan")
    ratio_high: float = float("nan")

    @property
    def interval(self) -> Interval:
        return Interval(self.mean, self.sem, self.low, self.high, self.n, self.episodes)


def compare(a: Side, b: Side) -> list[Difference]:
    """Every metric, nats first, overall and by robot, for the robots on which both were judged.

    Metrics of tokens are left out where they measure different things (`of_other_tokens`). Retrieval is left out if the
    two sides ranked the true actions among different numbers of others. Raises NotComparable, naming the first window
    that differs, or the metrics of both if none of them can be compared, and NoNumbers, naming the first window that
    lacks a number which every sound model has.
    """
    pairs = _pairs(a, b)
    first = pairs[0][0]
    robots = require_same_windows(first, pairs[0][1])
    shared = [m for m in first.metrics if all(m in table.metrics for pair in pairs for table in pair)]
    other_tokens = of_other_tokens(a, b)
    foreign = set(OF_TOKENS if other_tokens else ())
    if not all(_same_chance(*pair, robots) for pair in pairs):
        foreign |= {m for m in shared if m.startswith("retrieval")}
    found = []
    for metric in nats_first(m for m in shared if m not in (*foreign, *OF_WINDOWS)):
        found += _of_metric(metric, *_panels((a, b), pairs, metric, robots))
    if not found:
        of_a, of_b = (", ".join(m for m in table.metrics if m not in OF_WINDOWS) or "none" for table in pairs[0])
        losses = "losses" if a.noising_steps and b.noising_steps else "nats"
        why = f"; {losses} are not compared, since {other_tokens}" if other_tokens else ""
        raise NotComparable(f"no metric can be compared: {a.name} has {of_a}, {b.name} has {of_b}{why}")
    return found


def of_other_tokens(a: Side, b: Side) -> str:
    """Why metrics of tokens are not comparable, as far as the sides say what they were judged on; "" if they are.

    The diffusion loss sums a bound over the steps of a model's own noising process: fewer steps have larger terms.
    """
    if a.tokenizer and b.tokenizer and a.tokenizer != b.tokenizer:
        return f"the tokenizers differ ({a.tokenizer}, {b.tokenizer})"
    if a.noising_steps and b.noising_steps and a.noising_steps != b.noising_steps:
        return f"the noising processes have other numbers of steps ({a.noising_steps}, {b.noising_steps})"
    return ""


def _same_chance(a: WindowTable, b: WindowTable, robots: Sequence[str]) -> bool:
    """Whether retrieval ranks the true actions among the same number of others on both sides, in every window of
    `robots`."""
    if not all("retrieval_chance" in table.metrics for table in (a, b)):
        return True
    of_a, of_b = make_panel([{0: a}, {0: b}], "retrieval_chance", robots).points
    return np.array_equal(of_a, of_b, equal_nan=True)


def other_sequences(side: Side, robots: Sequence[str]) -> list[int]:
    """The numbers of action sequences from other episodes under which windows of `robots` were evaluated; [] if
    unknown."""
    tables = [table.among(robots).metrics for table in side.seeds.values()]
    chances = [metrics["retrieval_chance"] for metrics in tables if "retrieval_chance" in metrics]
    found = np.unique(np.concatenate([np.zeros(0), *chances]))
    return sorted({round(1 / chance) - 1 for chance in found[~np.isnan(found)].tolist()})


def overall_difference(a: Side, b: Side, metric: str, robots: Sequence[str]) -> Difference | None:
    """The difference of one metric, averaged over `robots`; None if no window of either model has it. Raises
    NotComparable, and NoNumbers if only one model's windows have it, or if neither has a metric that every sound model
    has."""
    pairs = _pairs(a, b)
    if not all(metric in table.metrics for pair in pairs for table in pair):
        return None
    of_a, of_b = _panels((a, b), pairs, metric, robots)
    known = of_a.known & of_b.known
    return _difference(OVERALL, metric, of_a.rows(known), of_b.rows(known)) if known.any() else None


def _pairs(a: Side, b: Side) -> list[tuple[WindowTable, WindowTable]]:
    """The pairs of tables that are compared: one for each seed that both sides have. Two models with one seed each are
    paired whatever their seeds are, unless both come from studies."""
    if len(a.seeds) == len(b.seeds) == 1 and not (a.of_study and b.of_study):
        return [(*a.seeds.values(), *b.seeds.values())]
    shared = [seed for seed in a.seeds if seed in b.seeds]
    if not shared:
        raise NotComparable(
            f"{a.name} has seeds {', '.join(map(str, a.seeds))} and {b.name} {', '.join(map(str, b.seeds))}: none in "
            "common"
        )
    return [(a.seeds[seed], b.seeds[seed]) for seed in shared]


def _panels(
    sides: Sequence[Side], pairs: Sequence[tuple[WindowTable, WindowTable]], metric: str, robots: Sequence[str]
) -> list[Panel]:
    """One panel for each side, with the same windows in the same order. Raises NoNumbers."""
    both = make_panel([dict(enumerate(side)) for side in zip(*pairs, strict=True)], metric, robots)
    lacking = lacks_numbers(metric, np.concatenate(both.points))  # [seeds of both, n]
    if lacking.any():
        model, window = np.argwhere(lacking)[0]
        robot, episode, start = pairs[0][0].among(robots).names[window]
        raise NoNumbers(
            f"{sides[model // len(pairs)].name} has no {metric} of window ({robot}, episode {episode}, frame {start}) (and "
            f"{lacking[model].sum() - 1} others): what it predicts there is no number. Compare another model, or train "
            "this one again"
        )
    return [
        Panel(both.robot, both.episode, (values,), (seeds,))
        for values, seeds in zip(both.points, both.seeds, strict=True)
    ]


def lacks_numbers(metric: str, values: np.ndarray) -> np.ndarray:
    """bool [models, n] for `values` [models, n] on the same windows: where a model lacks a number that every sound
    model has or, for OPTIONAL_METRICS, that another of these models has. Leaving such windows out would favour the
    model that failed there."""
    none = np.isnan(values)
    return none & ~none.all(0) if metric in OPTIONAL_METRICS else none


def _of_metric(metric: str, a: Panel, b: Panel) -> list[Difference]:
    """The difference overall, if there are several robots, and for each robot, over the windows that have the
    metric."""
    known = a.known & b.known
    rows = [(robot, known & (a.robot == robot)) for robot in dict.fromkeys(a.robot[known].tolist())]
    if len(rows) > 1:
        rows.insert(0, (OVERALL, known))
    return [_difference(scope, metric, a.rows(index), b.rows(index)) for scope, index in rows]


def _difference(scope: str, metric: str, a: Panel, b: Panel) -> Difference:
    interval = _interval(a.minus(b))
    robots = dict.fromkeys(a.robot.tolist())
    of_a, of_b = (float(np.mean([p.points[0][:, p.robot == robot].mean() for robot in robots])) for p in (a, b))
    ratio = interval.exp() if metric in NATS[:1] else UNKNOWN
    return Difference(
        scope=scope, metric=metric, a=of_a, b=of_b, errors=interval.errors, seeds=len(a.seeds[0]), **vars(interval),
        ratio=ratio.mean, ratio_low=ratio.low, ratio_high=ratio.high,
    )  # fmt: skip


def _interval(panel: Panel) -> Interval:
    """The interval of one point's mean; in closed form if there is one seed."""
    if len(panel.seeds[0]) > 1:
        return bootstrap_intervals(panel)[0]
    values = panel.points[0][0]
    stats = [
        mean_and_sem(values[panel.robot == robot], panel.episode[panel.robot == robot])
        for robot in dict.fromkeys(panel.robot.tolist())
    ]
    return overall(stats) if len(stats) > 1 else interval_of(stats[0])
