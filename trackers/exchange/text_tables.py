"""Tables in text as people have them, and JSON lines, as columns of texts with the line of each row."""

from __future__ import annotations

import codecs
import csv
import gzip
import json
import re
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, Literal

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.expressions import UNITS
from trackwright.trackers.recordings.input_file import file_bytes
from trackwright.trackers.recordings.tables import TableFile, first_row, read_table_file

NUMBER = re.compile(r"\s*[-+]?(\d[\d.,]*|[.,]\d+)([eE][-+]?\d+)?\s*")
BEFORE = " \t,;|:[]->"  # what may stand between a time and the content of a line
_COMMENT = r"^\s*(?:#|%|//)"
_UNIT_CELLS = {unit for units in UNITS.values() for unit in units} | {"-", "°", "sec", "dbm", "db", "unit", "1", ""}
_HEADER = "without a header: --header none (columns are column1, column2 …); with one further below: --header LINE"


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How the text of a table is read; `header` is the line of the names, or none; `missing` are marks."""

    separator: str | None = None
    decimal: Literal[".", ","] = "."
    thousands: str = ""
    header: str | int = ""
    skip: int = 0
    missing: Sequence[str] = field(default_factory=list)
    encoding: str = ""


def text_of(path: Path, encoding: str = "", errors: str = "strict") -> str:
    """The text of a file, which may be packed; raises UnusableInput with the line of bytes that are no text."""
    try:
        data = file_bytes(path)
        data = gzip.decompress(data) if path.name.endswith(".gz") else data
        utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        text = data.decode(encoding or ("utf-16" if utf_16 else "utf-8"), errors)
    except UnicodeDecodeError as error:
        line, fix = data.count(b"\n", 0, error.start) + 1, "name another, as --encoding cp1252 for files of Windows"
        raise UnusableInput(f"{path}: line {line}: byte {data[error.start]:#x} is no {error.encoding}; {fix}") from None
    except (OSError, EOFError, zlib.error, LookupError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UnusableInput(f"{path}: cannot be read ({reason}); check path, file and --encoding") from error
    if "\0" in text and errors == "strict":
        raise UnusableInput(f"{path}: holds binary data, expected text; name its encoding, as --encoding utf-16-le")
    return text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def read_rows(path: Path, form: Reading) -> tuple[TableFile, list[str]]:
    """The columns of a table in text or Parquet, those without a name `column1` …, and notices; or UnusableInput."""
    if path.name.lower().endswith(".parquet"):
        return read_table_file(path), []
    text, notices, header = text_of(path, form.encoding), list[str](), 0
    if form.header not in ("", "none") and (not str(form.header).isdigit() or (header := int(form.header)) < 1):
        raise UnusableInput(f"--header {form.header}: expected the number of its line, or none")
    said = re.match(r"sep=(.)[ \t]*(?:\n|$)", text)
    lines = pl.DataFrame({"text": text.split("\n")}).with_row_index("line", 1)
    lines = lines[max(form.skip, int(bool(said)), header - 1) :].filter(pl.col("text").str.strip_chars() != "")
    is_comment = pl.col("text").str.contains(_COMMENT) & (pl.col("line") != header)
    comments, lines = lines.filter(is_comment), lines.filter(~is_comment)
    if lines.is_empty():
        raise UnusableInput(f"{path}: has no rows, expected a table; --skip and --header say where it begins")
    at, head = lines.row(0)
    # A comma goes first unless numbers have it, blanks are the last.
    marks = [mark for mark in (";\t|, " if form.decimal == "," else ",;\t| ") if mark in head.strip(" ")]
    mark = form.separator or (said[1] if said else [*marks, ","][0])
    if form.separator is None and mark != ",":
        notices.append(f"cells are read as separated by {mark!r}; another mark: --separator")
    rows = _cells(path, lines, mark)
    names = [] if form.header == "none" else [cell.strip() for cell in rows["cells"][0]]
    rows = rows[bool(names) :]
    if any(map(NUMBER.fullmatch, names)):
        # The names may stand in the last comment above.
        above = comments.filter(pl.col("line") < at)[-1:].with_columns(pl.col("text").str.strip_chars_start("#%/ "))
        named = [cell.strip() for cell in next(iter(_cells(path, above, mark)["cells"]), [])]
        if len(named) == len(names) and not any(map(NUMBER.fullmatch, named)):
            names, at, rows = named, above["line"][0], _cells(path, lines, mark)
            comments = comments.filter(pl.col("line") != at)
            notices.append(f"line {at} is the header; another: --header")
        elif len(names) > 1 and all(map(NUMBER.fullmatch, names)):
            raise UnusableInput(f"{path}: line {at} is {head[:60]!r}, without names of columns; {_HEADER}")
    if len(comments):
        notices.append(f"{counted(len(comments), 'line')} of comments left out: {listed(comments['line'])}")
    sizes, cells = rows["cells"].list.len(), pl.col("cells").list
    width = len(names) or int(sizes.max() or 0)  # type: ignore[arg-type]
    if not names and (short := int((sizes < width).sum())):
        notices.append(f"{counted(short, 'row')} with fewer than {width} cells: the others are empty")
    elif names and (sizes != width).any():
        beyond = cells.slice(width).list.eval(pl.element().str.strip_chars() != "").list.any()
        if (wrong := rows.select((cells.len() < width) | beyond).to_series()).any():
            line, found = rows["line"][first_row(wrong)], counted(sizes[first_row(wrong)], "cell")
            fix = f"look for a truncated file, an open quote or decimal commas; {_HEADER}"
            raise UnusableInput(f"{path}: line {line} has {found}, expected {width} as in line {at}, the header; {fix}")
    names = [name or f"column{k}" for k, name in enumerate(names or [""] * width, 1)]
    if repeated := next((name for k, name in enumerate(names) if name in names[:k]), None):
        fix = f"rename one, or --header none --skip {at} calls them column1 to column{width}"
        raise UnusableInput(f"{path}: column {repeated!r} is duplicated in line {at}, expected once; {fix}")
    frame = rows.select(cells.to_struct(fields=names)).unnest("cells")
    if form.header != "none" and len(frame):
        units = [str(cell or "").strip().strip("[]()") for cell in frame.row(0)]
        if any(map(str.isalpha, units)) and {unit.lower() for unit in units} <= _UNIT_CELLS:
            found = listed((f"{name} {unit}" for name, unit in zip(names, units, strict=True) if unit), 12)
            fix = "give them in --columns, as 'x_m=x in mm'"
            notices.append(f"line {rows['line'][0]} has units, left out: {found}; {fix}")
            frame, rows = frame[1:], rows[1:]
    if frame.is_empty():
        raise UnusableInput(f"{path}: the table has no rows, expected at least one below line {at}")
    return _with_missing(path, frame, rows["line"], form, notices)


def _cells(path: Path, lines: pl.DataFrame, mark: str) -> pl.DataFrame:
    """The cells of each row, and the line at which it begins; a quoted cell may go over several lines."""
    text = pl.col("text").str.replace_all(r"[ \t]+", " ").str.strip_chars(" ") if mark == " " else pl.col("text")
    if not lines["text"].str.contains('"', literal=True).any():
        return lines.select("line", cells=text.str.split(mark))
    reader, rows, before = csv.reader((f"{x}\n" for x in lines.select(text)["text"]), delimiter=mark), [], 0
    try:
        for row in reader:
            rows.append((lines["line"][before], row))
            before = reader.line_num
    except csv.Error as error:
        raise UnusableInput(f"{path}: line {lines['line'][before]} is not CSV ({error}); check the quotes") from error
    return pl.DataFrame(rows, {"line": pl.UInt32, "cells": pl.List(pl.String)}, orient="row")


def _with_missing(
    path: Path, frame: pl.DataFrame, lines: Sequence[int] | pl.Series, form: Reading, notices: list[str]
) -> tuple[TableFile, list[str]]:
    """The table with empty cells where a mark of missing values stands, and the notices with their number."""
    if form.missing:
        marked = pl.all().str.strip_chars().is_in(list(form.missing))
        count = int(frame.select(marked.sum()).sum_horizontal().sum())
        notices.append(f"{counted(count, 'cell')} with {listed(form.missing)} read as missing")
        frame = frame.with_columns(pl.when(~marked).then(pl.all()))
    return TableFile(path, frame, lines, form.decimal, form.thousands), notices


def read_lines(
    path: Path, text: str, parse: Callable[[str], list[dict[str, Any]]], skip: bool, expected: str
) -> tuple[list[dict[str, Any]], list[int], list[str]]:
    """The rows that `parse` makes of each line, and their lines; where it raises, the line is refused or left out."""
    rows, lines, bad = list[dict[str, Any]](), list[int](), dict[int, str]()
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip() and not line.startswith("#"):
            try:
                rows += (found := parse(line.strip()))
                lines += [number] * len(found)
            except (ValueError, LookupError, TypeError) as error:
                bad[number] = f"{line[:60]!r} ({error})"
    if bad and not skip:
        fix = f"expected {expected}; --skip-bad-lines leaves such lines out"
        raise UnusableInput(f"{path}: line {min(bad)}: {bad[min(bad)]}; {fix}")
    if not any(rows):
        raise UnusableInput(f"{path}: no values; expected {expected}")
    said = f"{counted(len(bad), 'line')} could not be read, left out: {listed(bad)}"
    return rows, lines, [said] * bool(bad)


def read_json(path: Path, form: Reading, interval: float | None, skip: bool) -> tuple[TableFile, list[str]]:
    """The values of JSON lines by their paths, as `UWB.A1` or `links[].id`, a row for each element of lists in `[]`.

    What stands before the brace of a line is `time`; else it counts the lines in steps of the `interval`, s.
    """
    text, number = text_of(path, form.encoding), count()

    def parse(line: str) -> list[dict[str, str]]:
        before, brace, rest = line.partition("{")
        found, k = _json_rows(json.loads(brace + rest), ""), next(number)
        time = before.strip(BEFORE) or (None if interval is None else repr(k * interval))
        return [({"time": time} if time else {}) | row for row in found]

    if text.lstrip().startswith("["):
        with suppress(ValueError):
            text = "\n".join(map(json.dumps, json.loads(text)))
    rows, lines, notices = read_lines(path, text, parse, skip, "one JSON object in each line")
    names = dict.fromkeys(name for row in rows for name in row)
    return _with_missing(path, pl.DataFrame(rows, dict.fromkeys(names, pl.String)), lines, form, notices)


def _json_rows(value: Any, path: str) -> list[dict[str, str]]:
    """The rows of a value as texts: lists of one length stand side by side, others below each other."""
    if isinstance(value, list):
        return [row for one in value for row in _json_rows(one, f"{path}[]")]
    if not isinstance(value, dict):
        return [{} if value is None else {path: value if isinstance(value, str) else repr(value)}]
    single, several = dict[str, str](), dict[int, list[dict[str, str]]]()
    for key, one in value.items():
        rows = _json_rows(one, f"{path}.{key}" if path else str(key))
        if len(rows) == 1 and not any("[]" in name.removeprefix(path) for name in rows[0]):
            single |= rows[0]
        elif rows:
            beside = several.get(len(rows), [{}] * len(rows))
            several[len(rows)] = [a | b for a, b in zip(beside, rows, strict=True)]
    return [single | row for rows in several.values() for row in rows] or [single]
