"""`hma fit`: scaling fits of a study, and predictions from them that are written down before they are tested."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.markup import escape
from rich.table import Table
from tyro.conf import Positional, UseAppendAction, arg

from experiments.running.attempts import read_states
from experiments.running.ledger import MISSING, Ledger
from experiments.running.provenance import Provenance
from experiments.running.workspace import Workspace, command_at, load_record
from experiments.study_setup import UNSET
from experiments.terminal.progress import console, say, short, wrote
from experiments.user_input.override import override
from hma_jax.config import ConfigError, require

if TYPE_CHECKING:
    from experiments.analysis.measured import Position
    from experiments.analysis.scaling import Curve, CurveFit
    from experiments.sweeps.sweep import Sweep


def fit(
    study: Annotated[Positional[Path], arg(metavar="STUDY")],
    predict: Annotated[str | None, arg(metavar="AXIS=X"), UNSET] = None,
    out: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: STUDY/predictions/AXIS-X.json)")
    ] = None,
    settings: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="PATH=VALUE")] = (),
) -> None:
    """Fit power laws to the scaling curves of a study, or predict a trial of it that has not run.

    docs/fits.md describes what is fitted, and when a fit is refused. (Whether a model fits on a device: `hma plan`.)

    Args:
        study: Directory of a study that has run.
        predict: Predict the trials of all seeds at this position of an axis, such as width=96; if an axis has several
            curves, write AXIS-SERIES=X, such as 'episodes-4,000 steps=160'. These trials must not have run.
        out: File for the prediction. Commit it before you run the trials, so that the commits prove the order.
        settings: Change one setting of the study's plan, so that it contains the trials to predict, such as
            widths=16,32,64,96.
    """
    if predict is None:
        require(out is None, "--out is the file for a prediction; give --predict AXIS=X, too")
        _show(study)
    else:
        _predict(study, predict, out, settings)


def _show(root: Path) -> None:
    from experiments.report.numbers import read_numbers

    numbers = read_numbers(Workspace(root.absolute()))
    if not numbers.fits and numbers.isoflop is None:
        say(
            f"{short(root)} has no axis along which the loss may follow a power law, such as width, so there is "
            "nothing to fit"
        )
        return
    table = Table(box=None, header_style="bold")
    for name in ("curve", "over", "L, nats per token", "exponents and E", "remarks"):
        table.add_column(name, overflow="fold")
    for fitted in numbers.fits:
        table.add_row(*map(escape, (fitted.curve.name, ", ".join(fitted.curve.axes), *_words(fitted))))
    if numbers.isoflop is not None:
        laws = {"": numbers.isoflop.exponent, "by three sizes ": numbers.isoflop.near}
        exponent = ", ".join(
            f"{form}N_opt ~ C^{a.value:.3f} [{a.low:.3f}, {a.high:.3f}]" for form, a in laws.items() if a
        )
        doubts = [*numbers.isoflop.doubts]
        doubts += [f"{b.flops:.3g} FLOPs: {b.remarks}" for b in numbers.isoflop.budgets if b.best and b.remarks]
        table.add_row("isoflop", "training FLOPs", "", exponent, numbers.isoflop.refused or "; ".join(doubts))
    console.print(table)
    planned = {position.trial for fitted in numbers.fits for position in fitted.curve.positions}
    if left := planned - numbers.results.keys():
        say(
            f"{len(left)} of the {len(planned)} trials of these curves have no result; to run them: "
            f"`{command_at(root, load_record(Workspace(root.absolute())))}`"
        )


def _words(fitted: CurveFit) -> tuple[str, str, str]:
    from experiments.report.fits import with_constant

    fit = fitted.fit
    if fit.refused:
        return "no fit", "", fit.refused
    exponents = [c for c in fit.coefficients if c.name in ("alpha", "beta")]
    intervals = ", ".join(f"{c.name} {c.value:.3g} [{c.low:.3g}, {c.high:.3g}]" for c in exponents)
    formula, *constant = with_constant(fitted)
    return formula, f"{intervals}, E {' '.join(constant)}".rstrip(), "; ".join(fit.doubts)


def _predict(root: Path, target: str, out: Path | None, settings: tuple[str, ...]) -> None:
    from experiments.analysis.predictions import predict, save_prediction
    from experiments.report.numbers import read_results, result_hashes
    from experiments.sweeps.registry import is_file, plan_sweeps
    from experiments.sweeps.sweep import unique_trials

    workspace = Workspace(root.absolute())
    record = load_record(workspace)
    name, _, text = target.rpartition("=")
    try:
        x = float(text)
    except ValueError:
        raise ConfigError(f"--predict {target}: write it as AXIS=X, such as width=96") from None
    study = override(record.study, settings) if settings else record.study
    sweeps, axis = plan_sweeps(study, record.axes, workspace.root), name.partition("-")[0]
    if axis not in {s.name for s in sweeps}:
        sweeps = plan_sweeps(study, (*record.axes, axis), workspace.root)
    sweep = next((s for s in sweeps if s.name == axis), None)
    if sweep is None or not sweep.fittable:
        raise ConfigError(f"--predict {target}: {axis} is not an axis with numbers as positions")
    own = next((a for a, s in zip(record.axes, sweeps, strict=False) if s is sweep and is_file(a)), None)
    how = f"in {short(workspace.root / own)}" if own else "with --set"
    curve, held = _held_out(sweep, record.provenance, target, x, how)
    ids = [position.trial for position in held]
    ledger = Ledger(workspace.ledger)
    ran = ledger.states()
    for id, state in read_states(sorted(ids), workspace.trials, ledger).items():
        exists = state.event != MISSING
        what = f"exists already ({state.event})" if exists else f"has run, says {workspace.ledger.name}"
        require(
            not exists and id not in ran,
            f"--predict {target}: trial {id} {what}; a prediction must be made before its trial runs",
        )
    results, windows = read_results(workspace, unique_trials(sweeps, record.provenance))
    prediction = predict(curve, held, windows, result_hashes(results))
    path = out or workspace.predictions / f"{curve.name}-{text}.json".replace("/", "_")
    save_prediction(path, prediction)
    say(
        f"{curve.name} at {prediction.position}: {prediction.mean:.4f} nats per token, "
        f"{prediction.low:.4f} to {prediction.high:.4f} with {prediction.level:.0%}"
    )
    wrote(path, then=f"git add -f {shlex.quote(short(path))} && git commit", about="run the trials only then")


def _held_out(sweep: Sweep, provenance: Provenance, target: str, x: float, how: str) -> tuple[Curve, list[Position]]:
    """The curve of `sweep` that AXIS=X or AXIS-SERIES=X asks for, and its trials at `x`. `how`: how to add such trials,
    for the error message. Raises ConfigError if there are none, if no power law is expected along the axis, and if it
    is not clear which of several curves is meant."""
    from experiments.analysis.scaling import curves_of
    from experiments.running.trial import trial_id
    from experiments.sweeps.sweep import POINT

    name, _, text = target.rpartition("=")
    require(
        not sweep.interior_minimum,
        f"--predict {target}: along {sweep.name} the loss has a minimum inside the range, so it is not a power law; "
        "`hma fit STUDY` says which size is best for a budget (isoflop)",
    )
    curves = {curve.name: curve for curve in curves_of([sweep], provenance)}
    if name == sweep.name and len(curves) == 1:
        (name,) = curves
    known = ", ".join(shlex.quote(f"{one}={text}") for one in curves)
    require(name in curves, f"--predict {target}: which curve of {sweep.name}? Write one of {known}")
    series = name.removeprefix(sweep.name).removeprefix("-")
    points = [p for p in sweep.points if p.role == POINT and p.series == series]
    ids = {trial_id(p.trial, provenance) for p in points if p.x == x}
    positions = ", ".join(f"{v:g}" for v in sorted({p.x for p in points}))
    require(
        bool(ids),
        f"--predict {target}: the study plans no trial there (its positions: {positions}); add it to the plan {how}",
    )
    return curves[name], [position for position in curves[name].positions if position.trial in ids]
