"""Expressions from the columns or fields of a source to a column of a recording: `range_m=distance in mm`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import NamedTuple

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.exchange.dates import CLOCK, DAYS, ORDERS, moments_of
from trackwright.trackers.recordings.table_file import TableFile, first_row, remedy

# fmt: off
UNITS: dict[str, dict[str, float]] = {
    "m": {
        "m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3, "inch": 0.0254, "ft": 0.3048,
        "s": 299792458.0, "us": 299.792458, "ns": 0.299792458, "ps": 2.99792458e-4,
    },
    "s": {
        "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0,
        **dict.fromkeys([*ORDERS, CLOCK], 1.0), **dict.fromkeys(DAYS, 86400.0),
    },
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295},
    "mps": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 0.2777777777777778},
    "radps": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": 0.017453292519943295, "rpm": 0.10471975511965977},
    "mps2": {"m/s^2": 1.0, "cm/s^2": 1e-2, "mm/s^2": 1e-3, "g": 9.80665, "mg": 9.80665e-3},
}
# fmt: on
"""By the ending of a column's name: units and their factors to it. `iso`, `dd/mm/yyyy` …: dates in this order.

`hh:mm:ss`: times of day; `matlab`, `excel`: days. A length in a unit of time is the way of light in that time."""

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_TERM = re.compile(
    rf"(?P<source>`[^`]*`|.+?)\s*(?:(?P<times>[*/])\s*(?P<factor>{_NUMBER}))?\s*"
    rf"(?:(?P<sign>[-+])\s*(?P<shift>{_NUMBER.removeprefix('[-+]?')}))?"
)
_IN_UNIT = re.compile(r"(?P<body>.+?)(?:\s+in\s+(?P<unit>\S+))?")
_PLUS = re.compile(r"(?<![0-9.][eE])\s*\+\s*(?=[^\d\s.])")
_TARGET = re.compile(r"(?P<name>[\w{}]+)(?:\[(?P<sensor>[^\]]+)\])?")


class Term(NamedTuple):
    """A column or field `source`, or its `root`, times `factor` plus `shift`."""

    source: str
    factor: float = 1.0
    shift: float = 0.0
    root: bool = False


@dataclass(frozen=True)
class Expression:
    """The sum of `terms`, less `days`, times `scale`, or the text `constant`, as written in `text`.

    `date`: the order of a date whose parts the terms are, or CLOCK.
    """

    text: str
    terms: tuple[Term, ...] = ()
    scale: float = 1.0
    days: float = 0.0
    date: str = ""
    constant: str | None = None

    @property
    def sources(self) -> list[str]:
        """The columns, or fields of messages, that it names."""
        return [term.source for term in self.terms]

    def terms_in(self, file: TableFile, target: str) -> tuple[Term, ...]:
        """Its terms with columns of a file; the whole text goes first, as a name may hold signs.

        Raises UnusableInput for a column that is not there.
        """
        columns = file.frame.columns
        if self.text.strip("`") in columns:
            return (Term(self.text.strip("`")),)
        terms = [term._replace(source=term.source.lstrip("#%/ ")) if term.source not in columns else term
                 for term in self.terms]  # fmt: skip
        for term, asked in zip(terms, self.sources, strict=True):
            if term.source not in columns:
                near = get_close_matches(asked, columns, 1, 0.5)
                found = f"expected {near[0]!r}?" if near else f"found {listed(map(repr, columns), 12)}"
                raise UnusableInput(f"{file.path}: {target}={self.text}: no column {asked!r}; {found}")
        return tuple(terms)

    def dates(self, file: TableFile, target: str) -> pl.Series:
        """The texts or dates of its column, or of several joined by blanks."""
        names = [term.source for term in self.terms_in(file, target)]
        if len(names) == 1:
            return file.frame[names[0]]
        texts = pl.col(names).cast(pl.String).str.strip_chars()
        return file.frame.select(pl.concat_str(texts, separator=" ")).to_series()

    def values(self, file: TableFile, target: str) -> pl.Series:
        """Its numbers in the rows of a file, null where empty; raises UnusableInput with the row of a text."""
        if self.constant is not None:
            raise UnusableInput(f"{target}={self.text}: a text; expected a column of numbers")
        terms = self.terms_in(file, target)
        parts = terms
        if self.date or file.frame[terms[0].source].dtype in (pl.Datetime, pl.Date):
            place = " + ".join(term.source for term in terms)
            columns, parts = [moments_of(file, self.dates(file, target), place, self.date)], terms[:1]
        else:
            columns = [numbers_of(file, term.source) for term in terms]
        if terms[0].source == self.text.strip("`"):
            return columns[0]
        numbers = [_scaled(file, term, column) for term, column in zip(parts, columns, strict=True)]
        total = sum(numbers[1:], numbers[0])
        total = total - self.days if self.days else total
        return total if self.scale == 1 else total * self.scale

    def ids(self, file: TableFile, target: str) -> pl.Series:
        """Its texts in the rows of a file; raises UnusableInput for a column of other values."""
        if self.constant is not None:
            return pl.repeat(self.constant, len(file.frame), dtype=pl.String, eager=True)
        column = file.frame[self.terms_in(file, target)[0].source]
        if not (column.dtype.is_integer() or column.dtype in (pl.String, pl.Categorical, pl.Enum)):
            wrong = f"{target} from a column of type {column.dtype}; expected text or whole numbers"
            raise UnusableInput(f"{file.path}: {wrong}")
        return texts_of(column)


def _scaled(file: TableFile, term: Term, numbers: pl.Series) -> pl.Series:
    if term.root:
        if (negative := (numbers < 0).fill_null(False)).any():
            raise UnusableInput(f"{file.location(first_row(negative), term.source)}: a negative number under the root")
        numbers = numbers.sqrt()
    return numbers if (term.factor, term.shift) == (1, 0) else numbers * term.factor + term.shift


def texts_of(column: pl.Series) -> pl.Series:
    """Texts without blanks; whole numbers without the point that programs give a column with empty cells."""
    text = column.cast(pl.String).str.strip_chars()
    return text.str.strip_suffix(".0") if text.str.contains(r"^\d+\.0$").all() else text


def numbers_of(file: TableFile, column: str) -> pl.Series:
    """The column as Float64, null where empty or NaN; raises UnusableInput with the row of a text."""
    cells = file.frame[column]
    if cells.dtype != pl.String:
        if not (cells.dtype.is_numeric() or cells.dtype in (pl.Null, pl.Boolean)):
            raise UnusableInput(f"{file.path}: column {column} has type {cells.dtype}; expected numbers")
        return cells.cast(pl.Float64).fill_nan(None)
    text = points = cells.str.strip_chars()
    if file.thousands:
        mark, point = re.escape(file.thousands), re.escape(file.decimal)
        grouped = text.str.contains(rf"^[-+]?\d{{1,3}}(?:{mark}\d{{3}})+(?:{point}\d*)?$")
        points = text.str.replace_all(file.thousands, "", literal=True).zip_with(grouped.fill_null(False), text)
    if file.decimal == ",":
        # A point, as it groups thousands, is then no part of a number.
        points = points.str.replace(".", "x", literal=True).str.replace(",", ".", literal=True)
    numbers = points.cast(pl.Float64, strict=False)
    if numbers.null_count() > text.null_count() and (wrong := numbers.is_null() & (text != "").fill_null(False)).any():
        row = first_row(wrong)
        found = f"{text[row][:40]!r}; expected a number; {remedy(text[row], column)}"
        raise UnusableInput(f"{file.location(row, column)}: {found}")
    return numbers.fill_nan(None)


def parsed(target: str, text: str) -> Expression:
    """The expression for a target: `COLUMN`, `COLUMN*0.001+5`, `COLUMN in mm`, `A+B*1e-9`, `sqrt(COLUMN)` or `'T1'`.

    A number is scaled before it is shifted; the unit applies to both. Raises UnusableInput.
    """
    text, name = text.strip(), target.partition("[")[0]
    if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"":
        return Expression(text, constant=text[1:-1])
    whole = _IN_UNIT.fullmatch(text)
    if whole is None:
        expected = "COLUMN, COLUMN*NUMBER+NUMBER, COLUMN in UNIT or 'TEXT'"
        raise UnusableInput(f"{target}={text!r}: cannot be read; expected {expected}")
    scales, unit = UNITS.get(name.rpartition("_")[2], {}), whole["unit"] or ""
    unit = unit.lower() if {"Y", ":"} & {*unit} else unit
    if unit and unit not in scales:
        fitting = ", ".join(scales) or "none: it has no unit"
        raise UnusableInput(f"{target}: unit {unit!r} does not fit {name}; expected one of {fitting}")
    date, scale = ORDERS.get(unit, unit if unit == CLOCK else ""), scales.get(unit, 1.0)
    parts = re.split(r"\s*\+\s*", whole["body"]) if date else _PLUS.split(whole["body"])
    terms = tuple(_term(target, text, part) for part in parts)
    if len(terms) == 1 and unit not in DAYS:
        # Multiplied with the unit at once, a number is rounded once.
        term = terms[0]
        terms, scale = (term._replace(factor=term.factor * scale, shift=term.shift * scale),), 1.0
    return Expression(text, terms, scale, DAYS.get(unit, 0.0), date)


def _term(target: str, text: str, part: str) -> Term:
    match = _TERM.fullmatch(part)
    if match is None:
        raise UnusableInput(f"{target}={text!r}: a sum with nothing in it; expected a column on both sides of +")
    factor, source = float(match["factor"] or 1.0), match["source"].strip()
    if match["times"] == "/":
        if factor == 0:
            raise UnusableInput(f"{target}={text}: a division by zero")
        factor = 1.0 / factor
    shift = float(match["shift"] or 0.0) * (-1.0 if match["sign"] == "-" else 1.0)
    root = source.startswith("sqrt(") and source.endswith(")")
    return Term((source[5:-1].strip() if root else source).strip("`"), factor, shift, root)


def columns_of(entries: Sequence[str]) -> dict[str, str]:
    """The expressions of entries TARGET=EXPRESSION, by target; raises UnusableInput."""
    expressions: dict[str, str] = {}
    for entry in entries:
        target, sign, text = (part.strip() for part in entry.partition("="))
        if not sign or not text or _TARGET.fullmatch(target) is None:
            raise UnusableInput(
                f"--columns {entry!r}: expected TARGET=EXPRESSION, such as 'range_m=distance_mm*0.001' or "
                "'range_m=distance in mm'"
            )
        if target in expressions:
            raise UnusableInput(f"--columns {entry!r}: {target} is given twice; expected it once")
        expressions[target] = text
    return expressions


def sensor_of(target: str) -> tuple[str, str | None]:
    """The column of a target and what is in its brackets, an anchor or station: `range_m[A1]` gives range_m, A1."""
    match = _TARGET.fullmatch(target)
    return (match["name"], match["sensor"]) if match else (target, None)
