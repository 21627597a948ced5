"""The evaluation windows that all trials of a study share, and the summary of its data."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from data_pipelines.errors import DataError
from data_pipelines.registry import get_spec
from experiments.preparing.made_from import Step, dataset_differences, require_same
from experiments.running.provenance import Provenance
from experiments.running.workspace import Workspace
from experiments.study import StoreConfig, Study
from experiments.terminal.progress import say
from experiments.terminal.words import few
from hma_jax.config import require
from hma_jax.config.json import diff
from hma_jax.runtime.files import write_file

if TYPE_CHECKING:
    from data_pipelines.tokens.store import TokenStore
    from data_pipelines.windows.evalset import EvalManifest

HELD_OUT = 0.25
"""Share of a dataset's episodes; if more are held out, a note says how many and why."""


def require_same_windows(study: Study, workspace: Workspace, replace: Step | None) -> None:
    """Raises ConfigError, before anything is made, if what is known by then does not fit the frozen windows."""
    require_same("windows", workspace.manifest, window_changes(study, workspace), replace)


def window_changes(study: Study, workspace: Workspace) -> list[str]:
    """How the frozen windows differ from what is known about the study's windows before tokens are made; [] if there
    are none."""
    from data_pipelines.windows.evalset import EvalManifest

    if not workspace.manifest.exists():
        return []
    try:
        existing = EvalManifest.load(workspace.manifest)
    except DataError as error:
        return [str(error)]
    return _setting_differences(existing, study.model.frames, study.rate, study.eval.seed, study.all_names())


def freeze_windows(study: Study, workspace: Workspace, replace: Step | None = None) -> Provenance:
    """The validation windows that all trials share, and a summary of the data.

    Raises ConfigError if other windows exist, unless `replace` allows it.
    """
    from data_pipelines.tokens.store import TokenStore
    from data_pipelines.windows.evalset import freeze_manifest

    store = TokenStore(workspace.store)
    names, frames = study.all_names(), study.model.frames
    manifest = freeze_manifest(
        store, names, frames, study.eval.windows_per_dataset, study.eval.seed,
        prompt=study.eval.prompt_frames, rate=study.rate,
    )  # fmt: skip
    existing = _frozen(workspace, replace)
    if existing is None or existing.hash() != manifest.hash():
        if existing is not None:
            require_same("windows", workspace.manifest, _differences(existing, manifest), replace)
        manifest.save(workspace.manifest)
    summary = summarise(store, names, frames, study.rate)
    write_file(workspace.data_summary, json.dumps(summary, indent=1))
    empty = {name: f"{reason}{_what_helps(study, store, name)}" for name, reason in manifest.empty.items()}
    for name, facts in summary.items():
        _remark(name, facts, empty.get(name, ""))
    say_padded(summary, frames, workspace.data_summary.name)
    _say_held_out(summary, study.store)
    say_alone(summary)
    without = [name for name, facts in summary.items() if not facts["windows"]]
    if without:
        say(
            f"{len(names) - len(without)} of {len(names)} datasets can be trained on; {few(without)} "
            f"{'has' if len(without) == 1 else 'have'} no training window"
        )
    (identity,) = {store.manifest(name).tokenizer.identity for name in names}
    return Provenance(store.hash(names), manifest.hash(), identity)


def _what_helps(study: Study, store: TokenStore, name: str) -> str:
    """The end of a note on a dataset without a window: the settings with which its short episodes would give one."""
    from data_pipelines.windows.windows import least_judged, settings_for_short

    manifest, least = store.manifest(name), least_judged(study.eval.prompt_frames, study.model.frames)
    settings = settings_for_short(manifest.stride_at(study.rate), least) if manifest.val.steps else ""
    return f"; {settings} may give it windows" if settings else ""


def windows_are_frozen(study: Study, workspace: Workspace) -> bool:
    """Whether the existing windows belong to the existing tokens."""
    from data_pipelines.tokens.store import TokenStore

    existing = _frozen(workspace, None)
    return existing is not None and existing.store == TokenStore(workspace.store).hash(study.all_names())


def require_judged(study: Study, workspace: Workspace, judged: Collection[str]) -> None:
    """Raises ConfigError if a `judged` dataset has no evaluation window, or a dataset of the study no training window:
    a point of an axis would seem to include more datasets than it was made with."""
    from data_pipelines.windows.evalset import EvalManifest
    from data_pipelines.windows.windows import least_judged

    empty = EvalManifest.load(workspace.manifest).empty
    least = least_judged(study.eval.prompt_frames, study.model.frames)
    summary = json.loads(workspace.data_summary.read_text())
    names = study.all_names()
    unjudged = [name for name in names if name in empty and name in judged]
    lines = [f"{name} is to be evaluated, but has no held-out window: {empty[name]}" for name in unjudged]
    lines += [f"{name} has no training window" for name in names if not summary[name]["windows"]]
    require(
        not lines,
        f"{'; '.join(lines)}. Leave it out of the study (of --data, or with --set datasets=...), or change the "
        f"settings of windows: rate={study.rate}, eval.prompt_frames={study.eval.prompt_frames} (held-out windows of at "
        f"least {least} frames), store.min_val={study.store.min_val}",
    )


def _frozen(workspace: Workspace, replace: Step | None) -> EvalManifest | None:
    """The existing windows. Raises ConfigError if they cannot be read, unless they may be replaced."""
    from data_pipelines.windows.evalset import EvalManifest

    if not workspace.manifest.exists():
        return None
    try:
        return EvalManifest.load(workspace.manifest)
    except DataError as error:
        require_same("windows", workspace.manifest, [str(error)], replace)
        return None


def _setting_differences(
    existing: EvalManifest, frames: int, rate: float | None, seed: int, names: Sequence[str]
) -> list[str]:
    lines = [f"model.frames: {existing.frames} -> {frames}"] if existing.frames != frames else []
    lines += [f"rate: {existing.rate} -> {rate}"] if existing.rate != rate else []
    lines += [f"eval.seed: {existing.seed} -> {seed}"] if existing.seed != seed else []
    return lines + dataset_differences([d.dataset for d in existing.datasets], sorted(names))


def _differences(existing: EvalManifest, wanted: EvalManifest) -> list[str]:
    """The differences, under the names that --set uses."""
    names = [d.dataset for d in wanted.datasets]
    lines = _setting_differences(existing, wanted.frames, wanted.rate, wanted.seed, names)
    if existing.store != wanted.store and not lines:
        lines.append(f"tokens: {existing.store} -> {wanted.store}")
    lines += diff(existing.settings, wanted.settings, "eval")
    return lines or [f"windows: {existing.hash()} -> {wanted.hash()}, as of another version, which chose others"]


def summarise(store: TokenStore, names: Sequence[str], frames: int, rate: float | None) -> dict[str, dict[str, int]]:
    """Per dataset: numbers of training episodes, of those too short for a window or for a whole window, of windows, of
    episodes held out and skipped, and of those that the setting `max_train` left out, if any."""
    from data_pipelines.windows.windows import train_windows

    summary = {}
    for name in names:
        manifest, windows = store.manifest(name), train_windows(store, name, frames, rate=rate)
        summary[name] = {
            "episodes": len(manifest.train.episodes),
            "too_short": windows.too_short,
            "padded": windows.padded,
            "windows": len(windows),
            "held_out": len(manifest.val.episodes),
            "skipped": manifest.skipped_count,
        }
        if manifest.left_out:
            summary[name]["left_out"] = manifest.left_out
    return summary


def _say_held_out(summary: dict[str, dict[str, int]], settings: StoreConfig) -> None:
    """Names the datasets that lose many episodes to evaluation because they have few."""
    many = []
    for name, facts in summary.items():
        if get_spec(name).val_split:
            continue  # these were not taken from training episodes
        held_out = facts["held_out"]
        episodes = held_out + facts["episodes"] + facts.get("left_out", 0)
        if held_out > HELD_OUT * episodes and held_out > round(settings.val_fraction * episodes):
            many.append(f"{held_out} of {episodes} episodes of {name}")
    if many:
        say(
            f"note: a large part is held out: {few(many)}. At least store.min_val={settings.min_val} episodes are "
            f"held out, but at most store.max_val_fraction={settings.max_val_fraction:g} of a dataset, or one episode"
        )


def say_padded(summary: dict[str, dict[str, int]], frames: int, file: str) -> None:
    """Prints in how many datasets windows end with padding, and in which most of them do; `file` lists the others."""
    padded = {name: facts for name, facts in summary.items() if facts["padded"]}
    if padded:
        most = sorted(padded, key=lambda name: -padded[name]["padded"] / padded[name]["episodes"])
        each = [f"{padded[name]['padded']} of {padded[name]['episodes']} of {name}" for name in most]
        say(
            f"note: training episodes too short for {frames} frames, whose windows end with padding: {few(each)}"
            f"{f' ({file})' if len(each) > 3 else ''}"
        )


def say_alone(summary: dict[str, dict[str, int]]) -> None:
    """Names the robots with a single training episode: a control has no other episode from which to take actions."""
    alone = [
        name
        for name, facts in summary.items()
        if facts["windows"] and facts["episodes"] - facts["too_short"] == 1 and get_spec(name).action_dim
    ]
    if alone:
        say(
            f"note: only one training episode has windows: {few(alone)}. A control, trained on shuffled actions, then "
            "gets actions of the same episode, or of the same window if there is only one, so it may follow them"
        )


def _remark(name: str, facts: dict[str, int], no_evaluation: str) -> None:
    """Says which part of a dataset is not used."""
    remarks = []
    if facts["too_short"]:
        remarks.append(f"{facts['too_short']} of {facts['episodes']} training episodes are too short for any window")
    if facts["skipped"]:
        remarks.append(f"{facts['skipped']} damaged episodes are left out, and not replaced in subsets")
    if left_out := facts.get("left_out"):
        used = facts["episodes"] + facts["held_out"]
        remarks.append(f"store.max_train leaves out {left_out:,} episodes; {used:,} are used, held-out ones included")
    if no_evaluation:
        remarks.append(f"it is not evaluated: {no_evaluation}")
    if remarks:
        say(f"note: {name}: {'; '.join(remarks)}")
