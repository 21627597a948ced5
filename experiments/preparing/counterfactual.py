"""Simulates the counterfactual frames of the suite's frozen windows (`data_pipelines.windows.counterfactual`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.errors import DataError
from experiments.running.workspace import Workspace
from experiments.study import Study
from experiments.terminal.progress import step

if TYPE_CHECKING:
    from data_pipelines.suite.spec import EmbodimentSpec
    from data_pipelines.tokens.store import TokenStore
    from data_pipelines.windows.evalset import DatasetWindows
    from data_pipelines.windows.other_actions import OtherWindows
    from data_pipelines.windows.slicer import WindowSlicer


def make_counterfactual(study: Study, workspace: Workspace) -> None:
    """Simulates the frames, unless they exist for these windows and this prompt.

    Robots whose dataset does not say their actions have none. Raises DataError if the simulator, under the recorded
    actions, does not reproduce the recording.
    """
    from data_pipelines.suite.embodiments import select
    from data_pipelines.tokens.store import TokenStore
    from data_pipelines.windows.counterfactual import CounterfactualFrames
    from data_pipelines.windows.evalset import EvalManifest
    from data_pipelines.windows.other_actions import OtherWindows
    from data_pipelines.windows.slicer import make_slicer

    store, manifest = TokenStore(workspace.store), EvalManifest.load(workspace.manifest)
    prompt = study.eval.prompt_frames
    if workspace.counterfactual.exists():
        try:
            existing = CounterfactualFrames.load(workspace.counterfactual)
            if (existing.manifest, existing.prompt) == (manifest.hash(), prompt):
                return
        except DataError:  # it follows from what is here, so it is made again
            pass
    slicers = {name: make_slicer(store, name, manifest.frames, manifest.rate) for name in manifest.names}
    others = OtherWindows(store, slicers, manifest.frames, manifest.rate, manifest.seed)
    chosen = [d for d in manifest.datasets if d.windows and store.manifest(d.dataset).spec.action_dim]
    frames = {}
    with step(f"simulate {sum(len(d.windows) for d in chosen)} windows under other actions") as update:
        for i, dataset in enumerate(chosen):
            (spec,) = select([dataset.dataset])
            frames[dataset.dataset] = _of_robot(spec, store, slicers[dataset.dataset], others, dataset, prompt, study)
            update(i + 1, len(chosen), dataset.dataset)
    CounterfactualFrames(manifest.hash(), prompt, frames).save(workspace.counterfactual)


def _of_robot(
    spec: EmbodimentSpec,
    store: TokenStore,
    slicer: WindowSlicer,
    others: OtherWindows,
    dataset: DatasetWindows,
    prompt: int,
    study: Study,
) -> np.ndarray:
    """Frames uint8 [windows, T - prompt, H, W, 3]; after the last real frame, zeros. A window that no other episode's
    actions cover, such as one of the longest episode, has the recorded frames, which are not used."""
    from data_pipelines.suite.counterfactual import frames_under

    name, size = spec.name, study.tokenizer.image_size
    own, changed, seeds, images = [], [], [], []
    times, real = np.zeros((len(dataset.windows), slicer.frames), np.int64), []
    for row, (episode, start) in enumerate(dataset.windows):
        item, first = store.episode(name, "val", episode), start * slicer.frame_step
        frames = slicer.count_real(item, start)
        until, end = (prompt - 1) * slicer.stride, (frames - 1) * slicer.stride
        own.append(item.actions)
        changed.append(item.actions)
        for other in others.choose(name, episode, start, 1):
            other_actions, other_start = (
                store.episode(name, other.split, other.episode).actions,
                other.start * slicer.frame_step,
            )
            changed[-1] = np.concatenate(
                [item.actions[: first + until], other_actions[other_start + until : other_start + end]]
            )
        times[row] = first + np.minimum(np.arange(slicer.frames), frames - 1) * slicer.stride
        real.append(frames)
        seeds.append(_seed_of(store, spec, item.episode, study.suite.seed))
        images.append(slicer.slice_frames(item.frames, item, start))
    valid = np.arange(slicer.frames) < np.asarray(real)[:, None]
    recorded = frames_under(spec, seeds, own, times, size) * valid[..., None, None, None]
    if not np.array_equal(recorded, np.stack(images)):
        raise DataError(
            f"{name}: with the recorded actions, the simulator does not reproduce the recorded frames, because the "
            "suite was made by another version of it. --replace suite makes the suite again, and everything that "
            "depends on it."
        )
    seen = frames_under(spec, seeds, changed, times, size) * valid[..., None, None, None]
    return seen[:, prompt:].astype(np.uint8)


def _seed_of(store: TokenStore, spec: EmbodimentSpec, number: int, seed: int) -> int:
    """The seed of a held-out episode by its number in the source."""
    from data_pipelines.suite.rollout import episode_seeds

    before: dict[str, int] = {}
    for run in store.manifest(spec.name).runs:
        if number < run.count:
            place = before.get(run.split, 0) + number
            return int(episode_seeds(spec, place + 1, seed, run.split)[place])
        number -= run.count
        before[run.split] = before.get(run.split, 0) + run.count
    raise IndexError(number)
