"""Text as people have it, as columns of texts with the line of each row: tables, JSON lines, and lines of logs."""

from __future__ import annotations

import codecs
import csv
import gzip
import json
import re
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.expressions import UNITS
from trackwright.trackers.recordings.input_file import file_bytes
from trackwright.trackers.recordings.tables import TableFile, first_row, read_table_file

_NUMBER = re.compile(r"\s*[-+]?(\d[\d.,]*|[.,]\d+)([eE][-+]?\d+)?\s*")
_BEFORE = " \t,;|:[]->"  # what may stand between a time and the content of a line
_UNIT_CELLS = {unit for units in UNITS.values() for unit in units} | {"-", "°", "sec", "dbm", "db", "unit", "1", ""}
_HEADER = "without a header: --header none (columns are column1, column2 …); with one further below: --header LINE"
Rows = tuple[pl.DataFrame, Sequence[int] | pl.Series, list[str]]  # columns of texts, the line of each row, notices


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How a text is read; `header` is the line of the names, or none; `missing` are marks.

    `lines`: a pattern whose named groups are the columns, with a row for each place where it fits in a line of a log.
    """

    separator: str | None = None
    decimal: Literal[".", ","] = "."
    thousands: str = ""
    header: str | int = ""
    skip: int = 0
    missing: Sequence[str] = field(default_factory=list)
    encoding: str = ""
    lines: re.Pattern[str] | None = None


def read_rows(path: Path, form: Reading, is_json: bool = False) -> tuple[TableFile, list[str]]:
    """The columns of a text, or of Parquet, and notices; raises UnusableInput with the line."""
    if path.name.lower().endswith(".parquet"):
        return read_table_file(path), []
    text = _text(path, form)
    of_lines = is_json or form.lines is not None
    frame, lines, notices = _of_lines(path, text, form.lines) if of_lines else _of_table(path, text, form)
    if form.missing:
        marked = pl.all().str.strip_chars().is_in(list(form.missing))
        count = int(frame.select(marked.sum()).sum_horizontal().sum())
        notices.append(f"{counted(count, 'cell')} with {listed(form.missing)} read as missing")
        frame = frame.with_columns(pl.when(~marked).then(pl.all()))
    return TableFile(path, frame, lines, form.decimal, form.thousands), notices


def _text(path: Path, form: Reading) -> str:
    """The text of a file, which may be packed; raises UnusableInput with the line of bytes that are no text."""
    try:
        data = file_bytes(path)
        data = gzip.decompress(data) if path.name.endswith(".gz") else data
        utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        # What a serial line has garbled fits no pattern.
        text = data.decode(form.encoding or ("utf-16" if utf_16 else "utf-8"), "replace" if form.lines else "strict")
    except UnicodeDecodeError as error:
        line, fix = data.count(b"\n", 0, error.start) + 1, "name another, as --encoding cp1252 for files of Windows"
        raise UnusableInput(f"{path}: line {line}: byte {data[error.start]:#x} is no {error.encoding}; {fix}") from None
    except (OSError, EOFError, zlib.error, LookupError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UnusableInput(f"{path}: cannot be read ({reason}); check path, file and --encoding") from error
    if "\0" in text and not form.lines:
        raise UnusableInput(f"{path}: holds binary data, expected text; name its encoding, as --encoding utf-16-le")
    return text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def _of_table(path: Path, text: str, form: Reading) -> Rows:
    """The cells of a table; columns without a name are `column1` …"""
    notices, header = list[str](), 0
    if form.header not in ("", "none") and (not str(form.header).isdigit() or (header := int(form.header)) < 1):
        raise UnusableInput(f"--header {form.header}: expected the number of its line, or none")
    said = re.match(r"sep=(.)[ \t]*(?:\n|$)", text)
    lines = pl.DataFrame({"text": text.split("\n")}).with_row_index("line", 1)
    lines = lines[max(form.skip, int(bool(said)), header - 1) :].filter(pl.col("text").str.strip_chars() != "")
    is_comment = pl.col("text").str.contains(r"^\s*(?:#|%|//)") & (pl.col("line") != header)
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
    if len(names) > 1 and all(map(_NUMBER.fullmatch, names)):
        raise UnusableInput(f"{path}: line {at} is {head[:60]!r}, without names of columns; {_HEADER}")
    rows = rows[bool(names) :]
    if len(comments):
        notices.append(f"{counted(len(comments), 'line')} of comments left out: {listed(comments['line'])}")
    cells, width = pl.col("cells").list, len(names) or max(rows["cells"].list.len())
    beyond = cells.slice(width).list.eval(pl.element().str.strip_chars() != "").list.any()
    wrong = rows.select((cells.len() < width) | beyond).to_series()
    if names and wrong.any():
        line, cell = rows.row(first_row(wrong))
        fix = f"look for a truncated file, an open quote or decimal commas; {_HEADER}"
        found = f"{counted(len(cell), 'cell')}, expected {width} as in line {at}, the header"
        raise UnusableInput(f"{path}: line {line} has {found}; {fix}")
    if wrong.any():
        notices.append(f"{counted(int(wrong.sum()), 'row')} with fewer than {width} cells: the others are empty")
    names = [name or f"column{k}" for k, name in enumerate(names or [""] * width, 1)]
    if repeated := next((name for k, name in enumerate(names) if name in names[:k]), None):
        fix = f"rename one, or --header none --skip {at} calls them column1 to column{width}"
        raise UnusableInput(f"{path}: column {repeated!r} is duplicated in line {at}, expected once; {fix}")
    frame = rows.select(cells.to_struct(fields=names)).unnest("cells")
    units = [str(cell or "").strip().strip("[]()") for cell in (frame[:1].rows() or [()])[0]]
    if form.header != "none" and any(map(str.isalpha, units)) and {unit.lower() for unit in units} <= _UNIT_CELLS:
        found = listed((f"{name} {unit}" for name, unit in zip(names, units, strict=True) if unit), 12)
        notices.append(f"line {rows['line'][0]} has units, left out: {found}; give them in --columns, as 'x_m=x in mm'")
        frame, rows = frame[1:], rows[1:]
    if frame.is_empty():
        raise UnusableInput(f"{path}: the table has no rows, expected at least one below line {at}")
    return frame, rows["line"], notices


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


def _of_lines(path: Path, text: str, pattern: re.Pattern[str] | None) -> Rows:
    """The groups of a pattern, or the values of JSON objects by their paths, as `UWB.A1` or `links[].id`.

    What stands before is the column `time`; `line` counts the lines that are read. Others are left out and counted.
    """
    if text.lstrip().startswith("[") and pattern is None:
        with suppress(ValueError):
            text = "\n".join(map(json.dumps, json.loads(text)))
    rows, lines, bad, read = list[dict[str, str]](), list[int](), list[int](), 0
    for number, line in enumerate(text.split("\n"), 1):
        if not line.strip() or line.startswith("#"):
            continue
        found = [*pattern.finditer(line)] if pattern else []
        begin = found[0].start() if found else line.find("{")
        of_line = [{k: v.strip(_BEFORE) for k, v in one.groupdict().items() if v} for one in found]
        if pattern is None and begin >= 0:
            with suppress(ValueError):
                of_line = _json_rows(json.loads(line[begin:]), "")
        if any(of_line):
            time = line[:begin].strip(_BEFORE)
            rows += [{"line": str(read)} | ({"time": time} if time else {}) | row for row in of_line]
            lines += [number] * len(of_line)
            read += 1
        else:
            bad.append(number)
    names = dict.fromkeys(name for row in rows for name in row)
    said = f"{counted(len(bad), 'line')} without values left out: {listed(bad)}"
    return pl.DataFrame(rows, dict.fromkeys(names, pl.String)), lines, [said] * bool(bad)


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
