"""Reader of one table file, CSV or Parquet: its raw columns, and the location of each row for messages.

Columns of CSV are text, of Parquet typed; `trackers.recordings.tables` checks and converts them.
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

import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.input_file import file_bytes, unpacked

SUFFIXES = (".csv", ".csv.gz", ".parquet")
_one_at_a_time = threading.Lock()  # the error stream belongs to the whole process
_GZIP_MAGIC = b"\x1f\x8b"
MARK = b"PAR1"

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
    """The columns of a Parquet file; raises UnusableInput for a broken file."""
    data = _content(path)
    if not data.startswith(MARK) or not data.endswith(MARK):
        raise UnusableInput(f"{path}: is not a complete Parquet file (start or end mark missing); write it again")
    try:
        with _native_code_silenced():
            return pl.read_parquet(io.BytesIO(data))
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, ValueError) as error:
        raise UnusableInput(f"{path}: is a broken Parquet file ({str(error)[:100]}); write it again") from error


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
