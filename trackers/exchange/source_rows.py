"""Tables in text as people have them, as columns of texts with the line of each row: CSV of many kinds, JSON lines."""

from __future__ import annotations

import codecs
import csv
import json
import re
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.expressions import UNITS
from trackwright.trackers.recordings.input_file import file_bytes, unpacked
from trackwright.trackers.recordings.table_file import TableFile, read_table_file

MARKS = ";\t,|"
"""Separators of cells, in the order in which they are looked for in a header."""

NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?")
_COMMENT = r"^\s*(?:#|%|//)"
_BOMS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
_CELL = "\x1f"
_UNITS = {unit.lower() for units in UNITS.values() for unit in units} | {"-", "°", "sec", "dbm", "db", "unit", "1", ""}
_HEADER = "where it has no header: --header none (the columns are column1, column2 …); one further below: --header LINE"


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How the text of a table is read.

    `separator`: of the cells, None for the one in the header. `decimal`, `thousands`: the marks in numbers. `header`:
    the line of the names, or `none`. `skip`: lines above the table. `missing`: marks of missing values. `encoding`: of
    the text; default: UTF-8, or as the first bytes say.
    """

    separator: str | None = None
    decimal: str = "."
    thousands: str = ""
    header: str | int = ""
    skip: int = 0
    missing: Sequence[str] = field(default_factory=list)
    encoding: str = ""

    def __post_init__(self) -> None:
        if self.separator is not None and len(self.separator) != 1:
            raise UnusableInput(f"--separator {self.separator!r}; expected one character, as ';' or ' ' for blanks")
        if self.decimal not in (".", ",") or self.thousands == self.decimal:
            marks = f"decimal {self.decimal!r}, thousands {self.thousands!r}"
            raise UnusableInput(f"{marks}; expected '.' or ',', and another")
        if not re.fullmatch(r"(?:[1-9]\d*|none)?", str(self.header)):
            raise UnusableInput(f"--header {self.header}: expected the number of its line, or none")
        try:
            codecs.lookup(self.encoding or "utf-8")
        except LookupError:
            expected = "a name such as utf-8, cp1252 or utf-16"
            raise UnusableInput(f"--encoding {self.encoding}: expected {expected}") from None


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


def read_rows(path: Path, form: Reading) -> tuple[TableFile, list[str]]:
    """The columns of a table in text or Parquet, texts without marks of missing values, and notices.

    Columns without a name are `column1` and so on. Raises UnusableInput with the line.
    """
    if path.name.lower().endswith(".parquet"):
        return read_table_file(path), []
    notices: list[str] = []
    text = text_of(path, form.encoding)
    said, header = re.match(r"sep=(.)[ \t]*(?:\n|$)", text), int(form.header) if str(form.header).isdigit() else 0
    first = max(form.skip, int(said is not None), header - 1)
    lines = pl.DataFrame({"text": text.split("\n")}).with_row_index("line", 1)[first:]
    lines = lines.filter(pl.col("text").str.strip_chars() != "")
    is_comment = pl.col("text").str.contains(_COMMENT) & (pl.col("line") != header)
    comments, lines = lines.filter(is_comment), lines.filter(~is_comment)
    if lines.is_empty():
        raise UnusableInput(f"{path}: has no rows, expected some below line {first}")
    at, head = lines.row(0)
    separator = form.separator or (said[1] if said else _separator_of(head, form.decimal))
    if form.separator is None and separator != ",":
        notices.append(f"cells are read as separated by {separator!r}; another mark: --separator")
    lines, mark = _with_plain_cells(path, lines, separator)
    names = [] if form.header == "none" else [cell.strip() for cell in lines["text"][0].split(mark)]
    above, begin = comments.filter(pl.col("line") < at), int(bool(names))
    if any(map(NUMBER.fullmatch, names)) and not above.is_empty():
        header, name_line = above.row(-1)
        named = _cells(name_line.lstrip().lstrip("#%/ "), separator)
        if len(named) == len(names) and not any(map(NUMBER.fullmatch, named)):
            names, at, begin, comments = named, header, 0, comments.filter(pl.col("line") != header)
            notices.append(f"line {header} is the header; another: --header")
    if len(names) > 1 and all(map(NUMBER.fullmatch, names)):
        raise UnusableInput(f"{path}: line {at} is {head[:60]!r}, without names of columns; {_HEADER}")
    if not comments.is_empty():
        notices.append(f"{counted(len(comments), 'line')} of comments left out: {listed(comments['line'])}")
    rows = lines[begin:]
    sizes = rows["text"].str.count_matches(mark, literal=True) + 1
    width = len(names) or int(sizes.max() or 0)  # type: ignore[arg-type]
    if names and not (odd := rows.filter(sizes != width)).is_empty():
        _refuse_other_width(path, odd, mark, width, at)
    if not names and (short := int((sizes < width).sum())):
        notices.append(f"{counted(short, 'row')} with fewer than {width} cells: the others are empty")
    names = [name or f"column{k}" for k, name in enumerate(names or [""] * width, 1)]
    if repeated := next((name for k, name in enumerate(names) if name in names[:k]), None):
        fix = f"rename one, or --header none --skip {at} calls them column1 to column{width}"
        raise UnusableInput(f"{path}: column {repeated!r} is duplicated in line {at}, expected once; {fix}")
    cells = rows["text"].str.split_exact(mark, width - 1).struct.rename_fields(names).struct.unnest()
    frame, numbers = cells.select(pl.all().fill_null("")), rows["line"]
    if len(frame) and form.header != "none" and _are_units(frame.row(0)):
        units = listed((f"{name} {unit}" for name, unit in zip(names, frame.row(0), strict=True) if unit), 12)
        notices.append(f"line {numbers[0]} has units, left out: {units}; give them in --columns, as 'x_m=x in mm'")
        frame, numbers = frame[1:], numbers[1:]
    if frame.is_empty():
        raise UnusableInput(f"{path}: the table has no rows, expected at least one below line {at}")
    return TableFile(path, _without(frame, form, notices), numbers, form.decimal, form.thousands), notices


def _separator_of(head: str, decimal: str) -> str:
    """The mark in the header: a comma goes first unless numbers have it, blanks are the last."""
    marks = [mark for mark in MARKS if mark in head]
    if "," in marks and (decimal == "." or len(marks) == 1):
        return ","
    return next(iter(marks), " " if " " in head.strip() else ",")


def _cells(line: str, mark: str) -> list[str]:
    line = re.sub(r"\s+", " ", line).strip() if mark == " " else line
    return [cell.strip() for cell in next(csv.reader([line], delimiter=mark), [])]


def _with_plain_cells(path: Path, lines: pl.DataFrame, separator: str) -> tuple[pl.DataFrame, str]:
    """The lines with cells that a mark separates, and the mark; quoted cells lose their quotes."""
    if separator == " ":
        lines = lines.with_columns(pl.col("text").str.replace_all(r"[ \t]+", " ").str.strip_chars(" "))
    if not lines["text"].str.contains('"', literal=True).any():
        return lines, separator
    reader, rows, before = csv.reader((f"{line}\n" for line in lines["text"]), delimiter=separator), [], 0
    try:
        for row in reader:
            rows.append((lines["line"][reader.line_num - 1], _CELL.join(row), lines["line"][before]))
            before = reader.line_num
    except csv.Error as error:
        raise UnusableInput(f"{path}: line {lines['line'][before]} is not CSV ({error}); check the quotes") from error
    plain = pl.DataFrame(rows, {"line": pl.UInt32, "text": pl.String, "begun": pl.UInt32}, orient="row")
    return plain, _CELL


def _refuse_other_width(path: Path, rows: pl.DataFrame, mark: str, width: int, header: int) -> None:
    """Raises UnusableInput for the first row of another width than the header, but for empty cells at its end."""
    for line, text, *begun in rows.iter_rows():
        cells = text.split(mark)
        if len(cells) < width or any(map(str.strip, cells[width:])):
            if begun and begun[0] < line:
                raise UnusableInput(f"{path}: line {begun[0]} has a quote that is not closed; close or remove it")
            said = f"line {line} has {counted(len(cells), 'cell')}, expected {width} as in line {header}, the header"
            raise UnusableInput(f"{path}: {said}; look for a truncated file or decimal commas; {_HEADER}")


def _are_units(row: Iterable[str]) -> bool:
    cells = {cell.strip().strip("[]()").lower() for cell in row}
    return any(map(str.isalpha, cells)) and cells <= _UNITS


def _without(frame: pl.DataFrame, form: Reading, notices: list[str]) -> pl.DataFrame:
    """The frame with empty cells where a mark of missing values stands."""
    if not form.missing:
        return frame
    marked = pl.col(pl.String).str.strip_chars().is_in(list(form.missing))
    count = frame.select(marked.sum()).sum_horizontal().sum()
    notices.append(f"{counted(int(count), 'cell')} with {listed(form.missing)} read as missing")
    return frame.with_columns(pl.when(marked).then(pl.lit("")).otherwise(pl.col(pl.String)).name.keep())


def read_json(path: Path, form: Reading, interval: float | None, skip: bool) -> tuple[TableFile, list[str]]:
    """The values of JSON lines by their paths, as `UWB.A1` or `links[].id`, a row for each element of lists in `[]`.

    What stands before the brace of a line is `time`; its words are `word1` and so on. Without any, `time` of line k is
    k times the `interval`, s. Raises UnusableInput with the line.
    """
    text, k = text_of(path, form.encoding), 0
    rows, lines, bad, notices = list[dict[str, Any]](), list[int](), list[int](), list[str]()
    numbered = list(enumerate(text.split("\n"), 1))
    if text.lstrip().startswith("["):
        try:
            numbered = [(1, json.dumps(one)) for one in json.loads(text)]
        except ValueError as error:
            raise UnusableInput(f"{path}: is no JSON ({error}); expected a list, or an object in each line") from error
    for number, line in numbered:
        if not line.strip() or line.startswith("#"):
            continue
        before, brace, rest = line.partition("{")
        try:
            value = json.loads(brace + rest)
        except ValueError as error:
            if not skip:
                fix = "expected one JSON object; --skip-bad-lines leaves such lines out"
                raise UnusableInput(f"{path}: line {number}: {line[:60]!r} ({error}); {fix}") from error
            bad.append(number)
            continue
        before = before.strip(" \t,;|:[]->")
        shared = {"time": before} if before else {} if interval is None else {"time": repr(k * interval)}
        shared |= {f"word{j}": word for j, word in enumerate(before.split(), 1)} if " " in before else {}
        found = [shared | row for row in _json_rows(value, "")]
        rows += found
        lines += [number] * len(found)
        k += 1
    if bad:
        notices.append(f"{counted(len(bad), 'line')} could not be read, left out: {listed(bad)}")
    if not any(rows):
        raise UnusableInput(f"{path}: no values; expected an object in each line")
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: [_json_text(row.get(name)) for row in rows] for name in names}
    frame = _without(pl.DataFrame(columns, schema=dict.fromkeys(names, pl.String)), form, notices)
    return TableFile(path, frame, lines, form.decimal, form.thousands), notices


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
