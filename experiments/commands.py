"""What the commands of `hma` do. The command line itself is in `cli`; heavy imports happen here.

Every command ends by saying what it wrote and what to run next.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape

from experiments import (
    ablate_conditioning,
    ablate_settings,
    scale_datasets,
    scale_trajectories,
    scale_width,
    transfer_lr,
)
from experiments.atomic import write_atomically
from experiments.ledger import FINISHED, Ledger
from experiments.presets import get_preset
from experiments.program import PROGRAM
from experiments.progress import SweepMonitor, console, step, tidy_table
from experiments.runner import Job, State, read_states, run_missing
from experiments.study import Study, on_user_data, override
from experiments.sweep import reference_trial, titles, unique_trials
from experiments.workspace import Record, Workspace, load_record, merge_axes, save_record
from hma_jax.config import ConfigError, MeshConfig, to_dict

if TYPE_CHECKING:
    from experiments.trial import Materials
    from hma_jax.training.train import Run

AXES = {
    "datasets": scale_datasets.plan,
    "trajectories": scale_trajectories.plan,
    "width": scale_width.plan,
    "settings": ablate_settings.plan,
    "conditioning": ablate_conditioning.plan,
    "lr": transfer_lr.plan,
}
SCALING = ("datasets", "trajectories", "width")
"""What `hma study` runs."""


class TrialsFailed(Exception):
    """The sweep went on to its end, but some trials have no result."""


@dataclass(frozen=True)
class Setting:
    """A study, its data and where it lives: what every command works on."""

    study: Study
    data: tuple[str, ...]
    workspace: Workspace


def make_setting(preset: str, out: Path | None, data: Sequence[str], settings: Sequence[str]) -> Setting:
    """The preset, on the user's data if given, with overrides. Touches no file but `data`."""
    study = get_preset(preset)
    if data:
        from experiments.pipeline import name_datasets

        study = on_user_data(study, name_datasets(data))
    study = override(study, settings)
    directories = tuple(str(Path(d).absolute()) for d in data)
    return Setting(study, directories, Workspace((out or Path("runs") / study.name).absolute()))


def dry_run(study: Study, axes: Sequence[str]) -> None:
    from experiments.cost import plan_table

    console.print(plan_table(study, [AXES[axis](study) for axis in axes]))


def run_study(
    setting: Setting, axes: Sequence[str], *, workers: int, retry_failed: bool, mesh: MeshConfig
) -> None:
    """Prepares, runs what is missing, and draws the results. Raises TrialsFailed at the end."""
    from experiments.pipeline import prepare

    study, workspace = setting.study, setting.workspace
    if study.name == "paper" and not setting.data:
        raise ConfigError(
            "the paper's forty datasets are not simulated: give their RLDS directories with --data, or "
            "add --dry-run to see the plan"
        )
    sweeps = [AXES[axis](study) for axis in axes]
    with workspace.claimed():
        all_axes = merge_axes(workspace, study, axes)
        provenance = prepare(study, workspace, setting.data)
        record = Record(study, setting.data, all_axes, command_line(), provenance)
        save_record(workspace, record)
        trials = unique_trials(sweeps, provenance)
        common = {"provenance": to_dict(provenance), "mesh": to_dict(mesh)}
        # The widest take longest: first, so that no worker is left with one at the end.
        ordered = sorted(trials.items(), key=lambda item: -item[1].model.width)
        names = titles(sweeps, provenance)
        jobs = [Job(id, names[id], {"trial": to_dict(trial), **common}) for id, trial in ordered]
        states = run_jobs(jobs, workspace, workers, retry_failed)
        draw(workspace, record)
    complain(jobs, states)


def run_jobs(
    jobs: Sequence[Job], workspace: Workspace, workers: int, retry_failed: bool
) -> dict[str, State]:
    """Runs what is missing, visibly."""
    ledger = Ledger(workspace.ledger)
    before = read_states([job.id for job in jobs], workspace.trials, ledger)
    kept = sum(state.event == FINISHED for state in before.values())
    if kept:
        console.print(f"{kept} of {len(jobs)} trials are finished already")
    with SweepMonitor(len(jobs), kept) as monitor:
        return run_missing(
            jobs, workspace.trials, ledger, workers=workers, retry_failed=retry_failed, monitor=monitor
        )


def draw(workspace: Workspace, record: Record) -> None:
    """CSV, figures and page from whatever trials are finished."""
    from experiments.optima import Optimum, find_optima
    from experiments.plots import plot_overview, plot_sweep
    from experiments.report import write_report
    from experiments.rows import Row, collect, read_csv, write_csv

    provenance = record.provenance
    if provenance is None:
        raise ConfigError(f"the study in {workspace.root} has not run yet; run `hma study --out {workspace.root}`")
    sweeps = [AXES[axis](record.study) for axis in record.axes]
    states = read_states(list(unique_trials(sweeps, provenance)), workspace.trials, Ledger(workspace.ledger))
    write_csv(workspace.results, Row, collect(sweeps, provenance, workspace.trials, states))
    rows = read_csv(workspace.results)  # figures show what the file says
    workspace.figures.mkdir(exist_ok=True)
    for sweep in sweeps:
        plot_sweep(rows, sweep, workspace.figures / f"{sweep.name}.png")
    plot_overview(rows, [s for s in sweeps if s.scaling], workspace.figures / "scaling.png")
    tables = [workspace.results]
    optima = find_optima(rows, sweeps)
    if optima:
        write_csv(workspace.optima, Optimum, optima)
        tables.append(workspace.optima)
    write_report(workspace, record, sweeps, rows, optima, states, provenance)
    wrote(*tables, workspace.figures, workspace.report)


def complain(jobs: Sequence[Job], states: dict[str, State]) -> None:
    """Raises TrialsFailed, naming every trial without a result."""
    bad = [(job, states[job.id]) for job in jobs if states[job.id].event != FINISHED]
    if bad:
        lines = "\n".join(f"  {s.event}: {job.title}: {s.message}" for job, s in bad)
        raise TrialsFailed(
            f"{len(bad)} of {len(jobs)} trials have no result:\n{lines}\nAdd --retry-failed to try them again."
        )


def wrote(*paths: Path, then: str = "") -> None:
    for path in paths:
        console.print(f"wrote [bold]{escape(_short(path))}[/]", soft_wrap=True)
    if then:
        console.print(f"next: {escape(then)}", soft_wrap=True)


def command_line() -> str:
    """The command as typed, whichever way the program was started."""
    return shlex.join([PROGRAM, *sys.argv[1:]])


def _short(path: Path) -> str:
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)


# --- Single steps ----------------------------------------------------------------------------


def list_datasets() -> None:
    from data_pipelines.registry import all_specs

    table = tidy_table("Datasets that the registry knows", "name", "dims", "Hz", "stride")
    table.add_column("image", overflow="fold")
    table.add_column("what it is", min_width=30)
    for spec in all_specs():
        table.add_row(
            spec.name,
            f"{spec.action_dim}",
            f"{spec.hz:g}",
            f"{spec.stride}",
            spec.image_key.removeprefix("observation/"),
            spec.note,
        )
    console.print(table)
    console.print("A dataset of your own is one more entry in data_pipelines/registry.py.")


def write_suite(setting: Setting) -> None:
    from experiments.pipeline import make_suite

    with setting.workspace.claimed():
        make_suite(setting.study, setting.workspace)
    wrote(setting.workspace.suite, then=_next("tokenizer train", setting))


def train_tokenizer(setting: Setting) -> None:
    from experiments.pipeline import find_sources, make_suite, make_tokenizer

    study, workspace = setting.study, setting.workspace
    with workspace.claimed():
        sources = find_sources(study, setting.data) if setting.data else make_suite(study, workspace)
        make_tokenizer(study, workspace, sources)
    wrote(workspace.tokenizer, then=_next("tokenize", setting))


def tokenize(setting: Setting) -> None:
    from experiments.pipeline import prepare

    with setting.workspace.claimed():
        prepare(setting.study, setting.workspace, setting.data)
    wrote(setting.workspace.store, setting.workspace.manifest, then=_next("train", setting))


def train(setting: Setting, run: Path | None, mesh: MeshConfig) -> None:
    from experiments.pipeline import prepare
    from experiments.trial import open_materials, train_trial

    study, workspace = setting.study, setting.workspace
    run = run or workspace.root / "model"
    with workspace.claimed():
        prepare(study, workspace, setting.data)
    trial = reference_trial(study, study.seeds[0])
    with step(f"train: {trial.title}") as update:
        result = train_trial(
            trial,
            open_materials(workspace),
            run,
            mesh=mesh,
            progress=lambda phase, done, total: update(done, total, phase),
        )
    console.print(f"loss {result.losses[-1]:.4f} after {len(result.losses):,} steps")
    wrote(run, then=_next(f"evaluate {shlex.quote(_short(run))}", setting))


def evaluate(setting: Setting, run: Path) -> None:
    from experiments.trial import evaluate_on, open_materials, write_samples
    from hma_jax.training.train import load_run

    trained = load_run(run)
    materials = open_materials(setting.workspace)
    check_fits(trained, materials)
    with step(f"evaluate {_short(run)}") as update:
        evaluation = evaluate_on(
            trained.table.names,
            trained.params,
            trained.model,
            trained.table,
            materials,
            setting.study.eval,
            trained.train.masking.setting,
            progress=lambda phase, done, total: update(done, total, phase),
        )
    wanted = ("perplexity", "accuracy", "diffusion_loss", "psnr", "ssim", "delta_psnr", "action_error", "action_gain")
    metrics = [m for m in wanted if m in evaluation.overall]
    table = tidy_table(f"{_short(run)}, step {trained.step:,}", "dataset", *metrics)
    for name, stats in [*evaluation.datasets.items(), ("overall", evaluation.overall)]:
        table.add_row(name, *(f"{stats[m].mean:.4g} ± {stats[m].sem:.2g}" for m in metrics))
    console.print(table)
    write_atomically(run / "evaluation.json", json.dumps(evaluation.to_dict(), indent=1))
    write_samples(run / "samples.npz", evaluation.samples)
    wrote(run / "evaluation.json", run / "samples.npz")


def check_fits(trained: Run, materials: Materials) -> None:
    """Raises ConfigError when a model was trained for other tokens, windows or datasets than these."""
    advice = "; evaluate it with the --out it was trained in"
    tokenizer, here = trained.provenance.get("tokenizer"), materials.tokenizer.identity
    if tokenizer != here:
        raise ConfigError(
            f"the model was trained on tokens of tokenizer {tokenizer}, the study here uses {here}{advice}"
        )
    frames, manifest = trained.model.frames, materials.manifest
    if frames != manifest.frames:
        raise ConfigError(
            f"the model sees windows of {frames} frames, those frozen for evaluation here have "
            f"{manifest.frames}{advice}"
        )
    missing = set(trained.table.names) - {d.dataset for d in manifest.datasets}
    if missing:
        raise ConfigError(
            f"the model was trained on {', '.join(sorted(missing))}, of which the study here has no "
            f"windows{advice}"
        )


def draw_again(out: Path) -> None:
    """Report of a study that ran before, without touching its data or trials."""
    workspace = Workspace(out.absolute())
    draw(workspace, load_record(workspace))


def _next(command: str, setting: Setting) -> str:
    out = _short(setting.workspace.root)
    data = " --data " + " ".join(map(shlex.quote, setting.data)) if setting.data else ""
    return f"hma {command} --preset {setting.study.name} --out {shlex.quote(out)}{data}"
