"""`hma fit`: scaling fits of a study, and a prediction from them, written down before it is put to the test."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.table import Table
from tyro.conf import Positional, UseAppendAction, arg

from experiments.progress import console
from experiments.running.workspace import Workspace, load_record
from experiments.setting import short
from experiments.wrote import wrote
from hma_jax.config import ConfigError, require

if TYPE_CHECKING:
    from experiments.analysis.scaling import Fitted


def fit(
    study: Annotated[Positional[Path], arg(metavar="STUDY")],
    predict: Annotated[str | None, arg(metavar="AXIS=X")] = None,
    out: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: STUDY/predictions/AXIS-X.json)")
    ] = None,
    settings: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="PATH=VALUE")] = (),
) -> None:
    """Fit power laws to the scaling curves of a study, or predict a trial of it that has not run.

    What fits a device is `hma plan`. docs/fits.md says what is fitted, and when a fit is refused.

    Args:
        study: Directory of a study that has run.
        predict: The trials to predict, of every seed, by axis and position, such as width=96. They must not have run.
        out: File of the prediction. Commit it before the trials are run: the commits show the order.
        settings: Change one setting of the study for the plan, so that it has the trials to predict, such as
            widths=16,32,64,96.
    """
    if predict is None:
        require(out is None, "--out is the file of a prediction; give --predict AXIS=X, too")
        _show(study)
    else:
        _predict(study, predict, out, settings)


def _show(root: Path) -> None:
    from experiments.report.numbers import read_numbers

    numbers = read_numbers(Workspace(root.absolute()))
    table = Table(box=None, header_style="bold")
    for name in ("curve", "over", "L, nats per token", "exponents", "remarks"):
        table.add_column(name, overflow="fold")
    for fitted in numbers.fits:
        table.add_row(fitted.curve.name, ", ".join(fitted.curve.axes), *_words(fitted))
    if numbers.isoflop is not None:
        a = numbers.isoflop.exponent
        said = f"N_opt ~ C^{a.value:.3f}  [{a.low:.3f}, {a.high:.3f}]" if a else ""
        table.add_row("isoflop", "training FLOPs", said, "", numbers.isoflop.refused)
    console.print(table)


def _words(fitted: Fitted) -> tuple[str, str, str]:
    fit = fitted.fit
    if fit.refused:
        return "no fit", "", fit.refused
    exponents = [c for c in fit.coefficients if c.name in ("alpha", "beta")]
    intervals = ", ".join(f"{c.name} {c.value:.3g} [{c.low:.3g}, {c.high:.3g}]" for c in exponents)
    return fit.formula(), intervals, "; ".join(fit.doubts)


def _predict(root: Path, asked: str, out: Path | None, settings: tuple[str, ...]) -> None:
    from experiments.analysis.predictions import predict, save_prediction
    from experiments.analysis.scaling import curves_of
    from experiments.report.numbers import read_results, result_hashes
    from experiments.running.attempts import read_states
    from experiments.running.ledger import MISSING, Ledger
    from experiments.running.trial import trial_id
    from experiments.study import override
    from experiments.sweeps.registry import plan_sweeps
    from experiments.sweeps.sweep import POINT, unique_trials

    workspace = Workspace(root.absolute())
    record = load_record(workspace)
    require(record.provenance is not None, f"the study in {root} has not run yet; run `{record.command}`")
    name, separator, text = asked.partition("=")
    try:
        x = float(text)
    except ValueError:
        raise ConfigError(f"--predict {asked}: write it as AXIS=X, such as width=96") from None
    study = override(record.study, settings) if settings else record.study
    axes = record.axes if name in record.axes else (*record.axes, name)
    sweeps = plan_sweeps(study, axes, workspace.root)
    sweep = next((s for s in sweeps if s.name == name), None)
    if sweep is None or not sweep.measured:
        raise ConfigError(f"--predict {asked}: {name} is no axis over a number")
    held = [p for p in sweep.points if p.x == x and p.role == POINT]
    known = ", ".join(f"{v:g}" for v in sorted({p.x for p in sweep.points}))
    if not held:
        raise ConfigError(
            f"--predict {asked}: the study plans no trial there (its positions: {known}); add it to the plan with --set"
        )
    ids = {trial_id(p.trial, record.provenance) for p in held}
    states = read_states(sorted(ids), workspace.trials, Ledger(workspace.ledger))
    for id, state in states.items():
        require(
            state.event == MISSING,
            f"--predict {asked}: trial {id} exists already ({state.event}); a prediction is made before its trial runs",
        )
    trials = list(unique_trials(sweeps, record.provenance))
    results, windows = read_results(workspace, trials)
    curves = [c for c in curves_of(sweeps, record.provenance) if ids & {p.trial for p in c.places}]
    curve = next(c for c in curves if c.name.split("-")[0] == name)
    places = [p for p in curve.places if p.trial in ids]
    prediction = predict(curve, places, windows, result_hashes(results))
    path = out or workspace.predictions / f"{curve.name}-{text}.json"
    save_prediction(path, prediction)
    console.print(
        f"{curve.name} at {prediction.x[0]:,.0f} {curve.axes[0]}: {prediction.mean:.4f} nats per token, "
        f"{prediction.low:.4f} to {prediction.high:.4f} with {prediction.level:.0%}", soft_wrap=True, highlight=False,
    )  # fmt: skip
    wrote(path, then=f"git add {shlex.quote(short(path))} && git commit, and only then run the trials")
