"""What `hma train`, `hma adapt` and `hma evaluate` do: single models of a study's data."""

from __future__ import annotations

import dataclasses
import json
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_pipelines.publishing.files import write_file
from experiments.commands.study import wrote
from experiments.preparing.made_from import Step
from experiments.progress import console, step, tidy_table
from experiments.setting import Setting, short
from experiments.sweep import reference_trial
from hma_jax.config import ConfigError, Weights, require
from hma_jax.config.json import from_dict

if TYPE_CHECKING:
    from experiments.run_options import RunOptions
    from experiments.trial import Materials, Trial
    from hma_jax.tokenizers.base import Tokenizer
    from hma_jax.training.runs import Run


SHOWN = (
    "perplexity", "accuracy", "diffusion_loss", "psnr", "ssim", "delta_psnr", "action_error", "action_gain"
)  # fmt: skip
"""Metrics in the table of `hma evaluate`, where a model has them; evaluation.json holds all, and
windows.parquet those of every window."""


def train(
    setting: Setting,
    run: Path | None,
    options: RunOptions,
    *,
    trajectories: int | None = None,
    replace: Step | None = None,
) -> None:
    """Trains the study's reference trial by itself, on all `trajectories` or so many of each robot."""
    _check(trajectories, options)
    _prepare(setting, replace)
    trial = _single_trial(setting, trajectories)
    _train(setting, trial, run or setting.workspace.root / "model", options)


def adapt(
    setting: Setting,
    source: Path,
    run: Path | None,
    options: RunOptions,
    *,
    everything: bool = False,
    trajectories: int | None = None,
    replace: Step | None = None,
) -> None:
    """Trains a model further that has first been given slices for the study's new datasets."""
    from data_pipelines.loading.selection import training_embodiment
    from experiments.trial import loader_of, open_materials
    from hma_jax.training.adapt import add_embodiments
    from hma_jax.training.runs import load_run

    _check(trajectories, options)
    _prepare(setting, replace)
    study, materials = setting.study, open_materials(setting.workspace)
    trained = load_run(source)
    _check_tokenizer(trained, materials, f"; add --tokenizer with the one that {short(source)} was trained with")
    seed = study.seeds[0]
    new = [name for name in study.dataset_names() if name not in trained.table.names]
    require(bool(new), f"{source} already knows {', '.join(study.dataset_names())}: there is nothing to add")
    only = () if everything else tuple(new)
    trial = dataclasses.replace(
        _single_trial(setting, trajectories),
        model=trained.model,
        train=dataclasses.replace(study.train, seed=seed, only=only),
    )
    scale = study.train.action_scale
    robots = [training_embodiment(materials.store, name, loader_of(trial), scale) for name in new]
    params, table = add_embodiments(trained.params, trained.model, trained.table, robots, seed)
    console.print(f"new: {', '.join(new)}; training {'everything' if everything else 'these alone'}")
    origin = {"step": trained.step, "provenance": trained.provenance}
    del trained  # its arrays are not needed while the new model trains
    where = run or setting.workspace.root / "model"
    _train(setting, trial, where, options, table=table, initial=params, origin=origin)


def _check(trajectories: int | None, options: RunOptions) -> None:
    options.check()
    require(trajectories is None or trajectories >= 1, f"--trajectories must be at least 1, got {trajectories}")


def _prepare(setting: Setting, replace: Step | None) -> None:
    from experiments.pipeline import prepare
    from hma_jax.runtime.processes import is_writer, writer_first

    with writer_first("data"):
        if is_writer():
            with setting.workspace.claimed():
                prepare(setting.study, setting.workspace, setting.data, setting.tokenizer, replace=replace)


def _single_trial(setting: Setting, trajectories: int | None) -> Trial:
    """The reference trial, but that the largest number of trajectories in a sweep does not bound it."""
    study = setting.study
    return dataclasses.replace(reference_trial(study, study.seeds[0]), max_trajectories=trajectories)


def _train(setting: Setting, trial: Trial, run: Path, options: RunOptions, **start: Any) -> None:
    from experiments.trial import open_materials, train_trial
    from hma_jax.runtime.processes import is_writer

    materials, steps = open_materials(setting.workspace), trial.train.steps
    say_data(trial, materials)
    with step(f"train width {trial.model.width} for {steps:,} steps of {trial.train.batch} windows") as update:
        result = train_trial(
            trial,
            materials,
            run,
            execution=setting.study.execution,
            options=options,
            progress=lambda phase, done, total: update(done, total, phase),
            **start,
        )
    if not is_writer():
        return
    console.print(f"loss {result.losses[-1]:.4f} after {len(result.losses):,} steps")
    wrote(run, then=setting.command("evaluate", run.absolute()))


def say_data(trial: Trial, materials: Materials) -> None:
    """What a model is trained on. Raises DataError if it is nothing."""
    from data_pipelines.loading.selection import select_windows
    from experiments.trial import loader_of

    chosen = select_windows(materials.store, loader_of(trial))
    used = [chosen.sets[name] for name in chosen.mixture.names]
    there = sum(len(materials.store.manifest(name).train.episodes) for name in trial.datasets)
    limit = "" if trial.max_trajectories is None else f" (at most {trial.max_trajectories:,} of each robot)"
    console.print(
        f"training on {len(used)} of {len(trial.datasets)} robots: {sum(len(s.episodes) for s in used):,} of {there:,} "
        f"trajectories{limit}, {sum(map(len, used)):,} windows of {trial.model.frames} frames",
        soft_wrap=True,
    )
    for name, reason in chosen.mixture.dropped.items():
        console.print(f"note: not trained on {name}: {reason}", markup=False, soft_wrap=True)


def evaluate(setting: Setting, run: Path, weights: Weights) -> None:
    from hma_jax.runtime.processes import is_writer
    from hma_jax.training.claim import EVALUATION, claimed
    from hma_jax.training.runs import load_model

    trained = load_model(run, setting.study.execution, weights).run
    # Before the work: that its results can be written, and by nobody else.
    with claimed(run, EVALUATION) if is_writer() else nullcontext():
        _evaluate(setting, run, trained)


def _evaluate(setting: Setting, run: Path, trained: Run) -> None:
    from experiments.trial import evaluate_on, open_materials, write_evaluation
    from hma_jax.evaluation.windows import FILE
    from hma_jax.runtime.processes import is_writer

    require_prepared(setting)
    materials = open_materials(setting.workspace)
    check_fits(trained, materials)
    frozen, untrained = set(materials.manifest.names), _not_trained_on(trained, materials)
    left_out = [name for name in trained.table.names if name not in frozen]
    if left_out:
        console.print(f"note: not evaluated, for want of windows here: {', '.join(left_out)}", soft_wrap=True)
    if untrained:
        console.print(f"note: not evaluated, for it was not trained on: {', '.join(untrained)}", soft_wrap=True)
    with step(f"evaluate {short(run)}") as update:
        evaluation = evaluate_on(
            tuple(name for name in trained.table.names if name in frozen - set(untrained)),
            trained.params,
            trained.model,
            trained.table,
            materials,
            setting.study.eval,
            trained.train.masking.setting,
            execution=setting.study.execution,
            progress=lambda phase, done, total: update(done, total, phase),
        )
    if not is_writer():
        return
    summary = evaluation.summary
    metrics = [m for m in SHOWN if m in summary.overall]
    which = ", averaged weights" if trained.weights == "ema" else ""
    table = tidy_table(f"{short(run)}, step {trained.step:,}{which}", "dataset", *metrics)
    for name, stats in [*summary.datasets.items(), ("overall", summary.overall)]:
        table.add_row(name, *(f"{stats[m].mean:.4g} ± {stats[m].sem:.2g}" for m in metrics))
    console.print(table)
    write_evaluation(run, evaluation)
    write_file(run / "evaluation.json", json.dumps(summary.to_dict(), indent=1))
    wrote(run / "evaluation.json", run / FILE, run / "samples.npz")


def _not_trained_on(trained: Run, materials: Materials) -> list[str]:
    """Datasets that a model was meant to be trained on and that gave it no window."""
    from data_pipelines.loading.selection import LoaderConfig, select_windows

    loader = trained.provenance.get("loader")
    if loader is None:  # it was converted
        return []
    config = from_dict(LoaderConfig, loader)
    if not set(config.datasets) <= set(materials.store.names):
        return []
    return list(select_windows(materials.store, config).mixture.dropped)


def require_prepared(setting: Setting) -> None:
    """Raises ConfigError, with the command that makes it, unless everything is there that evaluation reads."""
    there = setting.workspace
    missing = [str(p) for p in (there.store, there.tokenizer, there.manifest) if not p.exists()]
    require(not missing, f"{', '.join(missing)}: not made yet; run `{setting.command('tokenize')}`")


def check_fits(trained: Run, materials: Materials) -> None:
    """Raises ConfigError when a model was trained for other tokens, windows or datasets than these."""
    advice = "; evaluate it with the --out it was trained in"
    _check_tokenizer(trained, materials, advice)
    frames, manifest = trained.model.frames, materials.manifest
    if frames != manifest.frames:
        raise ConfigError(
            f"the model sees windows of {frames} frames, those frozen for evaluation here have "
            f"{manifest.frames}{advice}"
        )
    if not set(trained.table.names) & {d.dataset for d in manifest.datasets}:
        raise ConfigError(
            f"the model was trained on {', '.join(trained.table.names)}, of which the study here has no "
            f"windows{advice}"
        )


def _check_tokenizer(trained: Run, materials: Materials, advice: str) -> None:
    """A model that was converted does not know its tokenizer: then the form of its tokens decides."""
    if "official" in trained.provenance and "tokenizer" not in trained.provenance:
        _check_form(trained, materials.tokenizer, advice)
        return
    tokenizer, here = trained.provenance.get("tokenizer"), materials.tokenizer.identity
    if tokenizer != here:
        raise ConfigError(
            f"the model was trained on tokens of tokenizer {tokenizer}, the study here uses {here}{advice}"
        )


def _check_form(trained: Run, tokenizer: Tokenizer, advice: str) -> None:
    model = trained.model
    if model.diffusion:
        takes = (model.tokens, 0, 0, model.diffusion.token_channels)
    else:
        takes = (model.tokens, model.factors, model.factor_vocab, 0)
    makes = (tokenizer.tokens, tokenizer.factors, tokenizer.factor_vocab, tokenizer.channels)
    if takes != makes:
        words = "{0} tokens per frame of {1} factors with {2} entries and {3} latent channels"
        raise ConfigError(
            f"the model takes {words.format(*takes)}, the tokenizer here makes {words.format(*makes)}{advice}"
        )
    console.print(
        f"note: the model comes from the official release and does not say on which tokens it was trained; "
        f"taken for those of the tokenizer here, {tokenizer.identity}",
        soft_wrap=True,
    )
