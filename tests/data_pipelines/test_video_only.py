"""Datasets without actions, and those whose video is no target, beside ordinary ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from data_pipelines.loading.loader import make_loader
from data_pipelines.loading.selection import LoaderConfig
from data_pipelines.tokens.store import TokenStore
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset


def test_a_dataset_read_without_its_actions_is_video_alone(tmp_path: Path):
    robot, film = make_spec("robot"), make_spec("film")
    store_root = tmp_path / "store"
    for spec in (robot, film):
        directory = write_rlds(tmp_path, spec, [12] * 4)
        read_as = replace(spec, action_keys=(), action_dims=()) if spec is film else spec
        tokenize_dataset(read_as, directory, FakeTokenizer(), store_root, min_val=1)
    store = TokenStore(store_root)
    table = store.embodiment_table(("robot", "film"), rate=2.0)
    assert [e.chunk for e in table.entries] == [6, 0]
    batch = next(make_loader(store, table, LoaderConfig(frames=3, batch=16, datasets=("robot", "film"))))
    of_film = batch["embodiment"] == 1
    assert of_film.any() and not batch["actions"][of_film].any()
    assert np.abs(batch["actions"][~of_film]).sum() > 0


def test_a_dataset_may_be_shown_without_being_predicted(tmp_path: Path):
    spec = replace(make_spec("blind"), video_targets=False)
    directory = write_rlds(tmp_path, spec, [12] * 3)
    tokenize_dataset(spec, directory, FakeTokenizer(), tmp_path / "store", min_val=1)
    (entry,) = TokenStore(tmp_path / "store").embodiment_table(("blind",), rate=2.0).entries
    assert not entry.video_targets
