"""From nothing to materials on latents (`test_whole_study` does the same and more on ids)."""

import itertools

import numpy as np

from data_pipelines.loading.loader import make_loader
from data_pipelines.loading.selection import LoaderConfig
from data_pipelines.windows.evalset import eval_batches
from experiments.preparing.pipeline import prepare
from experiments.presets import get_preset
from experiments.running.trial import open_materials
from experiments.running.workspace import Workspace
from experiments.study import override


def test_prepared_batches_hold_the_tokens_that_the_model_takes(tmp_path):
    study = override(get_preset("smoke-continuous"), ["dataset_counts=1"])
    workspace, model = Workspace(tmp_path), study.model
    prepare(study, workspace)
    materials = open_materials(workspace)
    store = materials.store
    table = store.embodiment_table(study.dataset_names())
    loader = make_loader(store, table, LoaderConfig(frames=model.frames, batch=2))
    (train,) = itertools.islice(loader, 1)
    validation = next(eval_batches(store, table, materials.manifest, 2))
    for tokens in (train["tokens"], validation["tokens"]):
        assert tokens.dtype == np.float32
        assert tokens.shape == (2, model.frames, model.tokens, model.diffusion.token_channels)
    assert materials.tokenizer.decode(validation["tokens"][0]).shape == validation["images"][0].shape
