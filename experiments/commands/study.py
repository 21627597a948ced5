"""What the commands of `hma` do. The command line itself is in `cli`; heavy imports happen here.

Every command ends by saying what it wrote and what to run next.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.markup import escape

from experiments import (
    ablate_conditioning,
    ablate_settings,
    scale_datasets,
    scale_trajectories,
    scale_width,
    transfer_lr,
)
from experiments.ledger import FINISHED, Ledger
from experiments.presets import get_preset
from experiments.program import command_line
from experiments.progress import SweepMonitor, console
from experiments.runner import Job, State, read_states, run_missing
from experiments.study import Study, on_tokenizer, on_user_data, override
from experiments.sweep import titles, unique_trials
from experiments.workspace import Record, Workspace, load_record, merge_axes, save_record
from hma_jax.config import ConfigError
from hma_jax.config.json import to_dict

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
    tokenizer: Path | None = None  # a trained one to use; None: train one on the data
    registry: Path | None = None  # a file of entries besides those of the project


def make_setting(
    preset: str,
    out: Path | None,
    data: Sequence[str],
    settings: Sequence[str],
    tokenizer: Path | None = None,
    registry: Path | None = None,
    mixture: str | None = None,
) -> Setting:
    """The preset, on the user's data and tokenizer if given, with overrides. Touches no other file.

    A `mixture` names the datasets, which are then looked for in the directories of `data`.
    """
    from data_pipelines.rlds.location import absolute

    study = get_preset(preset)
    use_entries(registry)
    if mixture is not None:
        from data_pipelines.registry.mixtures import get_mixture

        names = get_mixture(mixture)
        study = on_user_data(study, names)
        data = find_directories(names, data) if data else ()
    elif data:
        from experiments.pipeline import name_datasets

        study = on_user_data(study, name_datasets(data))
    if tokenizer is not None:
        from hma_jax.tokenizers.io import load_config

        study = on_tokenizer(study, load_config(tokenizer))
    study = override(study, settings)
    directories = tuple(map(absolute, data))
    workspace = Workspace((out or Path("runs") / study.name).absolute())
    return Setting(study, directories, workspace, tokenizer and tokenizer.absolute(), registry and registry.absolute())


def on_mesh(setting: Setting, mesh: tuple[int, int, int] | None) -> Setting:
    """The same, its trials on devices for (data, fsdp, tensor) parallelism; None: as the study says."""
    if mesh is None:
        return setting
    study = setting.study
    sizes = replace(study.execution.mesh, data=mesh[0], fsdp=mesh[1], tensor=mesh[2])
    return replace(setting, study=replace(study, execution=replace(study.execution, mesh=sizes)))


def use_entries(registry: Path | None) -> None:
    """Adds the entries of a TOML file to the registry, for the rest of this process."""
    if registry is not None:
        from data_pipelines.registry import register
        from data_pipelines.registry.toml_file import load_entries

        register(load_entries(registry))


def find_directories(names: Sequence[str], roots: Sequence[str]) -> list[str]:
    """`<root>/<name>` for every name, in the first root that has it. ConfigError for those missing."""
    from data_pipelines.rlds.location import locate

    found = {n: locate(r) / n for r in reversed(roots) for n in names if (locate(r) / n).is_dir()}
    missing = [n for n in names if n not in found]
    if missing:
        raise ConfigError(
            f"no directory for {', '.join(missing)} in {', '.join(roots)}; with a mixture, --data takes the "
            "directories that hold <name>/<version>"
        )
    return [str(found[n]) for n in names]


def dry_run(study: Study, axes: Sequence[str]) -> None:
    from experiments.cost import plan_table

    console.print(plan_table(study, [AXES[axis](study) for axis in axes]))


def run_study(setting: Setting, axes: Sequence[str], *, workers: int, retry_failed: bool) -> None:
    """Prepares, runs what is missing, and draws the results. Raises TrialsFailed at the end."""
    from experiments.pipeline import prepare, require_simulated

    study, workspace = setting.study, setting.workspace
    if not setting.data:
        require_simulated(study.dataset_names())
    sweeps = [AXES[axis](study) for axis in axes]
    with workspace.claimed():
        all_axes = merge_axes(workspace, study, axes)
        provenance = prepare(study, workspace, setting.data, setting.tokenizer)
        record = Record(study, setting.data, all_axes, command_line(), provenance)
        save_record(workspace, record)
        trials = unique_trials(sweeps, provenance)
        common = {"provenance": to_dict(provenance), "execution": to_dict(study.execution)}
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
    from experiments.report.page import write_report
    from experiments.report.plots import plot_overview, plot_sweep
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
        console.print(f"wrote [bold]{escape(short(path))}[/]", soft_wrap=True)
    if then:
        console.print(f"next: {escape(then)}", soft_wrap=True)


def short(path: Path) -> str:
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)


# --- Single steps ----------------------------------------------------------------------------


def write_suite(setting: Setting) -> None:
    from experiments.pipeline import make_suite

    with setting.workspace.claimed():
        make_suite(setting.study, setting.workspace)
    wrote(setting.workspace.suite, then=next_command("tokenizer train", setting))


def train_tokenizer(setting: Setting) -> None:
    from experiments.pipeline import find_sources, make_suite, make_tokenizer

    study, workspace = setting.study, setting.workspace
    with workspace.claimed():
        sources = find_sources(study, setting.data) if setting.data else make_suite(study, workspace)
        make_tokenizer(study, workspace, sources)
    wrote(workspace.tokenizer, then=next_command("tokenize", setting))


def draw_again(out: Path) -> None:
    """Report of a study that ran before, without touching its data or trials."""
    workspace = Workspace(out.absolute())
    draw(workspace, load_record(workspace))


def next_command(command: str, setting: Setting) -> str:
    """A command line for the same study, data and directory."""
    out = short(setting.workspace.root)
    data = " --data " + " ".join(map(shlex.quote, setting.data)) if setting.data else ""
    tokenizer = f" --tokenizer {shlex.quote(short(setting.tokenizer))}" if setting.tokenizer else ""
    registry = f" --registry {shlex.quote(short(setting.registry))}" if setting.registry else ""
    return f"hma {command} --preset {setting.study.name} --out {shlex.quote(out)}{data}{registry}{tokenizer}"
