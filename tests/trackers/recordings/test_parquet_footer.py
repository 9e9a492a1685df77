"""Footers of Parquet files that claim what is not there: refused before polars allocates anything by them."""

from __future__ import annotations

import contextlib
import io

import numpy as np
import polars as pl
import pytest

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings import table_file
from trackwright.trackers.recordings.table_file import MARK, read_footer, read_table_file

I32, I64, LIST, STRUCT = 5, 6, 9, 12


def _varint(number):
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes(out) + bytes([number])


def _number(number):
    return _varint(number << 1 if number >= 0 else (-number << 1) - 1)


def _struct(*fields):
    out, last = b"", 0
    for number, kind, content in fields:
        out += bytes([(number - last) << 4 | kind]) + content
        last = number
    return out + b"\0"


def _list(items, size=None):
    return bytes([15 << 4 | STRUCT]) + _varint(len(items) if size is None else size) + b"".join(items)


def _column(values=10, unpacked=80, packed=20):
    own = _struct((5, I64, _number(values)), (6, I64, _number(unpacked)), (7, I64, _number(packed)))
    return _struct((2, I64, _number(4)), (3, STRUCT, own))


def _file(rows=10, columns=None, of_group=None, size=None, groups=1, body=100):
    columns = [_column()] if columns is None else columns
    group = _struct((1, LIST, _list(columns)), (3, I64, _number(rows if of_group is None else of_group)))
    schema = [_struct((5, I32, _number(len(columns)))), *[_struct()] * len(columns)]
    footer = _struct(
        (1, I32, _number(1)),
        (2, LIST, _list(schema, size)),
        (3, I64, _number(rows)),
        (4, LIST, _list([group] * groups)),
    )
    return MARK + bytes(body) + footer + len(footer).to_bytes(4, "little") + MARK


@pytest.fixture
def no_polars(monkeypatch):
    """Whoever reads by the footer fails the test."""

    def read(*_):
        raise AssertionError("polars was asked to read the file")

    monkeypatch.setattr(table_file.pl, "read_parquet", read)


def test_the_claims_of_files_that_polars_writes_are_read():
    frame = pl.DataFrame(
        {
            "t": np.arange(1000.0),
            "id": ["a", None] * 500,
            "pair": [[1.0, 2.0]] * 1000,
            "both": [{"x": 1, "y": "b"}] * 1000,
        }
    )
    written = io.BytesIO()
    frame.write_parquet(written, row_group_size=300)
    found = read_footer(written.getvalue())
    assert found.rows == 1000
    assert found.columns == 5
    assert found.values == 6000
    assert found.unpacked > 8000


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (_file(size=2**40), "damaged"),
        (_file(of_group=9), "10 rows, its parts 9"),
        (_file(rows=-1), "damaged"),
        (_file(columns=[_column(packed=10**6)]), "have 1,000,000 bytes, the file"),
        (_file()[:-8] + (2**31).to_bytes(4, "little") + MARK, "longer than the file"),
        (MARK + b"\x1c" * 5000 + (5000).to_bytes(4, "little") + MARK, "damaged"),
        (MARK + b"\x36" + b"\xff" * 100 + (101).to_bytes(4, "little") + MARK, "damaged"),
        (MARK, "longer than the file"),
        (MARK + MARK, "longer than the file"),
    ],
)
def test_a_lying_footer_is_refused_before_anything_is_allocated(tmp_path, no_polars, data, word):
    path = tmp_path / "ranges.parquet"
    path.write_bytes(data)
    with pytest.raises(UnusableInput, match=rf"ranges.parquet: is a broken Parquet file \(.*{word}"):
        read_table_file(path)


@pytest.mark.parametrize(
    "data",
    [
        _file(10**12, [_column(10**12)]),
        _file(10**9, [_column(10**9)] * 3),
        _file(columns=[_column(unpacked=2**40)]),
        _file(columns=[_column(values=2**60)]),
    ],
)
def test_a_footer_of_more_than_memory_holds_is_refused_by_size(tmp_path, no_polars, data):
    path = tmp_path / "ranges.parquet"
    path.write_bytes(data)
    with pytest.raises(
        UnusableInput, match=r"rows of \d columns, expected at most 268,435,456 values, 2.1 GB unpacked"
    ):
        read_table_file(path)


def test_a_page_that_claims_fewer_than_no_values_is_refused(tmp_path, no_polars):
    path = tmp_path / "ranges.parquet"
    pl.DataFrame({"t_s": np.random.default_rng(0).normal(size=400)}).write_parquet(path, statistics=False)
    whole, of_page = path.read_bytes(), b"\x2c\x15" + _number(400)
    assert whole.count(of_page) == 1
    path.write_bytes(whole.replace(of_page, b"\x2c\x15" + _number(-400)))
    with pytest.raises(UnusableInput, match="ranges.parquet: is a broken Parquet file"):
        read_table_file(path)


def test_a_file_cut_or_changed_anywhere_is_one_line(tmp_path):
    path = tmp_path / "ranges.parquet"
    pl.DataFrame({"t_s": np.arange(20.0), "tag": ["T"] * 20}).write_parquet(path)
    whole = path.read_bytes()
    for at in range(0, len(whole), 3):
        for changed in (whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :], whole[:at] + whole[at + 1 :]):
            path.write_bytes(changed)
            with contextlib.suppress(UnusableInput):
                read_table_file(path)
