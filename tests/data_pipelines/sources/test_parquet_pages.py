"""Sizes that a Parquet file states are looked at before memory is taken for them."""

from __future__ import annotations

import numpy as np
import pytest

from data_pipelines.sources.parquet_pages import MOST_UNPACKED, check_pages

parquet, arrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")


def chunks(path):
    metadata = parquet.read_metadata(path)
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for column in map(group.column, range(group.num_columns)):
            start = min(at for at in (column.dictionary_page_offset, column.data_page_offset) if at)
            yield start, column.total_compressed_size


@pytest.fixture(params=[("NONE", "1.0"), ("snappy", "2.0"), ("zstd", "1.0")], ids=lambda p: p[0])
def table(request, tmp_path):
    columns = {
        "number": np.arange(5000), "text": [f"task {n % 7}" for n in range(5000)], "none": [None] * 5000,
        "list": [[1.0, 2.0]] * 5000, "bytes": [bytes(300)] * 5000, "flag": [True, False] * 2500,
    }  # fmt: skip
    path = tmp_path / "table.parquet"
    compression, version = request.param
    parquet.write_table(
        arrow.table(columns), path, row_group_size=2000, data_page_size=4096,
        compression=compression, data_page_version=version,
    )  # fmt: skip
    return path


def test_sound_files_pass_whatever_their_pages_are(table):
    with table.open("rb") as file:
        assert sum(1 for start, size in chunks(table) if check_pages(file, start, size) is None) == 18


def test_a_page_that_lies_about_its_size_is_refused(table):
    data = bytearray(table.read_bytes())
    start, size = next(chunks(table))
    header = b"\x15\x00\x15\xfe\xff\xff\xff\x0f\x15\x02\x00"  # of kind 0, 2**31 - 1 bytes unpacked, one packed
    data[start : start + len(header)] = header
    table.write_bytes(data)
    with table.open("rb") as file, pytest.raises(ValueError, match=f"{MOST_UNPACKED} are the most"):
        check_pages(file, start, size)


@pytest.mark.parametrize("cut", [1, 2, 5, 9])
def test_a_header_that_is_cut_off_is_refused(table, cut):
    start, _ = next(chunks(table))
    with table.open("rb") as file, pytest.raises(ValueError, match="cut off|reaches out"):
        check_pages(file, start, cut)
