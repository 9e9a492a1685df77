"""Mappings from the columns or message fields of other programs to the tables of a recording."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.dates import CLOCK, DAYS, clock_of, order_in, seconds_of
from trackwright.trackers.exchange.expressions import Expression, sensor_of
from trackwright.trackers.exchange.source_rows import Reading, read_json, read_rows
from trackwright.trackers.recordings.kinds import QUATERNION, layout, table_kinds
from trackwright.trackers.recordings.table_file import TableFile, first_row, remedy

_HOLE = re.compile(r"\{(\w+)\}")
_UNIT_IN_NAME = re.compile(r"[\W_](mm|cm|ms|us|ns|deg|km|ft)$|[\[(](mm|cm|ms|us|ns|deg|km|ft)[\])]$", re.IGNORECASE)


@dataclass(frozen=True)
class TableMapping:
    """The columns of a table from those of a source.

    `columns`: by target, or by target and sensor as `range_m[A1]`, an expression; a column of the source that has the
    name of a target needs none; `{a}` in both stands for all that names of the source have there. `topic`: of a bag.
    `tag`: the id of all rows, where no column has it. `reading`: of a file of text. `file`: of a folder; `{a}` in it
    may stand in `tag`. `where`: by column, the texts of the rows that are read. `anchors`: x_m, y_m, z_m of each row's
    anchor. `offsets`: the places of tags on the body whose poses the rows are, (3,) m.
    """

    table: str
    columns: Mapping[str, Expression] = field(default_factory=dict)
    topic: str | None = None
    tag: str | None = None
    reading: Reading = field(default_factory=Reading)
    file: str | None = None
    where: Mapping[str, Sequence[str]] = field(default_factory=dict)
    anchors: Mapping[str, Expression] = field(default_factory=dict)
    offsets: Mapping[str, Sequence[float]] = field(default_factory=dict)

    @property
    def sources(self) -> set[str]:
        """The columns, or fields of messages, of the source that are asked for."""
        expressions = (*self.columns.values(), *self.anchors.values())
        return {source for e in expressions for source in e.sources} | set(self.where)


def checked(mapping: TableMapping) -> TableMapping:
    """The mapping; raises UnusableInput for a table that a recording does not have."""
    if mapping.table not in table_kinds():
        raise UnusableInput(f"table {mapping.table!r}; expected one of {', '.join(table_kinds())}")
    return mapping


@dataclass
class Source:
    """Tables by name, notices on how they were read, and the positions of anchors, m, if the source has them.

    `parts`: by table, the columns of each file with their names there; the column ORIGIN of a table has part and row.
    """

    tables: dict[str, pl.DataFrame] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)
    anchors: dict[str, tuple[float, ...]] = field(default_factory=dict)
    parts: dict[str, list[tuple[TableFile, dict[str, str]]]] = field(default_factory=dict)

    def read(self, file: TableFile, mapping: TableMapping) -> None:
        """Adds the table that a mapping makes of the columns of a file, and its anchors; raises UnusableInput."""
        self.add(mapping.table, *_mapped(file, mapping, self.parts.setdefault(mapping.table, [])))
        if mapping.anchors:
            places = {name: _values(file, name, text) for name, text in mapping.anchors.items()}
            places = {"anchor": _identifiers(file, "anchor", mapping.columns["anchor"]), **places}
            for anchor, *place in pl.DataFrame(places).unique(maintain_order=True).rows():
                put(self.anchors, str(file.path), anchor, tuple(x + 0.0 for x in place))

    def location(self, table: str, row: int, column: str) -> str:
        """Where a cell of a table stands in the source, in words; empty where that is not known."""
        origins = self.tables[table]
        if ORIGIN not in origins.columns:
            return ""
        part, row = divmod(origins[ORIGIN][row], 2**40)
        file, names = self.parts[table][part]
        return file.location(row, names.get(column, column))

    def add(self, name: str, table: pl.DataFrame, notices: Sequence[str]) -> None:
        """Adds a table, after the rows of another part of it."""
        if name in self.tables:
            table = pl.concat([self.tables[name], table], how="diagonal").sort("t_s", maintain_order=True)
        self.tables[name] = table
        self.notices += [f"{name}: {line}" for line in notices]


def put(anchors: dict[str, tuple[float, ...]], where: str, anchor: str, place: tuple[float, ...]) -> None:
    """Adds the position, m, of an anchor, read `where`; raises UnusableInput for one that moves."""
    if anchors.setdefault(anchor, place) != place:
        raise UnusableInput(
            f"{where}: anchor {anchor} at {place}, before at {anchors[anchor]}; expected anchors that stay; "
            "cut the log where it was moved, or keep one of the set-ups"
        )


ORIGIN = "_origin"
"""The column of a table while it is imported: the number of its part times 2⁴⁰, and of the row there."""


class Asked(NamedTuple):
    """What is asked of a source: `mappings`, one for each table; of a log its tag alone.

    `interval`: s between the lines of a log without times. `skip`: whether lines of a log that are not understood are
    left out. `definitions`: .msg files of the types that a bag does not define.
    """

    mappings: Sequence[TableMapping] = ()
    interval: float | None = None
    skip: bool = False
    definitions: Sequence[Path] = ()


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The tables that the mappings make of a file of text or Parquet; raises UnusableInput with file and line."""
    source = Source()
    for file, mapping in (pair for one in asked.mappings for pair in _files(path, one)):
        if name == "json":
            rows, notices = read_json(file, mapping.reading, asked.interval, asked.skip)
        else:
            rows, notices = read_rows(file, mapping.reading)
        source.notices += [line for line in notices if line not in source.notices]
        if mapping.table == "truth" and len(asked.mappings) > 1 and mapping.sources.isdisjoint(rows.frame.columns):
            source.notices.append(f"{file.name}: no truth, which has none of the columns of its mapping")
            continue
        source.read(rows, mapping)
    return source


def _files(path: Path, mapping: TableMapping) -> list[tuple[Path, TableMapping]]:
    """The files of a mapping, which may be those of a folder, each with the mapping for it."""
    if mapping.file is None:
        return [(path, mapping)]
    files = sorted(path.glob(_HOLE.sub("*", mapping.file).lstrip("/") or "*"))
    fitting = _fitting(mapping.file, [file.relative_to(path).as_posix() for file in files])
    if not fitting:
        raise UnusableInput(f"{path}: no folder with {mapping.file}; check the path")
    return [(path / name, replace(mapping, tag=mapping.tag and _filled(mapping.tag, holes))) for name, holes in fitting]


def _fitting(template: str, names: Iterable[str]) -> list[tuple[str, dict[str, str]]]:
    """The names that are as a template such as `ranging.distance{a}`, and what each has in its holes."""
    parts = _HOLE.split(template)
    pattern = re.compile(r"(\w+)".join(map(re.escape, parts[::2])))
    matches = ((name, pattern.fullmatch(name)) for name in names)
    return [(name, dict(zip(parts[1::2], match.groups(), strict=True))) for name, match in matches if match is not None]


def _filled(template: str, holes: Mapping[str, str]) -> str:
    return _HOLE.sub(lambda match: holes.get(match[1], match[0]), template)


def spelled_out(columns: Mapping[str, Expression], names: Sequence[str]) -> dict[str, Expression]:
    """The expressions by target, those with holes for each of the source's `names` that fits."""
    return {
        _filled(target, holes): replace(e, text=e.text.replace(e.source, name), source=name)
        for target, e in columns.items()
        for name, holes in (_fitting(e.source, names) if _HOLE.search(e.source) else [(e.source, {})])
    }


def _asked(file: TableFile, mapping: TableMapping) -> tuple[TableFile, TableMapping, list[str]]:
    """The rows of a file that a mapping asks for, the mapping without holes, and notices.

    Rows of tables that stand side by side are empty where one ends before the others.
    """
    mapping = replace(mapping, columns=spelled_out(mapping.columns, file.frame.columns))
    frame = file.frame
    wanted = layout(mapping.table, frame.columns)
    named = {*mapping.sources, "t_s", *wanted.ids, *wanted.values}
    used = [name for name in frame.columns if name in named]
    full = (pl.col(n) != "" if frame[n].dtype == pl.String else pl.col(n).is_not_null() for n in used or frame.columns)
    asked = frame.select(asked=pl.any_horizontal(full).fill_null(False))["asked"]
    for name, values in mapping.where.items():
        asked &= _texts(frame[_source(file, "where", Expression(name, name))]).is_in(values)
    if asked.all():
        return file, mapping, []
    lines = None if file.lines is None else [line for line, kept in zip(file.lines, asked, strict=True) if kept]
    why = f"with another {', '.join(mapping.where)}, or empty" if mapping.where else "empty"
    notices = [f"{counted(int((~asked).sum()), 'row')} left out: {why}"]
    return replace(file, frame=frame.filter(asked), lines=lines), mapping, notices


def _at_the_tags(table: pl.DataFrame, mapping: TableMapping) -> pl.DataFrame:
    """The table with positions of bodies moved to their tags."""
    if QUATERNION[0] not in table.columns:
        raise UnusableInput(f"{mapping.table}: body = true without an attitude; expected qw, qx, qy, qz in columns")
    q = table.select(QUATERNION).to_numpy()
    offsets = np.array([mapping.offsets.get(tag, (0.0, 0.0, 0.0)) for tag in table["tag"]], float)
    moved = np.einsum("nij,nj->ni", rotation_matrices(q / np.linalg.norm(q, axis=1, keepdims=True)), offsets)
    return table.with_columns(pl.col(f"{a}_m") + pl.Series(x) for a, x in zip("xyz", moved.T, strict=True))


def mapped_table(file: TableFile, mapping: TableMapping) -> tuple[pl.DataFrame, list[str]]:
    """The table that the mapping makes of the columns of a file, and notices; rows without any value are left out.

    A target without an expression is taken from the source's column of the same name. Raises UnusableInput for a
    missing column, one that the table does not have, and a cell that is not a number, with its row.
    """
    table, notices = _mapped(file, mapping, [])
    return table.drop(ORIGIN), notices


def _mapped(
    file: TableFile, mapping: TableMapping, known: list[tuple[TableFile, dict[str, str]]]
) -> tuple[pl.DataFrame, list[str]]:
    """As `mapped_table`, with the column ORIGIN; its parts are added to those `known`."""
    by_sensor: dict[str | None, dict[str, Expression]] = {}
    file, mapping, notices = _asked(file, mapping)
    for target, expression in mapping.columns.items():
        if order := expression.date and order_in(_dates(file, target, expression), expression.date):
            notices += [f"column {expression.source}: dates are read as {order}"] * (order != expression.date)
        name, sensor = sensor_of(target)
        by_sensor.setdefault(sensor, {})[name] = expression
    shared = by_sensor.pop(None, {})
    parts = []
    for sensor, columns in by_sensor.items() if by_sensor else [(None, {})]:
        expressions = shared | columns
        rows = _part(file, mapping, expressions, sensor)
        origin = pl.int_range(len(rows), dtype=pl.Int64, eager=True) + len(known) * 2**40
        known.append((file, {name: e.source or e.text for name, e in expressions.items()}))
        parts.append(rows.with_columns(origin.alias(ORIGIN)))
    table = pl.concat(parts)
    wanted = layout(mapping.table, table.columns)
    filled = table.filter(pl.any_horizontal(pl.col(wanted.values).is_not_null()))
    if len(filled) < len(table):
        notices.append(f"{counted(len(table) - len(filled), 'row')} without a value left out")
    if filled.is_empty():
        raise UnusableInput(f"{file.path}: no row has a value of {', '.join(wanted.values)}; look at the mapping")
    used = mapping.sources | {"t_s", *wanted.ids, *wanted.values, *wanted.optional}
    unused = [name for name in file.frame.columns if name not in used]
    if unused:
        notices.append(f"columns not used: {listed(unused, 12)}")
    filled = _at_the_tags(filled, mapping) if mapping.offsets else filled
    return filled.sort("t_s", maintain_order=True) if parts[1:] else filled, notices


def _part(
    file: TableFile, mapping: TableMapping, columns: Mapping[str, Expression], sensor: str | None
) -> pl.DataFrame:
    """The rows of one sensor, or of all where the source names it."""
    expressions = dict(columns)
    unmapped = [name for name in file.frame.columns if name not in expressions]
    wanted = layout(mapping.table, [*expressions, *unmapped])
    ids = wanted.ids
    _refuse_other_tags(file, mapping.tag, expressions.get("tag", Expression("tag", "tag")))
    if mapping.tag is not None:
        expressions["tag"] = Expression(repr(mapping.tag), constant=mapping.tag)
    if sensor is not None:
        if len(ids) < 2:
            raise UnusableInput(f"{mapping.table}: has no anchors or stations; leave [{sensor}] out of the columns")
        each = [sensor] if len(ids) == 2 else [one.strip() for one in sensor.split(",")]
        if len(each) != len(ids) - 1:
            raise UnusableInput(f"{mapping.table}: [{sensor}] in the columns; expected [{','.join(ids[1:])}]")
        expressions |= {name: Expression(repr(one), constant=one) for name, one in zip(ids[1:], each, strict=True)}
    known = ("t_s", *ids, *wanted.values, *wanted.optional)
    # Signal quality may have any name that is not like one of the others.
    quality = [name for name in expressions if name in wanted.quality and not get_close_matches(name, known, 1, 0.75)]
    unknown = [name for name in expressions if name not in (*known, *quality)]
    if unknown:
        near = get_close_matches(unknown[0], known, 1, 0.5)
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
    values = [
        _values(file, n, expressions[n]).alias(n) for n in (*known, *quality) if n in expressions and n not in ids
    ]
    table = pl.DataFrame([*values, *(_identifiers(file, n, expressions[n]).alias(n) for n in ids)])
    # Rows without a value are left out, whatever else they lack.
    filled = table.select(
        pl.any_horizontal(pl.col(n).is_not_null() for n in wanted.values if n in table.columns) | pl.lit(False)
    )
    for name in ("t_s", *ids):
        lost = (table[name].is_null() | (table[name].cast(pl.String) == "")) & filled.to_series()
        if lost.any():
            what = "no time; remove the row" if name == "t_s" else f"empty; expected the id for {name}"
            raise UnusableInput(f"{file.location(first_row(lost), expressions[name].source)}: {what}")
    return table.select(n for n in (*known, *quality) if n in expressions)


def _refuse_other_tags(file: TableFile, tag: str | None, own: Expression) -> None:
    """Raises UnusableInput where a `tag` for all rows, or `own` as a text, overwrites others that the rows have."""
    given, column = own.constant if tag is None else tag, own.source or "tag"
    found = {*_texts(file.frame[column])} - {None, ""} if given and column in file.frame.columns else set()
    if found - {given} and (tag is not None or len(found) > 1):
        fix = f'leave it out, or read one tag alone: where = {{ {column} = ["{min(found)}"] }} in a file of --mapping'
        others = f"the column {column} has {listed(sorted(found))}"
        raise UnusableInput(f"{file.path}: {others}; --tag {given} would overwrite it; {fix}")


def _missing(file: TableFile, table: str, name: str) -> str:
    columns = file.frame.columns
    standard = {"t_s", "tag", *layout(table, columns).values}
    unmapped = f"{file.path}: {table} needs {name}, which no column gives; found {listed(map(repr, columns), 12)}"
    if name == "z_m":
        unmapped += "; expected a column, an empty one where no height is measured"
    if name == "tag":
        return f"{unmapped}; give --tag ID"
    if file.lines is not None and any(c[:1].isdigit() or c[:1] in "-." for c in columns):
        unmapped += "; a file without a header: --header none"
    near = get_close_matches(name.rpartition("_")[0] or name, [c for c in columns if c not in standard], 1, 0.3)
    source = near[0] if near else "COLUMN"
    unit = _UNIT_IN_NAME.search(source)
    example = f"{name}={source}" + (f" in {(unit[1] or unit[2]).lower()}" if unit and "_" in name else "")
    return f"{unmapped}; add --columns {example!r}"


def _source(file: TableFile, name: str, expression: Expression) -> str:
    """The column of the source; the whole expression is tried first, so that a name may hold a sign."""
    for column in (expression.text.strip("`"), expression.source, expression.source.lstrip("#%/ ")):
        if column in file.frame.columns:
            return column
    near = get_close_matches(expression.source, file.frame.columns, 1, 0.5)
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
    return _texts(column)


def _texts(column: pl.Series) -> pl.Series:
    """Texts without blanks; whole numbers without the point that programs give a column with empty cells."""
    text = column.cast(pl.String).str.strip_chars()
    return text.str.strip_suffix(".0") if text.str.contains(r"^\d+\.0$").all() else text


def _values(file: TableFile, name: str, expression: Expression) -> pl.Series:
    if expression.constant is not None:
        raise UnusableInput(f"{name}={expression.text}: a text; expected a column of numbers")
    if expression.terms and expression.text.strip("`") not in file.frame.columns:
        if expression.date:
            return _moments(file, name, expression)
        first, *others = (_values(file, name, term) for term in expression.terms)
        numbers = sum(others, first)
        return (
            (numbers - DAYS[expression.text.split()[-1]]) * 86400.0 if expression.days else numbers * expression.factor
        )
    source = _source(file, name, expression)
    if expression.date or file.frame[source].dtype in (pl.Datetime, pl.Date):
        numbers = _moments(file, name, expression)
    else:
        numbers = numbers_of(file, source)
    if source == expression.text.strip("`"):
        return numbers
    if expression.root:
        negative = (numbers < 0).fill_null(False)
        if negative.any():
            raise UnusableInput(f"{file.location(first_row(negative), source)}: a negative number under the root")
        numbers = numbers.sqrt()
    if (expression.factor, expression.shift) != (1, 0):
        numbers = numbers * expression.factor + expression.shift
    return numbers * 86400.0 if expression.days else numbers


def _dates(file: TableFile, name: str, expression: Expression) -> pl.Series:
    """The texts or dates of a column, or of several joined by blanks."""
    terms = () if expression.text.strip("`") in file.frame.columns else expression.terms
    columns = [_source(file, name, term) for term in terms] or [_source(file, name, expression)]
    if len(columns) == 1:
        return file.frame[columns[0]]
    return file.frame.select(
        pl.concat_str(pl.col(columns).cast(pl.String).str.strip_chars(), separator=" ")
    ).to_series()


def _moments(file: TableFile, name: str, expression: Expression) -> pl.Series:
    texts, place = _dates(file, name, expression), " + ".join(sorted(expression.sources))
    return (clock_of if expression.date == CLOCK else seconds_of)(file, texts, place, expression.date)


def numbers_of(file: TableFile, column: str) -> pl.Series:
    """The column as Float64, null where empty or NaN; raises UnusableInput with the row of a text."""
    cells = file.frame[column]
    if cells.dtype != pl.String:
        if not (cells.dtype.is_numeric() or cells.dtype in (pl.Null, pl.Boolean)):
            raise UnusableInput(f"{file.path}: column {column} has type {cells.dtype}; expected numbers")
        return cells.cast(pl.Float64).fill_nan(None)
    text = cells.str.strip_chars()
    points = text
    if file.thousands:
        mark, point = re.escape(file.thousands), re.escape(file.decimal)
        groups = rf"^[-+]?\d{{1,3}}(?:{mark}\d{{3}})+(?:{point}\d*)?$"
        plain = pl.when(text.str.contains(groups)).then(text.str.replace_all(file.thousands, "", literal=True))
        points = pl.select(plain.otherwise(text)).to_series()
    if file.decimal == ",":
        # A point, as it groups thousands, is then no part of a number.
        points = points.str.replace(".", "x", literal=True).str.replace(",", ".", literal=True)
    numbers = points.cast(pl.Float64, strict=False)
    wrong = numbers.is_null() & text.is_not_null() & (text != "")
    if wrong.any():
        row = first_row(wrong)
        raise UnusableInput(
            f"{file.location(row, column)}: {text[row][:40]!r}; expected a number; {remedy(text[row], column)}"
        )
    return numbers.fill_nan(None)
