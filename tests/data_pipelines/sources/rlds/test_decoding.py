"""Decoding equals tfds's, on every feature; `verify_decoding` does the same to any directory."""

from __future__ import annotations

import numpy as np
import pytest

from data_pipelines.sources.rlds import example
from data_pipelines.suite import generate_suite
from tests.data_pipelines.fakes import REAL_DATA
from tests.data_pipelines.sources.rlds import decoding
from tests.data_pipelines.sources.rlds.decoding import compare_directory
from tests.data_pipelines.sources.rlds.verify_decoding import main

SUITE = ("pusher_sand", "rover_road")


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    """Two datasets of the embedded suite, one with a dict-valued action where there is one."""
    from data_pipelines.suite.embodiments import EMBODIMENTS

    names = [*SUITE, next(e.name for e in EMBODIMENTS if e.dict_actions)]
    return generate_suite(tmp_path_factory.mktemp("suite"), scale=0.01, seed=0, validation=2, names=names, workers=1)


def test_real_records_equal_tfds_on_every_feature():
    tally = compare_directory(REAL_DATA / "1.0.0")
    assert not tally.differences
    assert tally.records == 3 and tally.stored == 30
    assert {"steps/action", "steps/observation/state", "steps/language_instruction"} <= tally.features


def test_suite_records_equal_tfds_on_every_feature(suite):
    for directory in suite:
        tally = compare_directory(directory)
        assert not tally.differences
        assert tally.records >= 8 and tally.stored > 100 and len(tally.features) >= 12


def test_a_parser_that_misreads_is_noticed(monkeypatch):
    """One number, one picture and one missing field, each reported by name."""

    def misread(payload):
        found = dict(example.parse_example(payload))
        found["steps/action"] = np.array(found["steps/action"])
        found["steps/action"][3] += 1e-6
        found["steps/observation/image_0"] = found["steps/observation/image_0"][::-1]
        del found["steps/is_last"]
        return found

    monkeypatch.setattr(decoding, "parse_example", misread)
    differences = " ".join(compare_directory(REAL_DATA / "1.0.0").differences)
    for words in ("steps/action differs", "image_0 differs", "steps/is_last is in their reading only"):
        assert words in differences


def test_command_reports_every_dataset_of_a_folder(capsys):
    assert main([str(REAL_DATA.parent)]) == 0
    said = capsys.readouterr().out
    assert "bridge_dataset/1.0.0: 3 records" in said and "all: 3 records" in said and "0 differences" in said
