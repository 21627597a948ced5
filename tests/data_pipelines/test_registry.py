from __future__ import annotations

import pytest

from data_pipelines.registry import DatasetSpec, all_specs, get_spec
from data_pipelines.rlds import RldsDataset
from data_pipelines.suite.embodiments import EMBODIMENTS
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import REAL_DATA


def test_real_dataset_matches_its_entry():
    spec = get_spec("bridge_dataset")
    RldsDataset(REAL_DATA).check_keys(spec.image_key, spec.action_keys, spec.action_dims)
    assert (spec.stride, spec.action_dim) == (2, 7)


def test_every_embodiment_of_the_suite_is_registered():
    for e in EMBODIMENTS:
        spec = get_spec(e.name)
        assert (spec.hz, spec.action_dim) == (e.hz, e.action_dim)
        assert spec.image_key == f"observation/{e.cameras[0].key}"
        assert all(key.startswith("action/") for key in spec.action_keys) == e.dict_actions
    assert len({s.name for s in all_specs()}) == len(all_specs()) > 40


@pytest.mark.parametrize(
    "hz, stride", [(0.5, 1), (1, 1), (2, 1), (3, 2), (4, 2), (5, 2), (10, 5), (15, 8), (20, 10), (30, 15)]
)
def test_stride_brings_the_rate_next_to_2_hz(hz, stride):
    assert DatasetSpec("x", "observation/image", ("action",), (1,), hz).stride == stride


def test_unknown_name_suggests_the_closest():
    with pytest.raises(ConfigError, match="unknown dataset 'bridge_datset'; did you mean bridge_dataset"):
        get_spec("bridge_datset")
    with pytest.raises(ConfigError, match="known: bridge_dataset"):
        get_spec("zzzzz")
