"""Predictions of a fit for trials that have not run, sealed before they do, and their outcomes.

A prediction is a small JSON file, sealed with a hash of itself: the fit, the hash of every result it was made from,
which trials were finished then, and the loss that the trials of one position will have on the frozen windows, with an
interval. The interval includes the bootstraps of the fit over seeds and the noise of the new trials' own seeds; not the
noise of episodes, since the windows are the same, and not the uncertainty of the form, which the prediction tests. Its
date is that of the commit that brings it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.analysis.fits import FIT_LEVEL, interval
from experiments.analysis.intervals import HELD_OUT_LOSS
from experiments.analysis.measured import NoLevel, Position, measure
from experiments.analysis.scaling import Curve, fit_curve, noise_near
from hma_jax.config import ConfigError, require
from hma_jax.config.json import from_dict, stable_hash, to_dict
from hma_jax.evaluation.windows import WindowTable
from hma_jax.runtime.files import write_file


@dataclass(frozen=True)
class Prediction:
    """A prediction of the mean loss, in nats per token, of `trials` at `x`."""

    curve: str
    axes: tuple[str, ...]
    x: tuple[float, ...]
    trials: tuple[str, ...]
    mean: float
    low: float
    high: float
    level: float
    formula: str
    coefficients: dict[str, tuple[float, float, float]]  # value and interval
    inputs: dict[str, str]  # {trial id: hash of its result} for the trials of the fit
    finished: tuple[str, ...]  # every trial of the study that had a result when this was written

    @property
    def position(self) -> str:
        """In words: '132,480 trunk parameters'."""
        return ", ".join(f"{x:,.12g} {axis}" for x, axis in zip(self.x, self.axes, strict=True))


@dataclass(frozen=True)
class Outcome:
    """A prediction and its outcome; `marks` say why it may count for less."""

    prediction: Prediction
    observed: float | None  # None: none of its trials is finished, or it is unknown how hard their robots are
    seeds: int
    marks: tuple[str, ...]

    @property
    def inside(self) -> bool | None:
        """Whether the outcome is inside the interval; None before all its trials are finished, since the interval is
        for their mean."""
        if self.observed is None or self.seeds < len(self.prediction.trials):
            return None
        return self.prediction.low <= self.observed <= self.prediction.high


def predict(
    curve: Curve,
    held_out: Sequence[Position],
    windows: Mapping[str, WindowTable],
    hashes: Mapping[str, str],
) -> Prediction:
    """Predicts the loss of the `held_out` trials at one position from the other finished trials of the curve.

    `windows` are those of all finished trials of the study, `hashes` those of their results. Raises ConfigError if one
    of the held-out trials is finished already, or if the others identify no power law.
    """
    ids = tuple(p.trial for p in held_out)
    finished = [id for id in ids if id in windows]
    require(
        not finished, f"{', '.join(finished)} already has a result: a prediction must be made before its trial runs"
    )
    others = Curve(curve.name, curve.axes, tuple(p for p in curve.positions if p.trial not in ids))
    fitted = fit_curve(others, windows, episodes=False)
    fit = fitted.fit
    require(not fit.refused, f"{curve.name}: no prediction is possible: {fit.refused}")
    x = np.array([held_out[0].x])
    noise, freedom = noise_near(fitted.measured, x[0])
    require(
        np.isfinite(noise),
        f"{curve.name}: every point has one seed, but the interval of a prediction needs the noise between seeds; run "
        "the trials that it is made from with several seeds (--set seeds=0,1,2)",
    )
    luck = np.random.default_rng(1).standard_t(freedom, len(fit.thetas)) / np.sqrt(len(ids))
    spread = np.exp(noise * luck)
    low, high = interval(fit.all_at(x)[:, 0] * spread)
    return Prediction(
        curve.name, curve.axes, tuple(map(float, x[0])), ids, float(fit.at(x)[0]), float(low), float(high), FIT_LEVEL,
        fit.formula(), {c.name: (c.value, c.low, c.high) for c in fit.coefficients},
        {id: hashes[id] for id in fit.trials}, tuple(sorted(windows)),
    )  # fmt: skip


def compare(
    prediction: Prediction, curves: Sequence[Curve], windows: Mapping[str, WindowTable], hashes: Mapping[str, str]
) -> Outcome:
    """The outcome of a prediction, measured together with the trials from which it was made. If seeds have their own
    robots, its level is then that of the prediction, not that of the seeds that happen to have finished."""
    curve = next((c for c in curves if c.name == prediction.curve), None)
    there = curve.finished(windows) if curve else ()
    finished = [p for p in there if p.trial in prediction.trials]
    marks = []
    if early := [id for id in prediction.trials if id in prediction.finished or id in prediction.inputs]:
        marks.append(f"made after {', '.join(early)} had run: no prediction")
    if changed := [id for id, hash in prediction.inputs.items() if hashes.get(id) != hash]:
        marks.append(f"{len(changed)} of the {len(prediction.inputs)} results it was made from changed or are missing")
    if curve is None or not set(prediction.trials) <= {p.trial for p in curve.positions}:
        marks.append("the study does not plan its trials")
    observed = None
    if curve and finished:
        beside = [p for p in there if p.trial in prediction.inputs and p not in finished]
        try:
            values = measure(curve.axes, [*finished, *beside], windows, HELD_OUT_LOSS).value
            observed = float(values[: len(finished)].mean())
        except NoLevel as error:
            marks.append(str(error))
    return Outcome(prediction, observed, len(finished), tuple(marks))


def save_prediction(path: Path, prediction: Prediction) -> None:
    """Raises ConfigError if the file exists: a prediction is never overwritten."""
    require(not path.exists(), f"{path} is an earlier prediction, which is not overwritten. Give another --out")
    path.parent.mkdir(parents=True, exist_ok=True)
    values = to_dict(prediction)
    write_file(path, json.dumps({"hash": stable_hash(values), **values}, indent=1) + "\n")


def load_predictions(folder: Path) -> dict[str, Prediction]:
    """Predictions by file name; of copies only the first, or their outcome would count twice. Raises ConfigError for
    one that was edited or cannot be read."""
    found: dict[str, Prediction] = {}
    for path in sorted(folder.glob("*.json")):
        if (prediction := _load(path)) not in found.values():
            found[path.name] = prediction
    return found


def _load(path: Path) -> Prediction:
    try:
        values: dict[str, Any] = json.loads(path.read_text())
        seal = values.pop("hash")
        prediction = from_dict(Prediction, values)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:  # ConfigError is a ValueError
        raise ConfigError(f"{path}: the prediction cannot be read ({error}); restore the file, or remove it") from error
    require(seal == stable_hash(values), f"{path} was changed after it was written; restore the file, or remove it")
    return prediction
