"""Mappings from the columns or message fields of other programs to those of a recording: `range_m=distance in mm`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.recordings.input_file import read_toml
from trackwright.trackers.recordings.kinds import table_kinds

UNITS: dict[str, dict[str, float]] = {
    "m": {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3, "inch": 0.0254, "ft": 0.3048},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "iso": 1.0},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295},
    "radps": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": 0.017453292519943295, "rpm": 0.10471975511965977},
    "mps2": {"m/s^2": 1.0, "cm/s^2": 1e-2, "mm/s^2": 1e-3, "g": 9.80665, "mg": 9.80665e-3},
}
"""By the ending of a column's name: units and their factors to it. `iso`: dates such as 2026-05-01T12:00:00.25."""

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_EXPRESSION = re.compile(
    rf"(?P<source>.+?)\s*(?:(?P<times>[*/])\s*(?P<factor>{_NUMBER}))?\s*"
    rf"(?:(?P<sign>[-+])\s*(?P<shift>{_NUMBER.removeprefix('[-+]?')}))?(?:\s+in\s+(?P<unit>\S+))?"
)
_TARGET = re.compile(r"(?P<name>\w+)(?:\[(?P<sensor>[^\]]+)\])?")
_ENTRY_KEYS = ("table", "columns", "topic", "tag", "separator", "decimal")


@dataclass(frozen=True)
class Expression:
    """`source` · `factor` + `shift`, or the text `constant`; `root`: the square root of the source; `iso`: a date."""

    text: str
    source: str = ""
    factor: float = 1.0
    shift: float = 0.0
    root: bool = False
    iso: bool = False
    constant: str | None = None


@dataclass(frozen=True)
class TableMapping:
    """The columns of a table from those of a source.

    `columns`: by target, or by target and sensor as `range_m[A1]`, an expression; a column of the source that has the
    name of a target needs none. `topic`: of a bag. `tag`: the id of all rows, where no column has it. `separator`: of
    the cells of a CSV file, None for the one in its header. `decimal`: the mark in numbers of a CSV file, `.` or `,`.
    """

    table: str
    columns: Mapping[str, Expression] = field(default_factory=dict)
    topic: str | None = None
    tag: str | None = None
    separator: str | None = None
    decimal: str = "."


def parsed(target: str, text: str) -> Expression:
    """The expression for a target as `range_m`: `COLUMN`, `COLUMN*0.001+5`, `COLUMN in mm`, `sqrt(COLUMN)` or `'T1'`.

    A number is scaled before it is shifted; the unit applies to both. Raises UnusableInput.
    """
    text, name = text.strip(), target.partition("[")[0]
    if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"":
        return Expression(text, constant=text[1:-1])
    match = _EXPRESSION.fullmatch(text)
    if match is None:
        raise UnusableInput(
            f"{target}={text!r}: cannot be read; expected COLUMN, COLUMN*NUMBER+NUMBER, COLUMN in UNIT or 'TEXT'"
        )
    factor = float(match["factor"] or 1.0)
    if match["times"] == "/":
        if factor == 0:
            raise UnusableInput(f"{target}={text}: a division by zero")
        factor = 1.0 / factor
    shift = float(match["shift"] or 0.0) * (-1.0 if match["sign"] == "-" else 1.0)
    scale = _scale(target, name, match["unit"]) if match["unit"] else 1.0
    source, root = match["source"].strip(), False
    if source.startswith("sqrt(") and source.endswith(")"):
        source, root = source[5:-1].strip(), True
    return Expression(text, source.strip("`"), factor * scale, shift * scale, root, match["unit"] == "iso")


def _scale(target: str, name: str, unit: str) -> float:
    units = UNITS.get(name.rpartition("_")[2], {})
    if unit not in units:
        raise UnusableInput(
            f"{target}: unit {unit!r} does not fit {name}; expected one of {', '.join(units) or 'none: it has no unit'}"
        )
    return units[unit]


def columns_of(entries: Sequence[str]) -> dict[str, Expression]:
    """The expressions of entries TARGET=EXPRESSION, by target; raises UnusableInput."""
    found: dict[str, Expression] = {}
    for entry in entries:
        target, sign, text = entry.partition("=")
        target = target.strip()
        if not sign or not text.strip() or _TARGET.fullmatch(target) is None:
            raise UnusableInput(
                f"--columns {entry!r}: expected TARGET=EXPRESSION, such as 'range_m=distance_mm*0.001' or "
                "'range_m=distance in mm'"
            )
        if target in found:
            raise UnusableInput(f"--columns {entry!r}: {target} is given twice; expected it once")
        found[target] = parsed(target, text)
    return found


def sensor_of(target: str) -> tuple[str, str | None]:
    """The column of a target and the anchor or station in its brackets: `range_m[A1]` gives range_m, A1."""
    match = _TARGET.fullmatch(target)
    assert match is not None
    return match["name"], match["sensor"]


def read_mapping(path: Path) -> list[TableMapping]:
    """The mappings of a TOML file with entries [[tables]]; raises UnusableInput."""
    content = read_toml(path, "entries [[tables]]")
    entries = content.pop("tables", None)
    if content or not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        raise UnusableInput(
            f"{path}: keys {listed(content) or 'none'}{'' if entries is None else ', tables'}; expected entries "
            "[[tables]] alone, each with table and columns"
        )
    return [_entry(f"{path}: [[tables]] {k}", entry) for k, entry in enumerate(entries, 1)]


def _entry(where: str, entry: dict[str, Any]) -> TableMapping:
    unknown = [key for key in entry if key not in _ENTRY_KEYS]
    if unknown:
        raise UnusableInput(f"{where}: unknown key {unknown[0]!r}; expected {', '.join(_ENTRY_KEYS)}")
    columns = entry.pop("columns", {})
    texts = [key for key, value in entry.items() if not isinstance(value, str)]
    if texts or not isinstance(columns, dict) or not all(isinstance(value, str) for value in columns.values()):
        raise UnusableInput(
            f'{where}: {(texts or ["columns"])[0]}; expected texts, and in columns TARGET = "EXPRESSION"'
        )
    if "table" not in entry:
        raise UnusableInput(f"{where}: no table; expected one of {', '.join(table_kinds())}")
    try:
        return checked(TableMapping(columns=columns_of([f"{k}={v}" for k, v in columns.items()]), **entry))
    except UnusableInput as problem:
        raise UnusableInput(f"{where}: {problem}") from problem


def checked(mapping: TableMapping) -> TableMapping:
    """The mapping; raises UnusableInput for a table that a recording does not have."""
    if mapping.table not in table_kinds():
        raise UnusableInput(f"table {mapping.table!r}; expected one of {', '.join(table_kinds())}")
    if mapping.decimal not in (".", ","):
        raise UnusableInput(f"decimal {mapping.decimal!r}; expected '.' or ','")
    return mapping
