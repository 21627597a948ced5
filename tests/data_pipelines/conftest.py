from __future__ import annotations

import pytest

from data_pipelines.tokens.store import TokenStore
from tests.data_pipelines.fakes import FakeLatents, FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

SPECS = {
    # native Hz 4, 2 and 10: strides 2, 1 and 5; very unequal sizes
    "arm": (make_spec("arm", (3,), hz=4), [30] * 40),
    "base": (make_spec("base", (2,), hz=2), [20] * 12),
    "hand": (make_spec("hand", (2, 1, 3), hz=10), [60, 61, 62, 63]),
}


@pytest.fixture(scope="session")
def rlds(tmp_path_factory):
    """Three datasets with actions of 3, 2 and 2 + 1 + 3 values."""
    root = tmp_path_factory.mktemp("rlds")
    return {spec: write_rlds(root, spec, lengths) for spec, lengths in SPECS.values()}


@pytest.fixture(scope="session")
def store_root(rlds, tmp_path_factory):
    root = tmp_path_factory.mktemp("store")
    for spec, directory in rlds.items():
        tokenize_dataset(spec, directory, FakeTokenizer(), root)
    return root


@pytest.fixture(scope="session")
def store(store_root):
    return TokenStore(store_root)


@pytest.fixture(scope="session")
def latent_store(rlds, tmp_path_factory):
    """The same datasets as latents."""
    root = tmp_path_factory.mktemp("latents")
    for spec, directory in rlds.items():
        tokenize_dataset(spec, directory, FakeLatents(), root)
    return TokenStore(root)


@pytest.fixture(scope="session")
def table(store):
    return store.embodiment_table(store.names, rate=2.0)
