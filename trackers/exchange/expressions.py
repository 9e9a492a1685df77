"""Expressions from the columns or fields of a source to a column of a recording: `range_m=distance in mm`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange.dates import CLOCK, DAYS, ORDERS

# fmt: off
UNITS: dict[str, dict[str, float]] = {
    "m": {
        "m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3, "inch": 0.0254, "ft": 0.3048,
        "s": 299792458.0, "us": 299.792458, "ns": 0.299792458, "ps": 2.99792458e-4,
    },
    "s": {
        "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0,
        **dict.fromkeys([*ORDERS, *DAYS, CLOCK], 1.0),
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
_EXPRESSION = re.compile(
    rf"(?P<source>.+?)\s*(?:(?P<times>[*/])\s*(?P<factor>{_NUMBER}))?\s*"
    rf"(?:(?P<sign>[-+])\s*(?P<shift>{_NUMBER.removeprefix('[-+]?')}))?"
)
_IN_UNIT = re.compile(r"(?P<body>.+?)(?:\s+in\s+(?P<unit>\S+))?")
_PLUS = re.compile(r"(?<![0-9.][eE])\s*\+\s*(?=[^\d\s.])")
_TARGET = re.compile(r"(?P<name>[\w{}]+)(?:\[(?P<sensor>[^\]]+)\])?")


@dataclass(frozen=True)
class Expression:
    """`source` · `factor` + `shift`, or the text `constant`, or the sum of `terms` · `factor`.

    `root`: root of the source. `date`: order of dates, of which `terms` are the parts, or CLOCK. `days`: whether it
    counts days.
    """

    text: str
    source: str = ""
    factor: float = 1.0
    shift: float = 0.0
    root: bool = False
    date: str = ""
    days: bool = False
    constant: str | None = None
    terms: tuple[Expression, ...] = ()

    @property
    def sources(self) -> set[str]:
        """The columns, or fields of messages, that it names."""
        if self.terms:
            return {term.source for term in self.terms}
        return {self.source} if self.constant is None else set()


def parsed(target: str, text: str) -> Expression:
    """The expression for a target: `COLUMN`, `COLUMN*0.001+5`, `COLUMN in mm`, `A+B*1e-9`, `sqrt(COLUMN)` or `'T1'`.

    A number is scaled before it is shifted; the unit applies to both. Raises UnusableInput.
    """
    text, name = text.strip(), target.partition("[")[0]
    if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"":
        return Expression(text, constant=text[1:-1])
    whole = _IN_UNIT.fullmatch(text)
    match = whole and _EXPRESSION.fullmatch(whole["body"])
    if whole is None or match is None:
        raise UnusableInput(
            f"{target}={text!r}: cannot be read; expected COLUMN, COLUMN*NUMBER+NUMBER, COLUMN in UNIT or 'TEXT'"
        )
    factor = float(match["factor"] or 1.0)
    if match["times"] == "/":
        if factor == 0:
            raise UnusableInput(f"{target}={text}: a division by zero")
        factor = 1.0 / factor
    shift = float(match["shift"] or 0.0) * (-1.0 if match["sign"] == "-" else 1.0)
    scales, unit = UNITS.get(name.rpartition("_")[2], {}), whole["unit"] or ""
    unit = unit.lower() if {"Y", ":"} & {*unit} else unit
    if unit and unit not in scales:
        fitting = ", ".join(scales) or "none: it has no unit"
        raise UnusableInput(f"{target}: unit {unit!r} does not fit {name}; expected one of {fitting}")
    scale, date = scales[unit] if unit else 1.0, ORDERS.get(unit, unit if unit == CLOCK else "")
    if len(parts := re.split(r"\s*\+\s*", whole["body"]) if date else _PLUS.split(whole["body"])) > 1:
        return Expression(text, "", scale, 0.0, date=date, days=unit in DAYS, terms=tuple(parsed("", p) for p in parts))
    shift -= DAYS.get(unit, 0.0)
    source, root = match["source"].strip(), False
    if source.startswith("sqrt(") and source.endswith(")"):
        source, root = source[5:-1].strip(), True
    return Expression(text, source.strip("`"), factor * scale, shift * scale, root, date, unit in DAYS)


def columns_of(entries: Sequence[str]) -> dict[str, Expression]:
    """The expressions of entries TARGET=EXPRESSION, by target; raises UnusableInput."""
    expressions: dict[str, Expression] = {}
    for entry in entries:
        target, sign, text = entry.partition("=")
        target = target.strip()
        if not sign or not text.strip() or _TARGET.fullmatch(target) is None:
            raise UnusableInput(
                f"--columns {entry!r}: expected TARGET=EXPRESSION, such as 'range_m=distance_mm*0.001' or "
                "'range_m=distance in mm'"
            )
        if target in expressions:
            raise UnusableInput(f"--columns {entry!r}: {target} is given twice; expected it once")
        expressions[target] = parsed(target, text)
    return expressions


def sensor_of(target: str) -> tuple[str, str | None]:
    """The column of a target and what is in its brackets, an anchor or station: `range_m[A1]` gives range_m, A1."""
    match = _TARGET.fullmatch(target)
    assert match is not None
    return match["name"], match["sensor"]
