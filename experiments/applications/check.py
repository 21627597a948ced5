"""Whether a model responds to each action dimension of a robot's recordings, with the recorded sign and scale."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from data_pipelines.sampling.splits import HeldOut
from data_pipelines.tokens.manifest import JobSettings
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.evalset import EvalManifest, eval_batches, subsample_windows
from experiments.running.run_trial import PreparedData, open_prepared_data
from experiments.running.workspace import Workspace
from experiments.study_setup import command_words
from experiments.terminal.words import few
from hma_jax.config import require
from hma_jax.evaluation.effects import MIN_EPISODES, Effect, find_effects, make_loss
from hma_jax.runtime.files import write_file
from hma_jax.simulator.folder import find_robots
from hma_jax.simulator.robots import Robot
from hma_jax.training.runs import Model

BATCH = 16
AT_LEAST = 8
"""The `store.min_val` that is advised if there are enough episodes."""


def open_study(workspace: Workspace) -> PreparedData:
    """Tokenizer, tokens and windows of a study. Raises ConfigError if they do not exist."""
    needed = (workspace.store, workspace.tokenizer, workspace.manifest)
    missing = [str(path) for path in needed if not path.exists()]
    require(not missing, f"{', '.join(missing)}: not found; give the --out of a study that has tokens of the robots")
    return open_prepared_data(workspace)


def choose_robots(
    run: Path, model: Model, prepared: PreparedData, robots: Sequence[str], windows: int, out: Path
) -> tuple[list[str], dict[str, str]]:
    """(the robots to check, {robot left out: why it has too few episodes}) among `robots`, by default among all robots
    with windows in the study in `out`.

    Raises ConfigError if the study does not know a robot, or none is left.
    """
    store, manifest = prepared.store, prepared.manifest
    frozen = [d.dataset for d in manifest.datasets]
    available = [r.name for r in find_robots(run, model.table) if r.name in frozen]
    selected = list(robots) or available
    unknown = [name for name in selected if name not in available]
    require(
        bool(selected) and not unknown,
        f"the study has no windows of {', '.join(unknown) or 'any robot'}; it has windows of {', '.join(available)}",
    )
    shortages = {name: short for name in selected if (short := shortage(store, manifest, name, windows, out))}
    remaining = [name for name in selected if name not in shortages]
    others = f". The same holds for {few(selected[1:])}" if len(selected) > 1 else ""
    require(bool(remaining), f"{shortages.get(selected[0])}{others}")
    return remaining, shortages


def check_run(
    run: Path,
    model: Model,
    prepared: PreparedData,
    robots: Sequence[str],
    windows: int,
) -> dict[str, list[Effect]]:
    """Effects of each robot's dimensions, on this number of held-out windows of each."""
    known = {r.name: r for r in find_robots(run, model.table)}
    loss = jax.jit(make_loss(model.config, model.table, model.run.train.masking.setting, model.execution))
    return {name: _check(model, loss, prepared.store, prepared.manifest, known[name], windows) for name in robots}


def shortage(store: TokenStore, manifest: EvalManifest, robot: str, windows: int, out: Path) -> str | None:
    """Why `windows` windows of a robot come from fewer than MIN_EPISODES episodes, and what to do; None if they do
    not."""
    (frozen,) = (d.windows for d in manifest.datasets if d.dataset == robot)
    judged, of_all = (len({episode for episode, _ in some}) for some in (subsample_windows(frozen, windows), frozen))
    if judged >= MIN_EPISODES:
        return None
    token_manifest = store.manifest(robot)
    held_out, settings = len(token_manifest.val.steps), token_manifest.settings
    if of_all >= MIN_EPISODES:
        why = (
            f"--windows {windows} uses {judged} of the {of_all} episodes that the {len(frozen)} frozen windows come "
            "from; use more windows"
        )
    elif held_out >= MIN_EPISODES:
        why = (
            f"{held_out} are held out, but the {len(frozen)} frozen windows come from {of_all} of them: "
            "eval.windows_per_dataset is too small, or the other episodes are too short. Freeze more with `hma "
            f"tokenize ... {command_words('--out', out)} --set eval.windows_per_dataset=64 --replace windows`"
        )
    elif token_manifest.spec.val_split:
        why = f"Its split {token_manifest.spec.val_split} has {held_out}: remove val_split from its entry"
    else:
        counts = token_manifest.episodes_of_parts
        episodes = sum(counts)
        why = (
            f"{held_out} of {episodes} are held out, by store.min_val={settings.min_val}, "
            f"store.val_fraction={settings.val_fraction:g} and at most "
            f"store.max_val_fraction={settings.max_val_fraction:g}. {_hold_out_more(settings, counts)}"
        )
    return f"{robot} has {judged} held-out episodes with windows, but the check needs at least {MIN_EPISODES}. {why}"


def _hold_out_more(settings: JobSettings, counts: Sequence[int]) -> str:
    """How to hold out MIN_EPISODES, for a dataset with `counts` episodes in its parts."""
    episodes = sum(counts)
    for share, more in ((settings.max_val_fraction, ""), (0.5, " --set store.max_val_fraction=0.5")):
        more_held_out = HeldOut(settings.val_fraction, AT_LEAST, max(AT_LEAST, settings.max_val), share)
        count = sum(map(more_held_out.count, counts))
        if count >= MIN_EPISODES:
            return (
                "To hold out more, tokenise and train again in another --out, with --set "
                f"store.min_val={AT_LEAST}{more} in every command ({count} of {episodes} are then held out)"
            )
    return (
        f"At most half of the {episodes} can be held out, which is fewer than {MIN_EPISODES}: record more, or, if the "
        "dataset has its own validation split, give it in the entry (split and val_split)"
    )


def _check(
    model: Model,
    loss: Callable[..., jax.Array],
    store: TokenStore,
    manifest: EvalManifest,
    robot: Robot,
    windows: int,
) -> list[Effect]:
    batches = list(eval_batches(store, model.table, manifest.subsampled(windows), BATCH, (robot.name,)))
    valid = np.concatenate([batch["valid"] for batch in batches])
    width, chunk = model.table.action_width, robot.stride * robot.action_dim
    flat = np.concatenate([batch["actions"] for batch in batches])[..., :chunk]
    actions = flat.reshape(*flat.shape[:2], robot.stride, robot.action_dim)
    kept = [{key: batch[key] for key in ("tokens", "embodiment", "real") if key in batch} for batch in batches]

    def judge(changed: np.ndarray) -> np.ndarray:
        rows = np.zeros((*changed.shape[:2], width), np.float32)
        rows[..., :chunk] = changed.reshape(*changed.shape[:2], chunk)
        parts = [loss(model.params, batch, rows[i * BATCH : (i + 1) * BATCH]) for i, batch in enumerate(kept)]
        return np.concatenate([np.asarray(part) for part in parts])[valid]

    episode = np.concatenate([batch["episode"] for batch in batches])[valid]
    entry = model.table.entries[model.table.index(robot.name)]
    return find_effects(judge, actions, np.array(entry.mean, np.float32), episode.tolist())


def verdict(effect: Effect, names: Sequence[str]) -> str:
    """In words."""
    change = effect.better
    if change is None:
        return "no effect found" if effect.ignored else "as recorded"
    if change.kind == "negated":
        return "negated"
    if change.kind == "swapped":
        return f"swapped with {names[change.other if change.dimension == effect.dimension else change.dimension]}"
    times, size = (1 / change.factor, "large") if change.factor < 1 else (change.factor, "small")
    return f"about {times:g} times too {size}"


def write_effects(path: Path, found: dict[str, list[Effect]], names: dict[str, Sequence[str]]) -> None:
    """As JSON: per robot and dimension the verdict and the numbers behind it."""
    rows: dict[str, list[dict[str, Any]]] = {
        robot: [
            {"name": names[robot][e.dimension], "verdict": verdict(e, names[robot]), **dataclasses.asdict(e)}
            for e in effects
        ]
        for robot, effects in found.items()
    }
    write_file(path, json.dumps(rows, indent=1))
