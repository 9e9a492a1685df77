"""Reader of one table file, CSV or Parquet: its raw columns, and the location of each row for messages.

Columns of CSV are text, of Parquet typed; `trackers.recordings.tables` checks and converts them. What the footer
and the pages of a Parquet file claim is compared with the bytes that are there, since polars aborts the process where a
changed byte claims 10¹⁸ values. Both are structures in Thrift's compact protocol; their fields are numbered as in
Apache Parquet's `parquet.thrift`.
"""

from __future__ import annotations

import csv
import errno
import io
import os
import re
import threading
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.input_file import LARGEST, file_bytes, unpacked

SUFFIXES = (".csv", ".csv.gz", ".parquet")
_one_at_a_time = threading.Lock()  # the error stream belongs to the whole process
_CELL = 8  # bytes of a value in memory
_GZIP_MAGIC = b"\x1f\x8b"
MARK = b"PAR1"
_TAIL = 4 + len(MARK)
_SCHEMA, _ROWS, _GROUPS = 2, 3, 4  # fields of the footer, of a group of rows, of a column in it, of the schema
_GROUP_COLUMNS, _GROUP_ROWS = 1, 3
_COLUMN, _VALUES, _UNPACKED, _PACKED = 3, 5, 6, 7
_CHILDREN = 5
_PAGES_AT, _DICTIONARY_AT = 9, 11  # of a column in a group
_PAGE_PACKED, _PAGES, _PAGE_VALUES = 3, (5, 7, 8), 1  # of the header of a page: its data or dictionary


_DATE = re.compile(r"\d{1,4}([-/.])(?:\d{1,2}|[A-Za-z]{3})\1\d{1,4}(?:[T ]|$)")
_CLOCK = re.compile(r"\d{1,2}:\d\d(?::|$)")
_GROUPED = re.compile(r"[-+]?\d{1,3}([,.' ])\d{3}(?:\1\d{3}|[.,]\d)\d*.*|[-+]?\d{1,3}[' ]\d{3}")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")


@dataclass(frozen=True)
class TableFile:
    """The columns of a file before any check.

    `lines`: the line number of each row, None for Parquet. `decimal`, `thousands`: the marks in numbers that are text.
    """

    path: Path
    frame: pl.DataFrame
    lines: Sequence[int] | pl.Series | None = None
    decimal: str = "."
    thousands: str = ""

    def location(self, row: int, column: str) -> str:
        """File, row and column in words, for messages; `row` is counted from 0."""
        line = "" if self.lines is None else f" (line {self.lines[row]})"
        return f"{self.path}: row {row + 1}{line}, column {column}"


def first_row(rows: pl.Series) -> int:
    """The number of the first row that is true, of which there is one."""
    row = rows.arg_max()
    assert row is not None
    return int(row)


def remedy(text: str, column: str) -> str:
    """What to do about a text where a number is expected."""
    if _DATE.match(text) or _CLOCK.match(text):
        order = "iso'" if text[4:5] == "-" else "dd/mm/yyyy', or its own order instead of that"
        what, order = ("time of day", "hh:mm:ss'") if _CLOCK.match(text) else ("date", order)
        return f"it looks like a {what}, which `trackwright import` reads by 't_s={column} in {order}"
    if _DECIMAL_COMMA.fullmatch(text):
        return "it looks like a decimal comma, which `trackwright import --decimal ,` reads"
    if _GROUPED.fullmatch(text):
        mark = text.lstrip("+-0123456789")[0]
        return f"thousands are grouped in it, which `trackwright import --thousands {mark!r}` reads"
    if " " not in text and not any(map(str.isdigit, text)):
        return f"leave a missing cell empty, or name its mark: `trackwright import --missing={text[:20]}`"
    return "leave a missing cell empty"


def read_table_file(path: Path) -> TableFile:
    """The raw columns of a `.csv`, `.csv.gz` or `.parquet` file; raises UnusableInput for a broken or empty file."""
    if path.name.endswith(".parquet"):
        file = TableFile(path, read_parquet(path))
    else:
        file = _text(path, _unpacked(path, _content(path)))
    if file.frame.height == 0:
        raise UnusableInput(f"{path}: the table has no rows, expected at least one; remove the file if there are none")
    return file


def _content(path: Path) -> bytes:
    try:
        data = file_bytes(path)
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); check the file and its permissions") from error
    if not data:
        raise UnusableInput(
            f"{path}: the file is empty, expected a header line and rows; remove the file if there are none"
        )
    return data


def read_parquet(path: Path) -> pl.DataFrame:
    """The columns of a Parquet file; raises UnusableInput for a broken file, and beyond `LARGEST`, by its footer."""
    data = _content(path)
    if not data.startswith(MARK) or not data.endswith(MARK):
        raise UnusableInput(f"{path}: is not a complete Parquet file (start or end mark missing); write it again")
    try:
        footer = read_footer(data)
        if max(footer.rows * footer.columns, footer.values) * _CELL <= LARGEST and footer.unpacked <= LARGEST:
            for part in footer.parts:
                _check_pages(data, part)
            with _native_code_silenced():
                return pl.read_parquet(io.BytesIO(data))
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, ValueError) as error:
        raise UnusableInput(f"{path}: is a broken Parquet file ({str(error)[:100]}); write it again") from error
    raise UnusableInput(
        f"{path}: has {footer.rows:,} rows of {footer.columns} columns, expected at most {LARGEST // _CELL:,} values, "
        f"{LARGEST / 1e9:.1f} GB unpacked; split it"
    )


@contextmanager
def _native_code_silenced() -> Iterator[None]:
    """Discards the error stream of native code: a panic in Rust prints there before it is raised in Python."""
    with _one_at_a_time:
        saved = os.dup(2)
        try:
            with open(os.devnull, "wb") as sink:
                os.dup2(sink.fileno(), 2)
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)


def _unpacked(path: Path, data: bytes) -> bytes:
    if not path.name.endswith(".gz"):
        if data.startswith(_GZIP_MAGIC):
            raise UnusableInput(f"{path}: holds gzip data, expected text; name it {path.name}.gz or unpack it")
        return data
    try:
        return unpacked(path, data)
    except EOFError as error:
        raise UnusableInput(f"{path}: the gzip data end too early, the file is truncated; copy it again") from error
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise UnusableInput(f"{path}: cannot be read ({error.strerror})") from error
        raise UnusableInput(f"{path}: is not valid gzip data ({error}); copy it again or pack it with gzip") from error
    except zlib.error as error:
        raise UnusableInput(f"{path}: is not valid gzip data ({error}); copy it again or pack it with gzip") from error


def _text(path: Path, data: bytes) -> TableFile:
    if b"\0" in data:
        raise UnusableInput(f"{path}: holds binary data, expected CSV text in UTF-8; export it again as CSV")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UnusableInput(
            f"{path}: is not UTF-8 text at byte {error.start}, expected CSV text; export it again as CSV in UTF-8"
        ) from error
    text = text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text
    head, _, body = text.partition("\n")
    names = [name.strip() for name in next(csv.reader([head]), [])]
    if len(names) == 1 and (head.startswith("#") or any(mark in head for mark in ";\t")):
        raise UnusableInput(f"{path}: line 1 is {head[:60]!r}, expected names separated by commas; export it again")
    repeated = {name for name in names if names.count(name) > 1}
    if repeated:
        raise UnusableInput(f"{path}: column {min(repeated)!r} is duplicated in line 1, expected once; remove one")
    body = body.rstrip("\n")
    if not body.strip():
        return TableFile(path, pl.DataFrame(schema=dict.fromkeys(names, pl.String)), ())
    rows = body.count("\n") + 1
    plain = '"' not in text and "\n\n" not in body and not body.startswith("\n")
    if plain and body.count(",") == (len(names) - 1) * rows:
        try:
            frame = pl.read_csv(
                body.encode(), has_header=False, schema=dict.fromkeys(names, pl.String), quote_char=None
            )  # fmt: skip
            if frame.height == rows:
                return TableFile(path, frame, range(2, rows + 2))
        except pl.exceptions.PolarsError:
            pass  # rows too long and too short in equal measure: the slow reader names the first
    return _row_by_row(path, names, text)


def _row_by_row(path: Path, names: list[str], text: str) -> TableFile:
    """Slow reader for quotes and blank lines; refuses rows of a wrong length by their line."""
    reader = csv.reader(io.StringIO(text))
    rows, lines = [], []
    try:
        next(reader)
        before = reader.line_num
        for row in reader:
            begun, before = before + 1, reader.line_num
            if len(row) == len(names):
                rows.append(row)
                lines.append(reader.line_num)
            elif reader.line_num > begun:
                raise UnusableInput(
                    f"{path}: row {len(rows) + 1} (line {begun}) has a quote that is not closed up to line "
                    f"{reader.line_num}; close or remove it"
                )
            elif any(cell.strip() for cell in row):
                raise UnusableInput(
                    f"{path}: row {len(rows) + 1} (line {reader.line_num}) has {len(row)} cell{'s'[: len(row) != 1]}, "
                    f"expected {len(names)} as in the header; look for a truncated file or decimal commas"
                )
    except csv.Error as error:
        raise UnusableInput(f"{path}: line {reader.line_num} is not CSV ({error}); check the quotes") from error
    return TableFile(path, pl.DataFrame(rows, schema=dict.fromkeys(names, pl.String), orient="row"), lines)


class Footer(NamedTuple):
    """Rows, columns, values of all columns, and their bytes unpacked; `parts`: each column in each group of rows."""

    rows: int
    columns: int
    values: int
    unpacked: int
    parts: list[dict[int, Any]]


def read_footer(data: bytes) -> Footer:
    """The claims of the footer of a Parquet file.

    Raises ValueError where it is cut short, or contradicts itself or the size of the file.
    """
    size = int.from_bytes(data[-_TAIL : -len(MARK)], "little")
    if size > len(data) - len(MARK) - _TAIL:
        raise ValueError("its footer is longer than the file")
    try:
        content = _Compact(data[len(data) - _TAIL - size : -_TAIL]).struct()
        rows = _count(content, _ROWS)
        groups = [(_count(group, _GROUP_ROWS), group[_GROUP_COLUMNS]) for group in content.get(_GROUPS, [])]
        columns = sum(_CHILDREN not in element for element in content[_SCHEMA])
        chunks = [chunk[_COLUMN] for _, group_columns in groups for chunk in group_columns]
        values, unpacked, packed = (sum(_count(c, field) for c in chunks) for field in (_VALUES, _UNPACKED, _PACKED))
    except (LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError("its footer is damaged") from error
    if rows != sum(group_rows for group_rows, _ in groups):
        raise ValueError(f"its footer has {rows:,} rows, its parts {sum(group_rows for group_rows, _ in groups):,}")
    if packed > len(data):
        raise ValueError(f"its columns have {packed:,} bytes, the file {len(data):,}")
    return Footer(rows, columns, values, unpacked, chunks)


def _check_pages(data: bytes, column: dict[int, Any]) -> None:
    """Raises ValueError where the pages of a column, in a group of rows, claim more values than it has."""
    try:
        at, first = _count(column, _PAGES_AT), column.get(_DICTIONARY_AT, 0)
        at = first if 0 < first < at else at
        values, end = _count(column, _VALUES), at + _count(column, _PACKED)
        while at < end:
            reader = _Compact(memoryview(data)[at:end])
            header = reader.struct()
            if any(_count(header[page], _PAGE_VALUES) > values for page in _PAGES if page in header):
                raise ValueError("its pages are damaged")
            at += reader.at + _count(header, _PAGE_PACKED)
    except (LookupError, TypeError, RecursionError) as error:
        raise ValueError("its pages are damaged") from error


def _count(struct: dict[int, Any], field: int) -> int:
    number = struct[field]
    if not isinstance(number, int) or number < 0:
        raise ValueError("its footer is damaged")
    return number


class _Compact:
    """A reader of Thrift's compact protocol; structures are dictionaries by the number of the field.

    Raises LookupError beyond the end, and for the types that no footer has. A list cannot claim more elements than
    there are bytes.
    """

    def __init__(self, data: bytes | memoryview) -> None:
        self.data, self.at = data, 0

    def struct(self) -> dict[int, Any]:
        fields: dict[int, Any] = {}
        field = 0
        while head := self.byte():
            field = field + (head >> 4) if head >> 4 else self.integer()
            kind = head & 15
            # A field that is true or false has its value in its type.
            fields[field] = kind == 1 if kind in (1, 2) else self.value(kind)
        return fields

    def value(self, kind: int) -> Any:
        match kind:
            case 1 | 2 | 3:
                return self.byte()
            case 4 | 5 | 6:
                return self.integer()
            case 7:
                return self.taken(8)
            case 8:
                return self.taken(self.varint())
            case 9:
                head = self.byte()
                size = self.varint() if head >> 4 == 15 else head >> 4
                if size > len(self.data) - self.at:
                    raise LookupError
                return [self.value(head & 15) for _ in range(size)]
            case 12:
                return self.struct()
        raise LookupError

    def integer(self) -> int:
        value = self.varint()
        return (value >> 1) ^ -(value & 1)

    def varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self.byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise LookupError

    def byte(self) -> int:
        self.at += 1
        return self.data[self.at - 1]

    def taken(self, size: int) -> bytes | memoryview:
        if size > len(self.data) - self.at:
            raise LookupError
        self.at += size
        return self.data[self.at - size : self.at]
