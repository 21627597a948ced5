"""From nothing to materials on latents (`test_whole_study` does the same and more on ids)."""

import itertools

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.loading.loader import make_loader
from data_pipelines.loading.selection import LoaderConfig
from data_pipelines.suite import counterfactual as simulator
from data_pipelines.windows.evalset import eval_batches
from data_pipelines.windows.other_actions import OtherWindows
from experiments.preparing import counterfactual, windows
from experiments.preparing.pipeline import prepare
from experiments.presets import get_preset
from experiments.running.run_trial import open_prepared_data
from experiments.running.workspace import Workspace
from experiments.user_input.override import override


def test_prepared_batches_hold_the_tokens_that_the_model_takes(tmp_path, monkeypatch):
    """And what the suite's simulator says of other actions, once it has given back what was recorded."""
    study = override(get_preset("smoke-continuous"), ["dataset_counts=1"])
    workspace, model = Workspace(tmp_path), study.model
    monkeypatch.setattr("experiments.preparing.tokenizer.QUALITY_FRAMES", 8)
    prepared = open_prepared_data(workspace, prepare(study, workspace))  # as a trial, which compares them
    store = prepared.store
    table = store.embodiment_table(study.dataset_names(), rate=2.0)
    loader = make_loader(store, table, LoaderConfig(frames=model.frames, batch=2))
    (train,) = itertools.islice(loader, 1)
    validation = next(eval_batches(store, table, prepared.manifest, 2))
    for tokens in (train["tokens"], validation["tokens"]):
        assert tokens.dtype == np.float32
        assert tokens.shape == (2, model.frames, model.tokens, model.diffusion.token_channels)
    assert prepared.tokenizer.decode(validation["tokens"][0]).shape == validation["images"][0].shape

    truth, prompt = prepared.counterfactual, study.eval.prompt_frames
    assert truth.prompt == prompt and set(truth.frames) == set(prepared.manifest.names)
    others = {"other_actions": 3, "prompt": prompt}
    (batch,) = eval_batches(store, table, prepared.manifest, 4, counterfactual=truth, **others)
    rows = np.flatnonzero(batch["valid"])
    assert batch["other_seen"][rows].all()
    np.testing.assert_array_equal(batch["other_images"][:, :prompt], batch["images"][:, :prompt])
    assert (batch["other_images"][rows, -1] != batch["images"][rows, -1]).any((1, 2, 3)).all()
    made = workspace.counterfactual.stat().st_mtime_ns
    counterfactual.make_counterfactual(study, workspace)
    assert workspace.counterfactual.stat().st_mtime_ns == made  # it is there
    workspace.counterfactual.write_bytes(b"torn")
    asked, frames_under = [], simulator.frames_under
    monkeypatch.setattr(simulator, "frames_under", lambda *given: asked.append(given[2:4]) or frames_under(*given))
    counterfactual.make_counterfactual(study, workspace)
    for (recorded, times), (changed, _) in zip(asked[::2], asked[1::2], strict=True):
        for own, other, at in zip(recorded, changed, times, strict=True):
            differ = (own[: len(other)] != other).any(1)
            assert np.argmax(differ) == at[prompt - 1] and differ.any()  # from the last frame of the prompt on
    assert open_prepared_data(workspace).counterfactual.frames.keys() == truth.frames.keys()
    workspace.counterfactual.unlink()
    seed_of = counterfactual._seed_of
    monkeypatch.setattr(counterfactual, "_seed_of", lambda *args: seed_of(*args) + 1)
    with pytest.raises(
        DataError, match="does not reproduce the recorded frames, .* --replace suite makes the suite again"
    ):
        counterfactual.make_counterfactual(study, workspace)
    assert not workspace.counterfactual.exists()

    monkeypatch.undo()
    monkeypatch.setattr(OtherWindows, "choose", lambda *args: [])  # as of episodes that are longer than all others
    counterfactual.make_counterfactual(study, workspace)
    alone = open_prepared_data(workspace).counterfactual
    (batch,) = eval_batches(store, table, prepared.manifest, 4, counterfactual=alone, **others)
    assert not batch["other_seen"].any()

    own = [str(workspace.suite / name) for name in study.dataset_names()]
    prepare(study, workspace, own, replace="tokenizer")  # in place of the suite
    assert open_prepared_data(workspace).counterfactual is None


def test_robots_of_which_a_control_has_no_other_episode_are_named(capsys):
    """Trained on shuffled actions, it was given their own without a word."""
    facts = {
        "bridge_dataset": {"episodes": 3, "too_short": 2, "windows": 1},
        "fractal20220817_data": {"episodes": 3, "too_short": 1, "windows": 2},
        "rover_slate": {"episodes": 1, "too_short": 0, "windows": 9},  # has no actions
        "arm_sand": {"episodes": 2, "too_short": 2, "windows": 0},
    }
    windows.say_alone(facts)
    (line,) = capsys.readouterr().out.splitlines()
    assert (
        "only one training episode has windows: bridge_dataset. A control, trained on shuffled actions, then gets"
        in line
    )
    windows.say_alone({name: facts[name] for name in ("rover_slate", "arm_sand")})
    assert capsys.readouterr().out == ""


def test_what_is_held_out_of_a_small_dataset_is_said_with_what_bounds_it(capsys):
    facts = {"bridge_dataset": {"held_out": 1, "episodes": 1}}
    windows._say_held_out(facts, get_preset("smoke").store)
    said = " ".join(capsys.readouterr().out.split())
    assert "1 of 2 episodes of bridge_dataset" in said and "max_val_fraction=0.25 of a dataset, or one episode" in said
