"""The cells of one table file, as they stand in it: text from CSV, typed columns from Parquet, and where each row is.

What the columns mean is the business of `trackers.recordings.tables`.
"""

from __future__ import annotations

import csv
import gzip
import io
import os
import threading
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from trackers.core.errors import UnusableInput

SUFFIXES = (".csv", ".csv.gz", ".parquet")
_one_at_a_time = threading.Lock()
_GZIP_MAGIC, _PARQUET_MAGIC = b"\x1f\x8b", b"PAR1"


@dataclass(frozen=True)
class Cells:
    """A file's columns before they are checked, with the line each row stands on where the file has lines."""

    path: Path
    frame: pl.DataFrame
    lines: Sequence[int] | None = None

    def place(self, row: int, column: str) -> str:
        """File, row and column in words, for messages; `row` counts from 0."""
        line = "" if self.lines is None else f" (line {self.lines[row]})"
        return f"{self.path}: row {row + 1}{line}, column {column}"


def read_cells(path: Path) -> Cells:
    """The cells of a `.csv`, `.csv.gz` or `.parquet` file; raises UnusableInput where the file itself is broken."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); check the file and its permissions") from error
    if not data:
        raise UnusableInput(f"{path}: the file is empty, expected a header line and rows; remove it if there are none")
    cells = _parquet(path, data) if path.name.endswith(".parquet") else _text(path, _unpacked(path, data))
    if cells.frame.height == 0:
        raise UnusableInput(f"{path}: the table has no rows, expected at least one; remove the file if there are none")
    return cells


def _parquet(path: Path, data: bytes) -> Cells:
    if not data.startswith(_PARQUET_MAGIC) or not data.endswith(_PARQUET_MAGIC):
        raise UnusableInput(f"{path}: is not a complete Parquet file (marks at start and end missing); write it again")
    try:
        with _native_code_silenced():
            return Cells(path, pl.read_parquet(io.BytesIO(data)))
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, ValueError) as error:
        raise UnusableInput(f"{path}: is a broken Parquet file ({str(error)[:100]}); write it again") from error


@contextmanager
def _native_code_silenced() -> Iterator[None]:
    """Keeps what native code writes to the error stream away: a panic prints there before it is raised in Python."""
    with _one_at_a_time:
        saved = os.dup(2)
        try:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)
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
        return gzip.decompress(data)
    except EOFError as error:
        raise UnusableInput(f"{path}: the gzip data end too early, the file is truncated; copy it again") from error
    except (OSError, zlib.error) as error:
        raise UnusableInput(f"{path}: is not valid gzip data ({error}); copy it again or pack it with gzip") from error


def _text(path: Path, data: bytes) -> Cells:
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
    if len(names) == 1 and any(mark in head for mark in ";\t"):
        raise UnusableInput(f"{path}: line 1 is {head[:60]!r}, expected names with commas between; export it so")
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise UnusableInput(f"{path}: column {min(twice)!r} stands twice in line 1, expected once; remove one")
    body = body.rstrip("\n")
    if not body.strip():
        return Cells(path, pl.DataFrame(schema=dict.fromkeys(names, pl.String)), ())
    rows = body.count("\n") + 1
    plain = '"' not in text and "\n\n" not in body and not body.startswith("\n")
    if plain and body.count(",") == (len(names) - 1) * rows:
        try:
            frame = pl.read_csv(
                body.encode(), has_header=False, schema=dict.fromkeys(names, pl.String), quote_char=None
            )
            if frame.height == rows:
                return Cells(path, frame, range(2, rows + 2))
        except pl.exceptions.PolarsError:
            pass  # one row is too long and another too short: the slow reader below names it
    return _row_by_row(path, names, text)


def _row_by_row(path: Path, names: list[str], text: str) -> Cells:
    """Reads what the fast reader does not: quotes, blank lines, and rows of a wrong length, which are refused."""
    reader = csv.reader(io.StringIO(text))
    rows, lines = [], []
    try:
        next(reader)
        for row in reader:
            if len(row) == len(names):
                rows.append(row)
                lines.append(reader.line_num)
            elif any(cell.strip() for cell in row):
                raise UnusableInput(
                    f"{path}: row {len(rows) + 1} (line {reader.line_num}) has {len(row)} cells, expected "
                    f"{len(names)} as in the header; a truncated file or a decimal comma breaks a row"
                )
    except csv.Error as error:
        raise UnusableInput(f"{path}: line {reader.line_num} is not CSV ({error}); check the quotes") from error
    return Cells(path, pl.DataFrame(rows, schema=dict.fromkeys(names, pl.String), orient="row"), lines)
