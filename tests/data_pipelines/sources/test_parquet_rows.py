"""Of a Parquet file no more is read than what is asked for lies in, and little of it is kept."""

from __future__ import annotations

import pickle

import numpy as np
import pyarrow as arrow
import pytest
from pyarrow import parquet

from data_pipelines.errors import DataError
from data_pipelines.sources import parquet_rows
from data_pipelines.sources.parquet_rows import ParquetRows, read_table

ROWS, GROUP = 100, 30
EPISODES = [0] * 45 + [2] * 5 + [1] * 20 + [2] * 30


@pytest.fixture
def path(tmp_path):
    columns = {
        "episode": EPISODES, "number": np.arange(ROWS), "list": [[float(n), 1.0] for n in range(ROWS)],
        "picture.top": [{"bytes": bytes([n]) * 50, "path": None} for n in range(ROWS)],
    }  # fmt: skip
    parquet.write_table(arrow.table(columns), tmp_path / "rows.parquet", row_group_size=GROUP)
    return tmp_path / "rows.parquet"


def spoil(path, column: str, groups=range(4)) -> None:
    """Makes the pages of a column unreadable."""
    data, metadata = bytearray(path.read_bytes()), parquet.read_metadata(path)
    for group in map(metadata.row_group, groups):
        for part in map(group.column, range(group.num_columns)):
            if part.path_in_schema.startswith(column):
                data[part.dictionary_page_offset or part.data_page_offset] = 0x1D
    path.write_bytes(data)


def test_rows_are_those_of_the_whole_table(path):
    whole, rows = parquet.read_table(path), ParquetRows("episode")
    assert rows.columns(path) == ("episode", "number", "list", "picture.top")
    for first, count in [(0, ROWS), (0, 1), (ROWS - 1, 1), (29, 2), (30, 30), (45, 20), (95, 5)]:
        for names in (["picture.top", "number"], ["list"]):
            for reader in (rows, pickle.loads(pickle.dumps(rows))):
                assert reader.read(path, names, first, count).equals(whole.select(names).slice(first, count))


def test_rows_are_found_by_their_label(path):
    rows = ParquetRows("episode")
    assert [rows.find(path, label) for label in range(4)] == [(0, 45), (50, 20), None, None]
    assert ParquetRows("none").find(path, 0) is None


def test_other_groups_and_columns_are_not_read(path):
    spoil(path, "list")
    spoil(path, "picture.top", [0, 1, 3])
    rows = ParquetRows("episode")
    assert rows.read(path, ["number"], 5, 90)["number"].to_pylist() == list(range(5, 95))
    assert rows.read(path, ["picture.top"], 60, 1)["picture.top"][0].as_py()["bytes"] == bytes([60]) * 50
    for first in (59, 90):
        with pytest.raises(DataError, match="rows.parquet: the table cannot be read \\(.*thrift.*\\). Download"):
            rows.read(path, ["picture.top"], first, 2)
    with pytest.raises(DataError, match="thrift"):
        rows.read(path, ["list"], 0, 1)


def test_a_table_of_some_columns_reads_no_other(path):
    """As beside an episode's place in LeRobot's tables stand statistics."""
    spoil(path, "list")
    assert read_table(path, ["number", "absent"]).to_pydict() == {"number": list(range(ROWS))}
    with pytest.raises(DataError, match="thrift"):
        read_table(path, ["number", "list"])


def test_what_was_read_last_is_kept_and_little_else(path, monkeypatch):
    read, original = [], parquet_rows._read_groups
    monkeypatch.setattr(parquet_rows, "_read_groups", lambda p, layout, w: read.append(w) or original(p, layout, w))
    monkeypatch.setattr(parquet_rows, "CACHE_BYTES", 3000)  # the pictures of a group take about 1,700 bytes
    rows = ParquetRows("episode")
    for first in (0, 1, 29):
        rows.read(path, ["picture.top"], first, 1)
    rows.read(path, ["picture.top", "number"], 2, 1)
    assert read == [{0: ["picture.top"]}, {0: ["number"]}]
    for first in range(ROWS):
        rows.read(path, ["picture.top"], first, 1)
    assert read[2:] == [{g: ["picture.top"]} for g in (1, 2, 3)]
    assert rows._cached_bytes == sum(c.nbytes for kept in rows._groups.values() for c in kept.values()) < 3000
    monkeypatch.setattr(parquet_rows, "CACHE_BYTES", 0)
    rows.read(path, ["picture.top"], 0, 1)
    assert list(rows._groups) == [(path, 0)]  # whatever it takes


@pytest.mark.parametrize("compression", ["none", "snappy", "zstd"])
def test_a_page_that_lies_about_its_size_is_refused_in_one_line(path, compression):
    parquet.write_table(parquet.read_table(path), path, compression=compression, use_dictionary=False)
    data, start = bytearray(path.read_bytes()), parquet.read_metadata(path).row_group(0).column(1).data_page_offset
    header = b"\x15\x00\x15\xfe\xff\xff\xff\x0f\x15\x02\x00"  # of kind 0, 2**31 - 1 bytes unpacked, one packed
    data[start : start + len(header)] = header
    path.write_bytes(data)
    with pytest.raises(DataError, match="rows.parquet: the table cannot be read") as raised:
        read_table(path, ["number"])
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kept", [0, 3, 8, 11, 12, 100])
def test_a_file_that_is_cut_off_is_refused(path, kept):
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(DataError, match="rows.parquet: the table cannot be read"):
        ParquetRows("episode").columns(path)


def test_a_footer_of_structs_in_structs_is_refused(path):
    nested = b"\x1c" * 10_000
    path.write_bytes(b"PAR1" + nested + len(nested).to_bytes(4, "little") + b"PAR1")
    with pytest.raises(DataError, match="rows.parquet: the table cannot be read"):
        read_table(path, ["number"])


def test_a_small_file_that_unpacks_to_a_large_one_is_refused(tmp_path, monkeypatch):
    """By what its footer says; a large file may be as large as it is."""
    monkeypatch.setattr(parquet_rows, "MAX_UNPACKED", 2**17)
    random, pictures, zeros = np.random.default_rng(0), tmp_path / "pictures.parquet", tmp_path / "zeros.parquet"
    parquet.write_table(arrow.table({"image": [random.bytes(2000) for _ in range(100)]}), pictures)
    assert len(read_table(pictures, ["image"])) == 100
    table = arrow.table({"image": [bytes(2000)] * 1000})
    parquet.write_table(table, zeros, compression="zstd", use_dictionary=False)
    for read in (lambda: read_table(zeros, ["image"]), lambda: ParquetRows("episode").columns(zeros)):
        with pytest.raises(DataError, match="zeros.parquet: .* bytes unpack to 2,0"):
            read()
