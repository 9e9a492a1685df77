"""Expressions from the columns or fields of a source to a column of a recording: `range_m=distance in mm`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed, near
from trackwright.trackers.recordings.tables import TableFile, first_row, remedy

CLOCK, DAYS = "hh:mm:ss", {"matlab": 719529.0, "excel": 25569.0}  # times of day; days, counted to the begin of 1970

# fmt: off
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
}
# fmt: on
"""By the ending of a column's name, units and their factors; a length in a unit of time is light's way in that time."""

_DATE = re.compile(r"iso|hh:mm:ss|(?:yyyy|mmm?|dd)([-/.])(?:yyyy|mmm?|dd)\1(?:yyyy|mmm?|dd)")
_FIELD = r"(?<![\w.])[^\W\d]\w*(?:\[\d*\])*(?:\.\w+(?:\[\d*\])*)*(?![\w.\[]|\s*\()"
_TARGET = re.compile(r"(?P<name>[\w{}]+)(?:\[(?P<sensor>[^\]]+)\])?")
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
        if not self.sources:
            raise UnusableInput(f"{self.target}={self.text}: names no column; expected {_FORM}")
        if _DATE.fullmatch(self.unit) and file.frame[self.sources[0]].dtype not in (pl.Datetime, pl.Date):
            return _moments(file, self.date_texts(file), " + ".join(self.sources), self.unit)
        total = (frame := pl.DataFrame({f"c{k}": numbers_of(file, s) for k, s in enumerate(self.sources)}))["c0"]
        if self.sql != "c0":
            try:
                total = frame.with_columns(x=pl.sql_expr(self.sql).cast(pl.Float64))["x"]
                lost = frame.select(pl.all_horizontal(pl.all().is_finite()) & pl.lit(~total.is_finite())).to_series()
            except pl.exceptions.PolarsError as error:
                why = str(error).splitlines()[0]
                raise UnusableInput(f"{self.target}={self.text}: cannot be read ({why}); expected {_FORM}") from error
            if lost.any():
                where = file.location(first_row(lost.fill_null(False)), " + ".join(self.sources))
                raise UnusableInput(f"{where}: no number comes of {self.target}={self.text}; expected one in each row")
        total = total - DAYS[self.unit] if self.unit in DAYS else total
        scale = UNITS.get(self.target.rpartition("_")[2], {}).get(self.unit, 1.0)
        return total if scale == 1.0 else total * scale

    def date_texts(self, file: TableFile) -> pl.Series:
        """The texts of its columns without blanks, of several joined by blanks."""
        texts = pl.col(self.sources).cast(pl.String).str.strip_chars()
        return file.frame.select(pl.concat_str(texts, separator=" ")).to_series()

    def ids(self, file: TableFile) -> pl.Series:
        """Its texts in the rows of a file; raises UnusableInput for a column of other values."""
        if self.constant is not None:
            return pl.repeat(self.constant, len(file.frame), dtype=pl.String, eager=True)
        column = file.frame[self.sources[0]]
        if self.sql != "c0" or not (column.dtype.is_integer() or column.dtype in (pl.String, pl.Categorical, pl.Enum)):
            found = f"{self.target}={self.text} of type {column.dtype}"
            raise UnusableInput(f"{file.path}: {found}; expected a column of text or whole numbers")
        return texts_of(column)


def parsed(target: str, text: str, file: TableFile | None = None) -> Expression:
    """The expression of a target on the columns of a file, or on whatever fields it names; or UnusableInput."""
    text, name, known = text.strip(), target.partition("[")[0], [] if file is None else file.frame.columns
    if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"":
        return Expression(name, text, constant=text[1:-1])
    if (whole := text.strip("`")) in known:
        return Expression(name, text, (whole,))
    body, unit = re.findall(r"(?s)^(.*?)(?:\s+in\s+(\S+))?$", text)[0]
    unit, units = unit.lower() if {"Y", ":"} & {*unit} else unit, UNITS.get(name.rpartition("_")[2], {})
    sources: dict[str, str] = {}
    if unit and unit not in units and not ("iso" in units and _DATE.fullmatch(unit)):
        fitting = ", ".join(units) or "none: it has no unit"
        raise UnusableInput(f"{target}: unit {unit!r} does not fit {name}; expected one of {fitting}")

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
    if cells.dtype != pl.String:
        if not (cells.dtype.is_numeric() or cells.dtype in (pl.Null, pl.Boolean)):
            raise UnusableInput(f"{file.path}: column {column} has type {cells.dtype}; expected numbers")
        return cells.cast(pl.Float64).fill_nan(None)
    text = points = cells.str.strip_chars()
    if file.thousands:
        mark, point = re.escape(file.thousands), re.escape(file.decimal)
        grouped = text.str.contains(rf"^[-+]?\d{{1,3}}(?:{mark}\d{{3}})+(?:{point}\d*)?$").fill_null(False)
        points = text.str.replace_all(file.thousands, "", literal=True).zip_with(grouped, text)
    if file.decimal == ",":
        # A point, as it groups thousands, is then no part of a number.
        points = points.str.replace(".", "x", literal=True).str.replace(",", ".", literal=True)
    numbers = points.cast(pl.Float64, strict=False)
    if numbers.null_count() > text.null_count() and (wrong := numbers.is_null() & (text != "").fill_null(False)).any():
        row = first_row(wrong)
        found = f"{text[row][:40]!r}; expected a number; {remedy(text[row], column)}"
        raise UnusableInput(f"{file.location(row, column)}: {found}")
    return numbers.fill_nan(None)


def order_in(texts: pl.Series, order: str) -> str:
    """The order of the dates in a column: dotted ones, unknown to ISO, are day, month, year everywhere."""
    dotted = re.match(r"\d{1,2}\.\d{1,2}\.\d{4}\b", next(filter(None, texts), ""))
    return order if order != "iso" else "dd.mm.yyyy" if dotted else "yyyy-mm-dd"


def _moments(file: TableFile, texts: pl.Series, column: str, order: str) -> pl.Series:
    """Times of day, which go on after midnight, or dates, all as the first, as s since 1970, UTC without a zone."""
    full, order = (texts != "").fill_null(False), order_in(texts, order)
    first = next(iter(texts.filter(full)), "")
    if order == CLOCK:
        parts = texts.str.replace(",", ".").str.extract_groups(r"^(\d\d?):(\d\d)(?::(\d\d(?:\.\d*)?))?$")
        h, m, s = (part.cast(pl.Float64) for part in parts.struct.unnest())
        found = h * 3600 + m * 60 + s.fill_null(0.0)
        found += 86400.0 * (found.forward_fill().diff() < -43200.0).fill_null(False).cum_sum()
    else:
        form = order.replace("yyyy", "%Y").replace("mmm", "%b").replace("mm", "%m").replace("dd", "%d")
        time = re.search(r"\d[T ]+\d\d?:\d\d(:\d\d(?:[.,]\d*)?)?\s*(Z|[-+]\d\d:?(?:\d\d)?)?$", first)
        form += " %H:%M" + ":%S%.f" * bool(time[1]) + "%#z" * bool(time[2]) if time else ""
        plain = texts.str.replace(r"(\d)[T ]+(\d)", "$1 $2").str.replace(",", ".").str.replace(r"\s*Z$", "+00:00")
        plain = plain.str.replace(r"\s+([-+]\d)", "$1")
        found = _since_1970(plain.str.to_datetime(form, time_unit="ns", strict=False))
    if (wrong := full & found.is_null()).any():
        row = first_row(wrong)
        alike = f"as {first!r}, a time zone in all rows or none" if row != first_row(full) else "no order is guessed"
        mark, named = "/" if "/" in texts[row] else "-", re.search("-[A-Za-z]{3}-", texts[row])
        orders = ["dd-mmm-yyyy"] if named else [f"mm{mark}dd{mark}yyyy", f"dd{mark}mm{mark}yyyy"]
        fix = f"name it, as {' or '.join(repr(f't_s={column} in {one}') for one in orders)}"
        raise UnusableInput(f"{file.location(row, column)}: {texts[row]!r}; expected {order}, {alike}: {fix}")
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
