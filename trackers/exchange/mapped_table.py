"""A table of a recording made from the columns of a source by a mapping."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.estimate_files import numbers_of
from trackwright.trackers.exchange.mapping import Expression, TableMapping, sensor_of
from trackwright.trackers.recordings.kinds import QUATERNION, layout, table_kinds
from trackwright.trackers.recordings.table_file import TableFile

_UNIT_IN_NAME = re.compile(r"[\W_](mm|cm|ms|us|ns|deg|km|ft)$|[\[(](mm|cm|ms|us|ns|deg|km|ft)[\])]$", re.IGNORECASE)
_DATE = re.compile(r"\d{4}-\d{2}-\d{2}[T ]")
_ZONE = re.compile(r":\d.*?(Z|[+-]\d{2}:?(?:\d{2})?)$")


def mapped_table(file: TableFile, mapping: TableMapping) -> tuple[pl.DataFrame, list[str]]:
    """The table that the mapping makes of the columns of a file, and notices; rows without any value are left out.

    A target without an expression is taken from the source's column of the same name. Raises UnusableInput for a
    missing column, one that the table does not have, and a cell that is not a number, with its row.
    """
    by_sensor: dict[str | None, dict[str, Expression]] = {}
    for target, expression in mapping.columns.items():
        name, sensor = sensor_of(target)
        by_sensor.setdefault(sensor, {})[name] = expression
    shared = by_sensor.pop(None, {})
    parts = [_part(file, mapping, shared | own, sensor) for sensor, own in by_sensor.items()] or [
        _part(file, mapping, shared, None)
    ]
    table = pl.concat(parts)
    wanted = layout(mapping.table, table.columns)
    filled = table.filter(pl.any_horizontal(pl.col(wanted.values).is_not_null()))
    notices = (
        [] if len(filled) == len(table) else [f"{counted(len(table) - len(filled), 'row')} without a value left out"]
    )
    if filled.is_empty():
        raise UnusableInput(f"{file.path}: no row has a value of {', '.join(wanted.values)}; look at the mapping")
    unused = [c for c in file.frame.columns if c not in _used(mapping, wanted.ids + wanted.values + wanted.optional)]
    if unused:
        notices.append(f"columns not used: {listed(unused, 12)}")
    return filled.sort("t_s", maintain_order=True) if parts[1:] else filled, notices


def _used(mapping: TableMapping, targets: tuple[str, ...]) -> set[str]:
    return {expression.source for expression in mapping.columns.values()} | {"t_s", *targets}


def _part(
    file: TableFile, mapping: TableMapping, columns: Mapping[str, Expression], sensor: str | None
) -> pl.DataFrame:
    """The rows of one sensor, or of all where the source names it."""
    expressions = dict(columns)
    own_names = [name for name in file.frame.columns if name not in expressions]
    wanted = layout(mapping.table, [*expressions, *own_names])
    ids = wanted.ids
    if mapping.tag is not None:
        expressions["tag"] = Expression(repr(mapping.tag), constant=mapping.tag)
    if sensor is not None:
        if len(ids) < 2:
            raise UnusableInput(f"{mapping.table}: has no anchors or stations; leave [{sensor}] out of the columns")
        expressions[ids[1]] = Expression(repr(sensor), constant=sensor)
    known = ("t_s", *ids, *wanted.values, *wanted.optional)
    unknown = [name for name in expressions if name not in known]
    if unknown:
        near = difflib.get_close_matches(unknown[0], known, 1, 0.5)
        raise UnusableInput(
            f"{mapping.table}: has no column {unknown[0]}; expected {near[0] if near else listed(known, 12)}; rename it"
        )
    for name in known:
        if name not in expressions and name in file.frame.columns:
            expressions[name] = Expression(name, source=name)
    for name in ("t_s", *ids, *(wanted.values or table_kinds()[mapping.table].least)):
        if name not in expressions:
            raise UnusableInput(_missing(file, mapping.table, name))
    attitude = [name for name in QUATERNION if name in expressions]
    if attitude and len(attitude) < 4:
        raise UnusableInput(f"{file.path}: {', '.join(attitude)} alone; expected all of qw, qx, qy, qz or none")
    return pl.DataFrame(
        [
            (_identifiers if name in ids else _values)(file, name, expressions[name]).alias(name)
            for name in known
            if name in expressions
        ]
    )


def _missing(file: TableFile, table: str, name: str) -> str:
    found = file.frame.columns
    own = {"t_s", "tag", *layout(table, found).values}
    unmapped = f"{file.path}: {table} needs {name}, which is not mapped; found {listed(map(repr, found), 12)}"
    if name == "tag":
        return f"{unmapped}; give --tag ID"
    near = difflib.get_close_matches(name.rpartition("_")[0] or name, [c for c in found if c not in own], 1, 0.3)
    source = near[0] if near else "COLUMN"
    unit = _UNIT_IN_NAME.search(source)
    example = f"{name}={source}" + (f" in {(unit[1] or unit[2]).lower()}" if unit and "_" in name else "")
    return f"{unmapped}; add --columns {example!r}"


def _source(file: TableFile, name: str, expression: Expression) -> str:
    """The column of the source; the whole expression is tried first, so that a name may hold a sign."""
    for column in (expression.text.strip("`"), expression.source):
        if column in file.frame.columns:
            return column
    near = difflib.get_close_matches(expression.source, file.frame.columns, 1, 0.5)
    raise UnusableInput(
        f"{file.path}: {name}={expression.text}: no column {expression.source!r}; "
        + (f"expected {near[0]!r}?" if near else f"found {listed(map(repr, file.frame.columns), 12)}")
    )


def _identifiers(file: TableFile, name: str, expression: Expression) -> pl.Series:
    if expression.constant is not None:
        return pl.repeat(expression.constant, len(file.frame), dtype=pl.String, eager=True)
    column = file.frame[_source(file, name, expression)]
    if not (column.dtype.is_integer() or column.dtype in (pl.String, pl.Categorical, pl.Enum)):
        raise UnusableInput(f"{file.path}: {name} from a column of type {column.dtype}; expected text or whole numbers")
    text = column.cast(pl.String).str.strip_chars()
    missing = text.is_null() | (text == "")
    if missing.any():
        raise UnusableInput(f"{file.location(_first(missing), expression.source)}: empty; expected the id for {name}")
    return text


def _values(file: TableFile, name: str, expression: Expression) -> pl.Series:
    if expression.constant is not None:
        raise UnusableInput(f"{name}={expression.text}: a text; expected a column of numbers")
    source = _source(file, name, expression)
    if expression.iso or file.frame[source].dtype in (pl.Datetime, pl.Date):
        numbers = _seconds(file, source)
    else:
        numbers = numbers_of(file, source)
    if name == "t_s" and numbers.has_nulls():
        raise UnusableInput(f"{file.location(_first(numbers.is_null()), source)}: no time; remove the row")
    if source == expression.text.strip("`"):
        return numbers
    if expression.root:
        negative = (numbers < 0).fill_null(False)
        if negative.any():
            raise UnusableInput(f"{file.location(_first(negative), source)}: a negative number under the root")
        numbers = numbers.sqrt()
    return (
        numbers * expression.factor + expression.shift if (expression.factor, expression.shift) != (1, 0) else numbers
    )


def _seconds(file: TableFile, source: str) -> pl.Series:
    """Dates as seconds since 1970, UTC where they name no zone; raises UnusableInput with the row of another text."""
    column = file.frame[source]
    if column.dtype == pl.String:
        stamps = column.str.strip_chars().str.replace(",", ".", literal=True)
        stamps = stamps.str.to_datetime(time_unit="ns", time_zone="UTC", strict=False)
        wrong = stamps.is_null()
        if wrong.any():
            raise UnusableInput(_no_date(file, source, _first(wrong)))
        column = stamps
    whole = column.dt.epoch("ns")
    # The seconds are exact; only their sum with the fraction is rounded.
    return (whole // 1_000_000_000).cast(pl.Float64) + (whole % 1_000_000_000).cast(pl.Float64) / 1e9


def _no_date(file: TableFile, source: str, row: int) -> str:
    """Why the text in a row is no date as those above: a time zone that the first row lacks, or the reverse."""
    texts = file.frame[source]
    first, other = (_ZONE.search(str(texts[k]).strip()) for k in (0, row))
    if _DATE.match(str(texts[row]).strip()) and (first is None) != (other is None):
        zones = [f"has {found[1]}" if found else "has no time zone" for found in (other, first)]
        return (
            f"{file.path}: column {source}: row {row + 1} {zones[0]}, row 1 {zones[1]}; expected a time zone in every "
            "row, or in none"
        )
    return f"{file.location(row, source)}: {texts[row]!r}; expected a date such as 2026-05-01T12:00:00.25"


def _first(rows: pl.Series) -> int:
    found = rows.arg_max()
    assert found is not None
    return int(found)
