"""Sizes that a Parquet file states are looked at before memory is taken for them."""

from __future__ import annotations

import numpy as np
import pyarrow as arrow
import pytest
from pyarrow import parquet

from data_pipelines.sources import parquet_pages
from data_pipelines.sources.parquet_pages import MAX_UNCOMPRESSED, check_pages, read_groups


def first_page(path) -> int:
    column = parquet.read_metadata(path).row_group(0).column(0)
    return min(at for at in (column.dictionary_page_offset, column.data_page_offset) if at)


def check(path):
    with path.open("rb") as file:
        columns = [column for group in read_groups(file) for column in group.columns.values()]
        check_pages(file, [chunk for column in columns for chunk in column])


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
    check(table)


def test_every_page_is_looked_at(table):
    """Each header that is made unreadable is missed."""
    metadata, data = parquet.read_metadata(table), table.read_bytes()
    assert metadata.num_row_groups == 3
    for group in map(metadata.row_group, range(3)):
        for column in map(group.column, range(group.num_columns)):
            for at in (column.dictionary_page_offset, column.data_page_offset):
                if at:
                    table.write_bytes(data[:at] + b"\x1d" + data[at + 1 :])  # a field of kind 13
                    with pytest.raises(ValueError, match="kind of field, 13"):
                        check(table)


def test_a_page_that_lies_about_its_size_is_refused(table):
    data, start = bytearray(table.read_bytes()), first_page(table)
    header = b"\x15\x00\x15\xfe\xff\xff\xff\x0f\x15\x02\x00"  # of kind 0, 2**31 - 1 bytes unpacked, one packed
    data[start : start + len(header)] = header
    table.write_bytes(data)
    with pytest.raises(ValueError, match=f"{MAX_UNCOMPRESSED} is the largest size"):
        check(table)


def test_a_page_of_many_images_is_as_large_as_they_are(tmp_path, monkeypatch):
    """Writers end a page after a thousand rows, whatever is in them."""
    monkeypatch.setattr(parquet_pages, "MAX_UNCOMPRESSED", 2**15)
    random = np.random.default_rng(0)
    parquet.write_table(arrow.table({"image": [random.bytes(2000) for _ in range(100)]}), tmp_path / "images.parquet")
    check(tmp_path / "images.parquet")
    zeros = arrow.table({"image": [bytes(2000)] * 100})
    parquet.write_table(zeros, tmp_path / "zeros.parquet", compression="zstd", use_dictionary=False)
    with pytest.raises(ValueError, match="is the largest size"):
        check(tmp_path / "zeros.parquet")


def test_a_page_that_reaches_out_of_its_column_is_refused(table):
    data, start = bytearray(table.read_bytes()), first_page(table)
    header = b"\x15\x00\x15\x02\x15\xfe\xff\xff\xff\x0f\x00"  # one byte unpacked, 2**31 - 1 packed
    data[start : start + len(header)] = header
    table.write_bytes(data)
    with pytest.raises(ValueError, match="reaches beyond"):
        check(table)


@pytest.mark.parametrize("kept", [0, 3, 8, 11, 12, 100])
def test_a_file_that_is_cut_off_is_refused(table, kept):
    table.write_bytes(table.read_bytes()[:kept])
    with pytest.raises(ValueError, match="does not end like"):
        check(table)


def test_a_footer_that_would_be_read_for_ever_is_refused(table):
    nested = b"\x1c" * 100
    table.write_bytes(b"PAR1" + nested + len(nested).to_bytes(4, "little") + b"PAR1")
    with pytest.raises(ValueError, match="nested too deeply$"):
        check(table)
