"""`hma check` on few episodes: what took how many, and how to go on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from data_pipelines.windows.evalset import freeze_manifest
from experiments.applications.check import check_run, choose_robots, shortage, verdict
from experiments.cli.check import check
from hma_jax.config import ConfigError, MaskingConfig, TrainConfig
from hma_jax.evaluation.effects import Change, Difference, Effect
from hma_jax.model.embodiments import EmbodimentTable
from tests.data_pipelines.windows.test_evalset import small_store
from tests.experiments.applications.runs import make_run


@pytest.mark.parametrize(
    ("episodes", "min_val", "frozen", "windows", "said"),
    [
        (16, 2, 9, 64, "toy has 2 held-out episodes with windows, but the check needs at least 4. 2 of 16 are held out, by "
                   "store.min_val=2, store.val_fraction=0.05 and at most store.max_val_fraction=0.25. To hold out more, "
                   "tokenise and train again in another --out, with --set store.min_val=8 in every command (4 of 16 are "
                   "then held out)"),
        (9, 8, 9, 64, "--set store.min_val=8 --set store.max_val_fraction=0.5 in every command (4 of 9 are then held "),
        (7, 8, 9, 64, "At most half of the 7 can be held out, which is fewer than 4: record more, or, if the dataset has "),
        (20, 5, 2, 64, "toy has 2 held-out episodes with windows, but the check needs at least 4. 5 are held out, but the "
                   "2 frozen windows come from 2 of them: eval.windows_per_dataset is too small, or the other episodes are "
                   "too short. Freeze more with `hma tokenize ... --out runs/a --set eval.windows_per_dataset=64 --replace "
                   "windows`"),
        (20, 5, 9, 2, "--windows 2 uses 2 of the 5 episodes that the 9 frozen windows come from; use more windows"),
        (20, 5, 25, 4, ""),
        (20, 5, 25, 64, ""),
    ],
)  # fmt: skip
def test_too_few_episodes_are_told_with_what_took_them(episodes, min_val, frozen, windows, said, tmp_path):
    store = small_store(tmp_path, lengths=(20,) * episodes, min_val=min_val)
    manifest = freeze_manifest(store, ("toy",), 4, frozen, 0, rate=2.0)
    found = shortage(store, manifest, "toy", windows, Path("runs/a"))
    assert said in found if said else found is None


def test_robots_of_too_few_episodes_are_left_out_and_the_others_checked(tmp_path):
    for name, count in (("few", 5), ("many", 20), ("none", 4)):
        store = small_store(tmp_path, name, lengths=(8 if name == "none" else 20,) * count, min_val=5)
    manifest = freeze_manifest(store, ("few", "many", "none"), 10, 64, 0, rate=2.0)
    model = SimpleNamespace(table=store.embodiment_table(store.names, rate=2.0))
    prepared = SimpleNamespace(store=store, manifest=manifest)

    def choose(*robots: str) -> tuple[list[str], dict[str, str]]:
        return choose_robots(tmp_path, model, prepared, robots, 64, Path("runs/a"))

    chosen, left_out = choose()
    assert chosen == ["many"] and list(left_out) == ["few", "none"]
    assert left_out["few"].startswith("few has 1 held-out episodes") and left_out["none"].startswith(
        "none has 0 held-out episodes"
    )
    assert choose("many", "few") == (["many"], {"few": left_out["few"]})
    with pytest.raises(ConfigError, match=r"^few has 1 held-out episodes .*\. The same holds for none$"):
        choose("few", "none")
    with pytest.raises(ConfigError, match="no windows of other; it has windows of few, many, none"):
        choose("many", "other")


def test_what_the_model_may_have_been_trained_on_is_told(tmp_path, monkeypatch, capsys):
    """Tokens of which more is held out than of those that it was trained on."""
    own, here = (small_store(tmp_path / f"{n}", lengths=(20,) * 20, min_val=n) for n in (4, 5))
    assert set(own.manifest("toy").train.episodes) & set(here.manifest("toy").val.episodes)
    provenance = {"loader": {"datasets": ["toy"]}, "store": own.hash(["toy"])}
    model = SimpleNamespace(
        table=own.embodiment_table(("toy",), rate=2.0), run=SimpleNamespace(provenance=provenance, train=TrainConfig())
    )
    monkeypatch.setattr("hma_jax.training.runs.load_model", lambda run: model)
    monkeypatch.setattr("experiments.cli.evaluate.check_fits", lambda trained, prepared: None)
    monkeypatch.setattr("experiments.applications.check.check_run", lambda *_: {})
    for store, told in ((own, False), (here, True)):
        prepared = SimpleNamespace(store=store, manifest=freeze_manifest(store, ("toy",), 4, 64, 0, rate=2.0))
        monkeypatch.setattr("experiments.applications.check.open_study", lambda _, found=prepared: found)
        check(tmp_path, tmp_path)
        said = " ".join(capsys.readouterr().out.split())
        assert ("toy: the model, or the one that it was initialised from, was trained on other tokens" in said) == told


def test_a_policy_has_no_frames_to_be_judged(tmp_path):
    policy = make_run(tmp_path, TrainConfig(masking=MaskingConfig(setting="policy")))
    with pytest.raises(
        ConfigError, match="'policy', which predicts no frames, so there are none to judge. .*`hma evaluate`"
    ):
        check(policy)


@pytest.mark.parametrize(("sem", "said"), [(0.034, "no effect found"), (0.004, "as recorded")])
def test_a_dimension_with_too_little_data_is_not_called_ignored(sem, said):
    assert verdict(Effect(0, Difference(0.039, sem, 8), None, None), ["x"]) == said


def test_every_window_is_judged_under_its_own_actions_in_the_order_in_which_they_are_executed(tmp_path, monkeypatch):
    """The fixture's tokens and actions both say (episode, step). Another robot of the model has wider actions."""
    store = small_store(tmp_path, lengths=(20,) * 40, min_val=10)
    (toy,) = store.embodiment_table(("toy",), rate=1.0).entries
    table = EmbodimentTable((replace(toy, name="wide", action_dim=5, mean=(9.0,) * 5, std=(1.0,) * 5), toy))

    def differing(params, batch, rows):
        """Per window: by how much the actions differ from those that its tokens were recorded with."""
        executed = 256 * rows[..., [0, 3]] + rows[..., [1, 4]]  # of the two native steps of a frame
        recorded = batch["tokens"][..., :1] + jnp.arange(2)
        return jnp.abs(executed - recorded).sum((1, 2)) + jnp.abs(rows[..., 6:]).sum((1, 2))

    monkeypatch.setattr("experiments.applications.check.make_loss", lambda *_: differing)
    monkeypatch.setattr("experiments.applications.check.find_effects", lambda *given: given)
    run = SimpleNamespace(train=TrainConfig())
    model = SimpleNamespace(config=None, table=table, run=run, execution=None, params=None)
    prepared = SimpleNamespace(store=store, manifest=freeze_manifest(store, ("toy",), 4, 64, 0, rate=1.0))
    judge, actions, mean, episode = check_run(tmp_path, model, prepared, ["toy"], 64)["toy"]
    ((_, frozen),) = ((d.dataset, d.windows) for d in prepared.manifest.datasets)
    assert episode == [store.manifest("toy").val.episodes[i] for i, _ in frozen] and len(frozen) > 16  # two batches
    assert actions.shape[1:] == (4, 2, 3)
    np.testing.assert_allclose(mean, toy.mean, rtol=1e-6)
    assert judge(actions).tolist() == [0] * len(frozen)
    assert judge(actions + np.array([0, 1, 0], np.float32)).tolist() == [4 * 2] * len(frozen)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (Change(0, "negated"), ["negated"]),
        (Change(0, "scaled", 10.0), ["about 10 times too small"]),  # the frames fit ten times what was given
        (Change(0, "scaled", 1 / 3), ["about 3 times too large"]),
        (Change(0, "swapped", other=1), ["swapped with y", "swapped with x"]),
    ],
)
def test_a_verdict_says_what_is_wrong_with_the_actions(change, said):
    sure = Difference(-1.0, 0.1, 8)
    assert [verdict(Effect(d, sure, change, sure), ["x", "y"]) for d in change.dimensions] == said
