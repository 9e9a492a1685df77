"""Text as people have it, as columns of texts with the line of each row, and expressions on these columns."""

from __future__ import annotations

import codecs
import csv
import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, counted, listed, near
from trackwright.trackers.recordings.tables import TableFile, content_of_file, first_row, read_table_file

CLOCK, DAYS = "hh:mm:ss", {"matlab": 719529.0, "excel": 25569.0}  # times of day; days, counted to the begin of 1970

UNITS: dict[str, dict[str, float]] = {
    "m": {
        "m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3, "inch": 0.0254, "ft": 0.3048,
        "s": 299792458.0, "us": 299.792458, "ns": 0.299792458, "ps": 2.99792458e-4,
    },
    "s": {
        "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0,
        **dict.fromkeys(DAYS, 86400.0), **dict.fromkeys(("iso", "dd/mm/yyyy", CLOCK), 1.0),
    },
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295},
    "mps": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 0.2777777777777778},
    "radps": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": 0.017453292519943295, "rpm": 0.10471975511965977},
    "mps2": {"m/s^2": 1.0, "cm/s^2": 1e-2, "mm/s^2": 1e-3, "g": 9.80665, "mg": 9.80665e-3},
}  # fmt: skip
"""By the ending of a column's name, units and their factors; a length in a unit of time is light's way in that time."""

_DATE = re.compile(r"iso|hh:mm:ss|(?:yyyy|mmm?|dd)([-/.])(?:yyyy|mmm?|dd)\1(?:yyyy|mmm?|dd)")
_FIELD = r"(?<![\w.])[^\W\d]\w*(?:\[\d*\])*(?:\.\w+(?:\[\d*\])*)*(?![\w.\[]|\s*\()"
_TARGET = re.compile(r"(?P<name>[\w{}]+)(?:\[(?P<sensor>[^\]]+)\])?")
_NAMED_UNIT = re.compile(r"(?:^|[\s_\[(])([a-z][a-z/^2]+|[gh](?=[\])]))[\])]?$")  # at the end of a column's name
_FORM = "TARGET=COLUMN, COLUMN in UNIT, COLUMN*NUMBER+NUMBER, A+B*1e-9, sqrt(COLUMN) or 'TEXT'"


class Expression(NamedTuple):
    """For `target`, the text `constant`, or arithmetic in SQL on the columns `sources`, there c0, c1 …, in a `unit`."""

    target: str
    text: str
    sources: tuple[str, ...] = ()
    sql: str = "c0"
    unit: str = ""
    constant: str | None = None

    def numbers(self, file: TableFile) -> pl.Series:
        """Its numbers in the rows of a file, null where empty; raises UnusableInput with the row of a text."""
        said = f"{self.target}={self.text}"
        if not self.sources:
            raise UnusableInput(f"{said}: names no column; expected {_FORM}")
        is_time = file.frame[self.sources[0]].dtype in (pl.Datetime, pl.Date)
        if _DATE.fullmatch(self.unit) and not is_time:
            later = re.sub(r"c\d+\s*\+?|\s", "", self.sql)
            if not re.fullmatch(r"(-?\d+(\.\d*)?)?", later):
                raise UnusableInput(f"{said}: expected columns joined by +, then seconds, as date+time-7200 in iso")
            return _dates(file, self.sources, self.unit) + float(later or 0.0)
        if is_time and UNITS["s"].get(self.unit, 1.0) != 1.0:
            raise UnusableInput(f"{said}: holds times, read as seconds since 1970; expected no unit")
        frame = pl.DataFrame({f"c{k}": numbers_of(file, source) for k, source in enumerate(self.sources)})
        try:
            total = frame.with_columns(x=pl.sql_expr(f"({self.sql})").cast(pl.Float64))["x"]
            lost = frame.select(pl.all_horizontal(pl.all().is_finite()) & pl.lit(~total.is_finite())).to_series()
        except pl.exceptions.PolarsError as error:
            raise UnusableInput(f"{said}: cannot be read ({str(error).splitlines()[0]}); expected {_FORM}") from error
        if lost.any():
            where = file.location(first_row(lost.fill_null(False)), " + ".join(self.sources))
            raise UnusableInput(f"{where}: no number comes of {said}; expected one in each row")
        scale = UNITS.get(self.target.rpartition("_")[2], {}).get(self.unit, 1.0)
        return (total - DAYS.get(self.unit, 0.0)) * scale

    def ids(self, file: TableFile) -> pl.Series:
        """Its texts in the rows of a file; raises UnusableInput for a column of other values."""
        if self.constant is not None:
            return pl.repeat(self.constant, len(file.frame), dtype=pl.String, eager=True)
        column = file.frame[self.sources[0]] if self.sources else pl.Series()
        if self.sql != "c0" or not (column.dtype.is_integer() or column.dtype in (pl.String, pl.Categorical, pl.Enum)):
            expected = "text or whole numbers in a column, or 'TEXT' for every row"
            raise UnusableInput(f"{self.target}={self.text} of type {column.dtype}; expected {expected}")
        return texts_of(column)


def parsed(target: str, text: str, file: TableFile | None = None) -> Expression:
    """The expression of a target on the columns of a file, or on whatever fields it names; or UnusableInput."""
    text, name, known = text.strip(), target.partition("[")[0], [] if file is None else file.frame.columns
    if re.fullmatch(r"'.*'|\".*\"", text):
        return Expression(name, text, constant=text[1:-1])
    body, unit = re.findall(r"(?s)^(.*?)(?:\s+in\s+(\S+))?$", text)[0]
    unit, units = unit.lower() if {"Y", ":"} & {*unit} else unit, UNITS.get(name.rpartition("_")[2], {})
    if (whole := text.strip("`")) in known:
        unit = (_NAMED_UNIT.findall(whole.lower().replace("°", "deg").replace("µ", "u")) or [""])[0]
        if text == whole and units.get(unit, 1.0) != 1.0 and file and not file.frame[whole].dtype.is_temporal():
            raise UnusableInput(f"{target}={text}: expected `{text}` in {unit}, or `{text}` if that is not its unit")
        return Expression(name, text, (whole,))
    sources = dict[str, str]()
    if unit and unit not in units and not ("iso" in units and _DATE.fullmatch(unit)):
        raise UnusableInput(
            f"{target}: unit {unit!r} does not fit {name}; expected one of {listed(units, 20) or 'none'}"
        )

    def column(match: re.Match[str]) -> str:
        source = match[1] or match[0]
        if file is not None and source not in known:
            found = near(source, known) or f"; found {listed(map(repr, known), 12)}"
            raise UnusableInput(f"{file.path}: {target}={text}: no column {source!r}{found}")
        return sources.setdefault(source, f"c{len(sources)}")

    # Names of columns may hold blanks and signs; the longest goes first, and one that looks like a number needs ``.
    names = "|".join(re.escape(n) for n in sorted(known, key=len, reverse=True) if not re.fullmatch(r"[\d.]*", n))
    token = rf"`([^`]+)`|(?<![\w.])(?:{names or '(?!)'})(?![\w.\[])|{_FIELD}"
    sql = re.sub(token, column, body if body in known else body.lstrip("#%/ "))
    return Expression(name, text, tuple(sources), sql, unit)


def texts_of(column: pl.Series) -> pl.Series:
    """Texts without blanks; whole numbers without the point that programs give a column with empty cells."""
    text = column.cast(pl.String).str.strip_chars()
    return text.str.strip_suffix(".0") if text.str.contains(r"^\d+\.0$").all() else text


def numbers_of(file: TableFile, column: str) -> pl.Series:
    """The column as Float64, null where empty or NaN, times as s since 1970; raises UnusableInput at a text."""
    cells = file.frame[column]
    if cells.dtype in (pl.Datetime, pl.Date):
        return _since_1970(cells)
    return cells.cast(pl.Float64) if cells.dtype == pl.Boolean else file.numbers(column)


def _dates(file: TableFile, columns: Sequence[str], order: str) -> pl.Series:
    """Dates in an order, all as the first, as s since 1970, UTC without a zone; or times of day, also past midnight."""
    cells = pl.col(columns).cast(pl.String).str.strip_chars()
    texts = given = file.frame.select(pl.concat_str(cells, separator=" ")).to_series()
    full, order, column = (texts != "").fill_null(False), order.replace("iso", "yyyy-mm-dd"), " + ".join(columns)
    first = next(iter(texts.filter(full)), "")
    if order == CLOCK:
        parts = texts.str.replace(",", ".").str.extract_groups(r"^(\d\d?):([0-5]\d):((?:[0-5]\d|60)(?:\.\d*)?)$")
        h, m, s = (part.cast(pl.Float64) for part in parts.struct.unnest())
        found = h * 3600 + m * 60 + s
        steps = found.forward_fill().diff().fill_null(0.0)
        # A row that is late over midnight is of the day before.
        found += 86400.0 * (steps < -43200.0).cum_sum() - 86400.0 * (steps > 86340.0).cum_sum()
    else:
        form = order.replace("yyyy", "%Y").replace("mmm", "%b").replace("mm", "%m").replace("dd", "%d")
        time = re.search(r"\d[T ]+\d\d?:\d\d(:\d\d(?:[.,]\d*)?)?\s*(Z|[-+]\d\d:?(?:\d\d)?)?$", first)
        form += " %H:%M" + ":%S%.f" * bool(time[1]) + "%#z" * bool(time[2]) if time else ""
        for old, new in ((r"(\d)[T ]+(\d)", "$1 $2"), (",", "."), (r"\s*Z$", "+00:00"), (r"\s+([-+]\d)", "$1")):
            texts = texts.str.replace(old, new)
        # Of other years, as 26 and 0001, nanoseconds since 1970 do not fit into 64 bits.
        texts = texts.set(~texts.str.contains(r"^\S*(?:19|20|21)\d\d").fill_null(False), None)
        found = _since_1970(texts.str.to_datetime(form, time_unit="ns", strict=False))
    if (wrong := full & found.is_null()).any():
        row = first_row(wrong)
        alike = f"as {first!r}, a time zone in all rows or none" if row != first_row(full) else "no order is guessed"
        fix = "write years in full, from 1900 on, hours of 24, zones as +02:00"
        if order == CLOCK:
            alike, fix = "all three in every row", "write hours of 24, minutes and seconds, as 14:03:59.25"
        date, forms = re.match(r"(\d\d?)([-/.])(\w+)\2\d{4}", given[row]), ["dd-mmm-yyyy"]
        if date and date[3].isdigit():  # a number above 12 is no month
            forms = ["mm-dd-yyyy"] * (int(date[1]) <= 12) + ["dd-mm-yyyy"] * (int(date[3]) <= 12)
        orders = [form.replace("-", date[2]) for form in forms] if date and forms else [order]
        if order not in orders:
            fix = f"name it, as {' or '.join(repr(f't_s={column} in {one}') for one in orders)}"
        raise UnusableInput(f"{file.location(row, column)}: {given[row]!r}; expected {order}, {alike}: {fix}")
    return found


def _since_1970(moments: pl.Series) -> pl.Series:
    """Seconds, of which only the sum of the whole ones and the fraction is rounded."""
    whole = moments.dt.epoch("ns")
    return (whole // 1_000_000_000).cast(pl.Float64) + (whole % 1_000_000_000).cast(pl.Float64) / 1e9


def columns_of(entries: Sequence[str]) -> dict[str, str]:
    """The expressions of entries TARGET=EXPRESSION, by target; raises UnusableInput."""
    pairs = [[part.strip() for part in entry.split("=", 1)] for entry in entries]
    for entry, (target, *text) in zip(entries, pairs, strict=True):
        twice = f"{target} is given twice; " * ([other for other, *_ in pairs].count(target) > 1)
        if not any(text) or not _TARGET.fullmatch(target) or twice:
            raise UnusableInput(f"--columns {entry!r}: {twice}expected {_FORM}")
    return dict(pairs)


def sensor_of(target: str) -> tuple[str, str | None]:
    """The column of a target and what is in its brackets, an anchor or station: `range_m[A1]` gives range_m, A1."""
    match = _TARGET.fullmatch(target)
    return (match["name"], match["sensor"]) if match else (target, None)


_NUMBER = re.compile(r"\s*[-+]?(\d[\d.,]*|[.,]\d+)([eE][-+]?\d+)?\s*")
_BEFORE = " \t,;|:[]->"  # what may stand between a time and the content of a line
_UNIT_CELLS = {unit for units in UNITS.values() for unit in units} | {"-", "°", "sec", "dbm", "db", "unit", "1", ""}
_HEADER = "without a header: --header none (columns are column1, column2 …); with one further below: --header LINE"
Rows = tuple[pl.DataFrame, Sequence[int] | pl.Series, list[str]]  # columns of texts, the line of each row, notices


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How a text is read; `lines`: a pattern whose named groups are the columns, a row for each place in a log."""

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
        return read_table_file(path), ["--missing is not used: Parquet has empty cells"] * bool(form.missing)
    if form.thousands == form.decimal:
        raise UnusableInput(f"--thousands and --decimal: both are {form.decimal!r}; expected two marks; give the other")
    text = _text(path, form)
    of_lines = is_json or form.lines is not None
    frame, lines, notices = _of_lines(path, text, form.lines) if of_lines else _of_table(path, text, form)
    if form.missing:
        # A mark that is a number is missing in any of its forms; a 0 may be the first time.
        cells = pl.all().str.strip_chars()
        numbers = cells.str.replace(form.decimal, ".", literal=True).cast(pl.Float64, strict=False)
        values = pl.DataFrame({"mark": list(form.missing)}).select(numbers).filter(pl.col("mark") != 0)["mark"]
        marked = cells.is_in(list(form.missing)) | numbers.is_in(values.to_list()).fill_null(False)
        count = int(frame.select(marked.sum()).sum_horizontal().sum())
        notices.append(f"{counted(count, 'cell')} with {listed(form.missing)} read as missing")
        frame = frame.with_columns(pl.when(~marked).then(pl.all()))
    return TableFile(path, frame, lines, form.decimal, form.thousands), notices


def _text(path: Path, form: Reading) -> str:
    """The text of a file, which may be packed; raises UnusableInput with the line of bytes that are no text."""
    data = content_of_file(path)
    utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        # What a serial line has garbled fits no pattern.
        text = data.decode(form.encoding or ("utf-16" if utf_16 else "utf-8"), "replace" if form.lines else "strict")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise UnusableInput(f"{path}: line {line} is no {error.encoding}; name another, as --encoding cp1252") from None
    except LookupError as error:
        raise UnusableInput(f"{path}: cannot be read ({error}); expected --encoding cp1252, for example") from error
    if "\0" in text and not form.lines:
        raise UnusableInput(f"{path}: holds binary data; expected text: export it as CSV, or give --encoding utf-16-le")
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
    rows = _cells(lines, mark)
    names = [] if form.header == "none" else [cell.strip() for cell in rows["cells"][0]]
    if len(names) > 1 and all(map(_NUMBER.fullmatch, names)):
        raise UnusableInput(f"{path}: line {at} is {head[:60]!r}, without names of columns; {_HEADER}")
    cells, width = pl.col("cells").list, len(names) or max(rows["cells"].list.len())
    header_again = cells.eval(pl.element().str.strip_chars()).list.join("\n") == "\n".join(names)
    repeated, rows = rows.filter(header_again)["line"][1:], rows.filter(~header_again)
    if len(repeated):
        notices.append(f"{counted(len(repeated), 'line')} with the header again left out: {listed(repeated)}")
    if len(comments):
        notices.append(f"{counted(len(comments), 'line')} of comments left out: {listed(comments['line'])}")
    beyond = cells.slice(width).list.eval(pl.element().str.strip_chars() != "").list.any()
    wrong = rows.select((cells.len() < width) | beyond).to_series()
    if names and wrong.any():
        line, cell = rows.row(first_row(wrong))
        found = f"{counted(len(cell), 'cell')}, expected {width} as in line {at}, the header"
        fix = f"is a quote open, the line cut off, a decimal a comma, or {mark!r} not the --separator?"
        raise UnusableInput(f"{path}: line {line} has {found}; {fix} {_HEADER}")
    if wrong.any():
        notices.append(f"{counted(int(wrong.sum()), 'row')} with fewer than {width} cells: the others are empty")
    names = [name or f"column{k}" for k, name in enumerate(names or [""] * width, 1)]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        fix = f"rename one, or --header none --skip {at} calls them column1 to column{width}"
        raise UnusableInput(f"{path}: column {twice[0]!r} is duplicated in line {at}, expected once; {fix}")
    frame = rows.select(cells.to_struct(fields=names)).unnest("cells")
    units = [str(cell or "").strip().strip("[]()") for row in frame[:1].rows() for cell in row]
    if form.header != "none" and any(map(str.isalpha, units)) and {unit.lower() for unit in units} <= _UNIT_CELLS:
        found = listed((f"{name} {unit}" for name, unit in zip(names, units, strict=True) if unit), 12)
        notices.append(f"line {rows['line'][0]} has units, left out: {found}; give them in --columns, as 'x_m=x in mm'")
        frame, rows = frame[1:], rows[1:]
    if frame.is_empty():
        raise UnusableInput(f"{path}: the table has no rows, expected at least one below line {at}")
    return frame, rows["line"], notices


def _cells(lines: pl.DataFrame, mark: str) -> pl.DataFrame:
    """The cells of each row, and the line at which it begins; a quoted cell may go over several lines."""
    text = pl.col("text").str.replace_all(r"[ \t]+", " ").str.strip_chars(" ") if mark == " " else pl.col("text")
    numbers = lines["line"].to_list()
    reader, rows, before = csv.reader((f"{x}\n" for x in lines.select(text)["text"]), delimiter=mark), [], 0
    try:
        for row in reader:
            rows.append((numbers[before], row))
            before = reader.line_num
    except csv.Error as error:
        raise UnusableInput(f"line {numbers[before]} is not CSV ({error}); check the quotes") from error
    return pl.DataFrame(rows, {"line": pl.UInt32, "cells": pl.List(pl.String)}, orient="row")


def _of_lines(path: Path, text: str, pattern: re.Pattern[str] | None) -> Rows:
    """The groups of a pattern, or the values of JSON objects by their paths, as `UWB.A1` or `links[].id`.

    What stands before is the column `time`; `line` counts the lines that are read. Others are left out and counted.
    """
    if pattern is None:
        with suppress(ValueError):  # one object or list may go over several lines
            whole = json.loads(text)
            text = "\n".join(map(json.dumps, whole if isinstance(whole, list) else [whole]))
    rows, lines, bad, read = list[dict[str, str]](), list[int](), list[int](), 0
    for number, line in enumerate(text.split("\n"), 1):
        if not line.strip() or line.startswith("#"):
            continue
        found = [*pattern.finditer(line)] if pattern else []
        begin = found[0].start() if found else line.find("{")
        of_line = [{k: v.strip(_BEFORE) for k, v in one.groupdict().items() if v} for one in found]
        if pattern is None and begin >= 0:
            with suppress(ValueError):
                of_line = _json_rows(json.loads(line[begin:].rstrip(", \t")), "")
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
            several[len(rows)] = [a | b for a, b in zip(several.get(len(rows), [{}] * len(rows)), rows, strict=True)]
    return [single | row for rows in several.values() for row in rows] or [single]
