"""Running a trial to a result.

A trial's directory holds
    job.json        the trial and its provenance (written by the runner)
    run/            the training run (`hma_jax.training`): log, checkpoints
    samples.npz     true and predicted frames of a few windows per dataset, where frames are predicted
    evaluating/     of an evaluation that has not ended: what was measured, from which the next attempt goes on
    windows.parquet every window's numbers (`hma_jax.evaluation.windows`), of which result.json has the means
    provenance.json what it ran with: sources, versions, machine (`experiments.running.provenance`)
    result.json     written last, sealed (`experiments.running.result_file`): a trial with this file is finished
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.running.attempts import EVALUATING, RUN
from experiments.running.machine import describe_machine
from experiments.running.provenance import InputsChanged, Provenance, read_record, record_end
from experiments.running.result_file import SAMPLES, write_result
from experiments.running.run_options import UNWATCHED, RunOptions
from experiments.running.trial import Trial, loader_of
from experiments.running.workspace import Workspace
from hma_jax.config import EvalConfig, ExecutionConfig, MaskingSetting, ModelConfig
from hma_jax.config.json import identity_of, to_dict
from hma_jax.evaluation.windows import FILE
from hma_jax.training.run_lock import CHECKPOINTS

if TYPE_CHECKING:
    from data_pipelines.tokens.store import TokenStore
    from data_pipelines.windows.counterfactual import CounterfactualFrames
    from data_pipelines.windows.evalset import EvalManifest
    from hma_jax.evaluation.evaluate import Evaluation
    from hma_jax.evaluation.parts import Parts
    from hma_jax.model.embodiments import EmbodimentTable
    from hma_jax.model.params import Params
    from hma_jax.tokenizers.base import Tokenizer
    from hma_jax.training.loop import FitResult

Progress = Callable[[str, int, int], None]
"""Called as progress(phase, done, total)."""

LAST = 0.1
"""The last part of a run's steps, over which its training loss is averaged."""


@dataclass(frozen=True)
class PreparedData:
    """What the pipeline prepared, opened."""

    store: TokenStore
    tokenizer: Tokenizer
    manifest: EvalManifest
    counterfactual: CounterfactualFrames | None = None  # for robots that are simulated

    def provenance(self) -> Provenance:
        """What a trial on this data is named by. Datasets that the store lacks are left out of its hash."""
        names = [one.dataset for one in self.manifest.datasets if one.dataset in self.store.names]
        return Provenance(self.store.hash(names), self.manifest.hash(), self.tokenizer.identity)


def open_prepared_data(workspace: Workspace, inputs: Provenance | None = None) -> PreparedData:
    """Raises ConfigError or DataError for what is missing or damaged, InputsChanged if any of it is not what `inputs`
    says."""
    from data_pipelines.tokens.store import TokenStore
    from data_pipelines.windows.counterfactual import CounterfactualFrames
    from data_pipelines.windows.evalset import EvalManifest
    from hma_jax.tokenizers.io import load_tokenizer

    prepared = PreparedData(
        TokenStore(workspace.store),
        load_tokenizer(workspace.tokenizer),
        EvalManifest.load(workspace.manifest),
        CounterfactualFrames.load(workspace.counterfactual) if workspace.counterfactual.exists() else None,
    )
    if inputs is not None:
        _require_inputs(workspace, prepared.provenance(), inputs)
    return prepared


def _require_inputs(workspace: Workspace, found: Provenance, planned: Provenance) -> None:
    compared = (
        (workspace.store, found.store, planned.store),
        (workspace.manifest, found.manifest, planned.manifest),
        (workspace.tokenizer, found.tokenizer, planned.tokenizer),
    )
    lines = [f"{path} is {here}, not {wanted}" for path, here, wanted in compared if here != wanted]
    if lines:
        raise InputsChanged(
            f"the study's data changed since this sweep was started: {'; '.join(lines)}. The trial was not run. Put back "
            "what was there, or run the study's command again, which checks the data and plans the trials anew"
        )


def train_trial(
    trial: Trial,
    prepared: PreparedData,
    run_dir: Path,
    *,
    execution: ExecutionConfig = ExecutionConfig(),
    options: RunOptions = UNWATCHED,
    keep: tuple[int, ...] = (),
    whole_log: bool = False,
    progress: Progress = lambda *_: None,
    table: EmbodimentTable | None = None,
    initial: Params | None = None,
    origin: dict[str, Any] | None = None,
) -> FitResult:
    """Trains, or continues training, in `run_dir`. Raises what `hma_jax.training.train.train_model` raises.

    A model with trained parameters has its own `table` (of which the trial's datasets are part), its
    `initial` parameters and an `origin`, which its checkpoints remember.
    """
    from data_pipelines.loading.loader import describe_batch, make_loader
    from data_pipelines.loading.selection import training_table
    from hma_jax.runtime.rows import own_rows
    from hma_jax.training.loop import LoopOptions
    from hma_jax.training.train import train_model
    from hma_jax.training.validation import Validation

    store, loader = prepared.store, loader_of(trial)
    table = table or training_table(store, loader, trial.train.action_scale)
    checkpoint_every, validate_every = options.steps_between(trial.train.steps)

    def report(step: int, steps: int, values: dict[str, float]) -> None:
        held_out = f", held-out loss {values['validation/loss']:.4f}" if "validation/loss" in values else ""
        progress(f"training{held_out}", step, steps)

    return train_model(
        trial.model,
        table,
        trial.train,
        lambda start: make_loader(
            store,
            table,
            loader,
            start_step=start,
            rows=own_rows(execution.mesh, trial.train.batch),
            threads=execution.loader_threads,
        ),
        execution=execution,
        run_dir=run_dir,
        provenance={
            "store": store.hash(trial.datasets),
            "tokenizer": prepared.tokenizer.identity,
            "loader": identity_of(loader),
            "lost": {name: store.manifest(name).skipped_count for name in trial.datasets},  # damaged episodes, left out
            **({"origin": origin} if origin else {}),
        },
        initial=initial,
        records=lambda index: describe_batch(store, table, loader, index),
        options=LoopOptions(
            checkpoint_every=checkpoint_every,
            checkpoint_minutes=options.checkpoint_minutes,
            keep_checkpoints=options.keep_checkpoints,
            keep_steps=keep,
            keep_every=options.keep_every,
            skip_damaged=options.skip_damaged,
            whole_log=whole_log,
            trace_steps=options.trace or 0,
        ),
        validation=Validation(validate_every, lambda: validation_batches(trial, prepared, table, execution))
        if validate_every
        else None,
        progress=report,
    )


def validation_batches(
    trial: Trial, prepared: PreparedData, table: EmbodimentTable, execution: ExecutionConfig = ExecutionConfig()
) -> Iterator[dict[str, Any]]:
    """Some frozen windows of each evaluated dataset, from as many episodes as possible: one batch as large as in
    training, of which this process gets its rows."""
    from data_pipelines.windows.evalset import eval_batches
    from hma_jax.runtime.rows import own_rows
    from hma_jax.training.step import TRAINING_ARRAYS

    batch = trial.train.batch
    own, some = own_rows(execution.mesh, batch), prepared.manifest.subsampled(batch)
    for name in trial.evaluated:  # one without windows has no batch
        for whole in eval_batches(prepared.store, table, some, batch, (name,)):
            arrays = {key: whole[key][own] for key in (*TRAINING_ARRAYS, "valid") if key in whole}
            yield arrays | {"dataset": name}


def evaluate_on(
    names: tuple[str, ...],
    params: Any,
    model: ModelConfig,
    table: EmbodimentTable,
    prepared: PreparedData,
    config: EvalConfig,
    setting: MaskingSetting = "forward",
    *,
    execution: ExecutionConfig = ExecutionConfig(),
    first: int | None = None,
    progress: Progress = lambda *_: None,
    parts: Parts | None = None,
) -> Evaluation:
    """Runs the protocol over the frozen windows of `names`, or over the `first` ones of each; `parts` hold what is done
    already.

    Counterfactual PSNR needs simulated frames for exactly this prompt, and generated frames. Models that were trained
    only to predict actions are not shown actions of other episodes.
    """
    from data_pipelines.windows.evalset import eval_batches
    from hma_jax.evaluation.evaluate import evaluate
    from hma_jax.evaluation.protocol import predicts_frames

    manifest = prepared.manifest
    config = config if predicts_frames(setting) else dataclasses.replace(config, other_actions=0)
    counterfactual = prepared.counterfactual if config.context == "generated" and config.other_actions else None
    counterfactual = counterfactual if counterfactual and counterfactual.prompt == config.prompt_frames else None
    batches = eval_batches(
        prepared.store,
        table,
        manifest,
        config.batch,
        names,
        first=first,
        other_actions=config.other_actions,
        counterfactual=counterfactual,
        prompt=config.prompt_frames,
    )
    windows = sum(len(d.windows[:first]) for d in manifest.datasets if d.dataset in names)
    progress("evaluating", 0, windows)
    return evaluate(
        params,
        model,
        table,
        prepared.tokenizer,
        batches,
        config,
        setting=setting,
        execution=execution,
        progress=lambda done: progress("evaluating", done, windows),
        parts=parts,
    )


def run_trial(
    trial: Trial,
    inputs: Provenance,
    workspace: Workspace,
    directory: Path,
    *,
    execution: ExecutionConfig = ExecutionConfig(),
    keep: tuple[int, ...] = (),
    begin: Callable[[PreparedData], Mapping[str, Any]] | None = None,
    progress: Progress = lambda *_: None,
) -> dict[str, Any]:
    """Trains and evaluates `trial` on the data that `inputs` names, resuming in `directory` what a killed run left
    there.

    `keep`: steps after which its checkpoint stays, for trials that go on from there. `begin` makes what a trial with a
    source begins with (`initial_model.InitialModel`). Returns what it writes to result.json. Raises ConfigError
    (InputsChanged for other data), DataError, DivergedError or Interrupted.
    """
    import jax

    from data_pipelines.loading.selection import select_windows, training_table
    from hma_jax.evaluation.parts import Parts
    from hma_jax.model.flops import train_flops_per_step
    from hma_jax.model.hma import declare_model
    from hma_jax.runtime.processes import is_writer

    started = time.perf_counter()
    prepared = open_prepared_data(workspace, inputs)
    if begin is None:
        beginning = {"table": training_table(prepared.store, loader_of(trial), trial.train.action_scale)}
    else:
        beginning = begin(prepared)
    table = beginning["table"]
    declared = declare_model(trial.model, table)
    trained = train_trial(
        trial,
        prepared,
        directory / RUN,
        execution=execution,
        keep=keep,
        whole_log=True,  # the result has the mean loss of the last steps, and seals the log
        progress=progress,
        **beginning,
    )

    weights, loss = trained.state.weights, last_loss(trained.losses)
    seconds = {"train_seconds": trained.seconds, "compile_seconds": trained.compile_seconds}
    layout = jax.tree.map(lambda x: x.sharding, weights)
    del trained, beginning  # moments and initial parameters would take device memory during evaluation

    subject = (trial.model, table, prepared, trial.eval, trial.train.masking.setting)
    parts = Parts(directory / EVALUATING, lambda: _evaluated(trial, prepared, directory, execution))
    evaluation = evaluate_on(trial.evaluated, weights, *subject, execution=execution, progress=progress, parts=parts)
    del weights
    untrained = None
    if trial.measure_untrained:  # a few windows are enough: it has learnt nothing
        fresh = declared.init(trial.train.seed, layout)
        untrained = evaluate_on(
            trial.evaluated, fresh, *subject, execution=execution, first=trial.eval.batch
        ).summary.to_dict()

    drawn = select_windows(prepared.store, loader_of(trial)).drawn()
    result = {
        "evaluation": evaluation.summary.to_dict(),
        "untrained": untrained,
        "training_loss": loss,
        "trajectories": {name: one.trajectories for name, one in drawn.items()},
        "mixture": {name: {"windows": one.windows, "share": one.share} for name, one in drawn.items()},
        "parameters": declared.count(),
        "train_flops": train_flops_per_step(trial.model, table, trial.train) * trial.train.steps,
        "run": {
            "seconds": time.perf_counter() - started,
            **seconds,
            "machine": describe_machine(jax.devices()),
            "finished": time.strftime("%Y-%m-%d %H:%M:%S %z"),
        },
    }
    if is_writer():
        write_evaluation(directory, evaluation, directory.name)
        record_end(directory)
        write_result(directory, result)
        parts.remove()
    return result


def _evaluated(trial: Trial, prepared: PreparedData, directory: Path, execution: ExecutionConfig) -> list[Any]:
    """What the numbers of a trial's evaluation depend on: sources, settings, data and weights."""
    from hma_jax.training.hashes import read_list

    record, weights = read_record(directory), read_list(directory / RUN / CHECKPOINTS / str(trial.train.steps))
    data = to_dict(prepared.provenance())
    return [record and record.code, to_dict(trial), to_dict(execution), data, weights]


def last_loss(losses: Sequence[float]) -> dict[str, Any]:
    """The mean of a run's last steps, as a `Stat`'s fields; the log has the loss of each."""
    from hma_jax.evaluation.statistics import mean_and_sem

    return dataclasses.asdict(mean_and_sem(losses[-max(round(LAST * len(losses)), 1) :]))


def write_evaluation(directory: Path, evaluation: Evaluation, trial: str) -> None:
    """Writes windows.parquet, of `trial`, and, where there are samples, samples.npz into `directory`, in place of
    others."""
    evaluation.windows.save(directory / FILE, trial)
    if evaluation.samples:
        write_samples(directory / SAMPLES, evaluation.samples)
    else:
        (directory / SAMPLES).unlink(missing_ok=True)


def write_samples(path: Path, samples: dict[str, dict[str, Any]]) -> None:
    """Stores {dataset: {true, predicted, random: uint8 [n, T, H, W, 3]}} as '<dataset>/<kind>'."""
    from hma_jax.runtime.arrays import write_arrays

    write_arrays(path, {f"{name}/{kind}": clip for name, kinds in samples.items() for kind, clip in kinds.items()})
