"""Files that stay open between reads."""

from __future__ import annotations

import pickle

import pytest

from data_pipelines.errors import DataError
from data_pipelines.sources.rlds.location import OpenFiles
from tests.data_pipelines.fakes import count_open


@pytest.fixture
def paths(tmp_path):
    made = [tmp_path / str(i) for i in range(4)]
    for i, path in enumerate(made):
        path.write_bytes(bytes([i]) * 10)
    return made


def test_no_more_files_than_the_limit_stay_open(tmp_path, paths):
    files = OpenFiles(2)
    for path in [*paths, *paths]:
        assert files.get(path).read(9, 5) == path.read_bytes()[9:]
        assert count_open(tmp_path) <= 2
    assert files.get(paths[3]) is files.get(paths[3])
    del files
    assert count_open(tmp_path) == 0


def test_file_that_gives_way_can_be_read_by_who_holds_it(tmp_path, paths):
    files = OpenFiles(1)
    held = files.get(paths[0])
    files.get(paths[1])
    assert count_open(tmp_path) == 2 and held.read(0, 1) == b"\0" and held.size == 10
    del held
    assert count_open(tmp_path) == 1


def test_open_files_travel_to_another_process_as_their_limit(tmp_path, paths):
    files = OpenFiles(1)
    files.get(paths[0])
    copy = pickle.loads(pickle.dumps(files))
    assert count_open(tmp_path) == 1
    for path in paths:
        copy.get(path)
    assert count_open(tmp_path) == 2


def test_missing_file_is_named_and_found_when_it_is_there(tmp_path):
    files, path = OpenFiles(), tmp_path / "late"
    with pytest.raises(DataError, match="late: the shard is missing"):
        files.get(path)
    path.write_bytes(b"x")
    assert files.get(path).read(0, 1) == b"x"
