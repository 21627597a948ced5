from __future__ import annotations

import pytest

from data_pipelines.store import TokenStore
from data_pipelines.tokenize_job import tokenize_dataset
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds

SPECS = {
    # native Hz 4, 2 and 10: strides 2, 1 and 5; very unequal sizes
    "arm": (make_spec("arm", (3,), hz=4), [30] * 40),
    "base": (make_spec("base", (2,), hz=2), [20] * 12),
    "hand": (make_spec("hand", (2, 1, 3), hz=10), [60, 61, 62, 63]),
}


@pytest.fixture(scope="session")
def store_root(tmp_path_factory):
    """A token store of three datasets with actions of 3, 2 and 2 + 1 + 3 values."""
    root = tmp_path_factory.mktemp("data")
    for spec, lengths in SPECS.values():
        tokenize_dataset(spec, write_rlds(root / "rlds", spec, lengths), FakeTokenizer(), root / "store")
    return root / "store"


@pytest.fixture(scope="session")
def store(store_root):
    return TokenStore(store_root)


@pytest.fixture(scope="session")
def table(store):
    return store.embodiment_table(store.names)
