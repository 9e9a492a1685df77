"""Tables in text as people have them, as columns of texts with the line of each row: CSV of many kinds, JSON lines."""

from __future__ import annotations

import codecs
import csv
import json
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.expressions import UNITS
from trackwright.trackers.recordings.input_file import file_bytes, unpacked
from trackwright.trackers.recordings.table_file import TableFile, read_table_file

COMMENTS = ("#", "%", "//")
"""Marks at the beginning of lines that are no rows."""

_NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?")
_BOMS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
_MARKS = ";\t,|"


@dataclass(frozen=True)
class Reading:
    """How the text of a table is read.

    `separator`: of the cells, None for the one in the header. `decimal`, `thousands`: the marks in numbers. `header`:
    the line of the names, or `none`. `skip`: lines above the table. `missing`: marks of missing values. `encoding`: of
    the text; default: UTF-8, or as the first bytes say.
    """

    separator: str | None = None
    decimal: str = "."
    thousands: str = ""
    header: str = ""
    skip: int = 0
    missing: Sequence[str] = ()
    encoding: str = ""

    def __post_init__(self) -> None:
        if self.separator is not None and len(self.separator) != 1:
            raise UnusableInput(
                f"--separator {self.separator!r}; expected one character, such as ';' or ' ' for blanks"
            )
        if self.decimal not in (".", ",") or self.thousands == self.decimal:
            raise UnusableInput(
                f"decimal {self.decimal!r}, thousands {self.thousands!r}; expected '.' or ',', and another"
            )
        if self.header not in ("", "none") and not re.fullmatch(r"[1-9]\d*", self.header):
            raise UnusableInput(f"--header {self.header}: expected the number of its line, or none")
        try:
            codecs.lookup(self.encoding or "utf-8")
        except LookupError:
            raise UnusableInput(
                f"--encoding {self.encoding}: expected a name such as utf-8, cp1252 or utf-16"
            ) from None


def text_of(path: Path, encoding: str = "", errors: str = "strict") -> str:
    """The text of a file, which may be packed; raises UnusableInput with the line of bytes that are no text."""
    try:
        data = file_bytes(path)
        data = unpacked(path, data) if path.name.endswith(".gz") else data
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UnusableInput(f"{path}: cannot be read ({reason}); check the path and the file") from error
    name = encoding or next((name for mark, name in _BOMS.items() if data.startswith(mark)), "utf-8")
    try:
        text = data.decode(name, errors)
    except UnicodeDecodeError as error:
        line, fix = data.count(b"\n", 0, error.start) + 1, "name another, as --encoding cp1252 for files of Windows"
        raise UnusableInput(f"{path}: line {line}: byte {data[error.start]:#x} is no {name}; {fix}") from None
    if "\0" in text and errors == "strict":
        raise UnusableInput(f"{path}: holds binary data, expected text; name its encoding, as --encoding utf-16-le")
    return text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def read_rows(path: Path, reading: Reading) -> tuple[TableFile, list[str]]:
    """The columns of a table in text or Parquet, texts without marks of missing values, and notices.

    Columns without a name are `column1` and so on. Raises UnusableInput with the line.
    """
    if path.name.lower().endswith(".parquet"):
        return read_table_file(path), []
    notices: list[str] = []
    lines = text_of(path, reading.encoding).split("\n")
    said = re.fullmatch(r"sep=(.)\s*", lines[0])
    first = max(reading.skip, int(said is not None), int(reading.header) - 1 if reading.header.isdigit() else 0)
    numbers = [n for n, line in enumerate(lines[first:], first + 1) if line.strip()]
    comments = [n for n in numbers if lines[n - 1].lstrip().startswith(COMMENTS) and str(n) != reading.header]
    numbers = sorted({*numbers} - {*comments})
    if not numbers:
        raise UnusableInput(f"{path}: has no rows, expected some below line {first}")
    head = lines[numbers[0] - 1]
    separator = reading.separator or (said[1] if said else _separator_of(head, reading.decimal))
    if reading.separator is None and separator != ",":
        notices.append(f"cells are read as separated by {separator!r}; another mark: --separator")
    names, header = _cells(head, separator), numbers[0]
    above = [n for n in comments if n < header]
    if reading.header == "none":
        names, header = [], 0
    elif any(map(_NUMBER.fullmatch, names)) and above:
        named = _cells(lines[above[-1] - 1].lstrip().lstrip("#%/ "), separator)
        if len(named) == len(names) and not any(map(_NUMBER.fullmatch, named)):
            names, header = named, comments.pop(comments.index(above[-1]))
            notices.append(f"line {header} is the header; another: --header")
    if len(names) > 1 and all(map(_NUMBER.fullmatch, names)):
        raise UnusableInput(f"{path}: line {header} is {head[:60]!r}, without names of columns; {_HEADER}")
    if comments:
        notices.append(f"{counted(len(comments), 'line')} of comments left out: {listed(map(str, comments))}")
    rows = _rows(path, lines, numbers[header == numbers[0] :], separator, len(names), header)
    width = max((len(row) for _, row in rows), default=0) if not names else len(names)
    if not names and (short := sum(len(row) < width for _, row in rows)):
        notices.append(f"{counted(short, 'row')} with fewer than {width} cells: the others are empty")
    names = [name or f"column{k}" for k, name in enumerate(names or [""] * width, 1)]
    if repeated := [name for name in names if names.count(name) > 1]:
        fix = f"rename one, or --header none --skip {header} calls them column1 to column{width}"
        raise UnusableInput(f"{path}: column {repeated[0]!r} is duplicated in line {header}, expected once; {fix}")
    if rows and header and _are_units(rows[0][1]):
        units = listed((f"{name} {unit}" for name, unit in zip(names, rows[0][1], strict=True) if unit), 12)
        notices.append(f"line {rows.pop(0)[0]} has units, left out: {units}; give them in --columns, as 'x_m=x in mm'")
    if not rows:
        raise UnusableInput(f"{path}: the table has no rows, expected at least one below line {header}")
    columns = zip(*(row + [""] * (width - len(row)) for _, row in rows), strict=True)
    frame = pl.DataFrame(dict(zip(names, columns, strict=True)), schema=dict.fromkeys(names, pl.String))
    frame = _without(frame, reading.missing, notices)
    return TableFile(path, frame, [n for n, _ in rows], reading.decimal, reading.thousands), notices


_HEADER = "where it has no header: --header none (the columns are column1, column2 …); one further below: --header LINE"


def _separator_of(head: str, decimal: str) -> str:
    """The mark in the header: a comma goes first unless numbers have it, blanks are the last."""
    marks = [mark for mark in _MARKS if mark in head]
    return (
        ","
        if "," in marks and (decimal == "." or len(marks) == 1)
        else next(iter(marks), " " if " " in head.strip() else ",")
    )


def _cells(line: str, separator: str) -> list[str]:
    line = line.replace("\t", " ").strip(" ") if separator == " " else line
    return [
        cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=separator == " "), [])
    ]


def _rows(
    path: Path, lines: list[str], numbers: list[int], separator: str, width: int, header: int
) -> list[tuple[int, list[str]]]:
    """The cells of each line, with its number; a row of another length than the header is refused."""
    blanks = separator == " "
    given = (lines[n - 1].replace("\t", " ").strip(" ") if blanks else lines[n - 1] + "\n" for n in numbers)
    reader, rows, before = (
        csv.reader(given, delimiter=separator, skipinitialspace=blanks),
        list[tuple[int, list[str]]](),
        0,
    )
    try:
        for row in reader:
            number, before = numbers[before], reader.line_num
            if width and len(row) > width and not any(map(str.strip, row[width:])):
                row = row[:width]
            if width and len(row) != width:
                if numbers[before - 1] > number:
                    raise UnusableInput(f"{path}: line {number} has a quote that is not closed; close or remove it")
                said = (
                    f"line {number} has {counted(len(row), 'cell')}, expected {width} as in line {header}, the header"
                )
                raise UnusableInput(f"{path}: {said}; look for a truncated file or decimal commas; {_HEADER}")
            rows.append((numbers[before - 1], row))
    except csv.Error as error:
        raise UnusableInput(f"{path}: line {numbers[before]} is not CSV ({error}); check the quotes") from error
    return rows


def _are_units(row: Sequence[str]) -> bool:
    known = {unit.lower() for units in UNITS.values() for unit in units} | {"-", "°", "sec", "dbm", "db", "unit", "1"}
    cells = [cell.strip().strip("[]()").lower() for cell in row]
    return any(cell.isalpha() for cell in cells) and {*cells} <= known | {""}


def _without(frame: pl.DataFrame, missing: Sequence[str], notices: list[str]) -> pl.DataFrame:
    """The frame with empty cells where a mark of missing values stands."""
    if not missing:
        return frame
    marked = frame.select(pl.col(pl.String).str.strip_chars().is_in(list(missing)).sum()).sum_horizontal().sum()
    notices.append(f"{counted(int(marked), 'cell')} with {listed(missing)} read as missing")
    texts = pl.col(pl.String)
    return frame.with_columns(
        pl.when(texts.str.strip_chars().is_in(list(missing))).then(pl.lit("")).otherwise(texts).name.keep()
    )


def read_json(path: Path, reading: Reading, interval: float | None, skip: bool) -> tuple[TableFile, list[str]]:
    """The values of JSON lines by their paths, as `UWB.A1` or `links[].id`, a row for each element of lists in `[]`.

    What stands before the brace of a line is `time`; its words are `word1` and so on. Without any, `time` of line k is
    k times the `interval`, s. Raises UnusableInput with the line.
    """
    text, rows, lines, bad, notices = (
        text_of(path, reading.encoding),
        list[dict[str, Any]](),
        list[int](),
        list[int](),
        list[str](),
    )
    if text.lstrip().startswith("["):
        try:
            content = [(1, "", one) for one in json.loads(text)]
        except ValueError as error:
            raise UnusableInput(f"{path}: is no JSON ({error}); expected a list, or an object in each line") from error
    else:
        content = []
        for number, line in enumerate(text.split("\n"), 1):
            if not line.strip() or line.startswith("#"):
                continue
            before, brace, rest = line.partition("{")
            try:
                content.append((number, before.strip(" \t,;|:[]->"), json.loads(brace + rest)))
            except ValueError as error:
                if not skip:
                    fix = "expected one JSON object; --skip-bad-lines leaves such lines out"
                    raise UnusableInput(f"{path}: line {number}: {line[:60]!r} ({error}); {fix}") from error
                bad.append(number)
    for k, (number, before, value) in enumerate(content):
        words = {f"word{j}": word for j, word in enumerate(before.split(), 1)} if " " in before else {}
        shared = {"time": before, **words} if before else {} if interval is None else {"time": repr(k * interval)}
        found = [shared | row for row in _json_rows(value, "")]
        rows += found
        lines += [number] * len(found)
    if bad:
        notices.append(f"{counted(len(bad), 'line')} could not be read, left out: {listed(map(str, bad))}")
    if not rows:
        raise UnusableInput(f"{path}: no values; expected an object in each line")
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: [_json_text(row.get(name)) for row in rows] for name in names}
    frame = _without(pl.DataFrame(columns, schema=dict.fromkeys(names, pl.String)), reading.missing, notices)
    return TableFile(path, frame, lines, reading.decimal, reading.thousands), notices


def _json_text(value: Any) -> str | None:
    return value if value is None or isinstance(value, str) else repr(value)


def _json_rows(value: Any, path: str) -> list[dict[str, Any]]:
    """The rows of a value: lists of one length stand side by side, others below each other."""
    if isinstance(value, list):
        return [row for one in value for row in _json_rows(one, f"{path}[]")]
    if not isinstance(value, dict):
        return [{path: value}]
    single: dict[str, Any] = {}
    several: dict[int, list[dict[str, Any]]] = {}
    for key, one in value.items():
        rows = _json_rows(one, f"{path}.{key}" if path else str(key))
        if len(rows) == 1 and not any("[]" in name.removeprefix(path) for name in rows[0]):
            single |= rows[0]
        elif rows:
            beside = several.setdefault(len(rows), [{} for _ in rows])
            several[len(rows)] = [a | b for a, b in zip(beside, rows, strict=True)]
    return [single | row for rows in several.values() for row in rows] or [single]
