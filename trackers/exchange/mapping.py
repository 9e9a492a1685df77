"""Mappings from the columns or message fields of other programs to the tables of a recording, and their TOML files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import ClassVar, Literal

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, counted, listed, near
from trackwright.trackers.exchange.text_tables import Expression, Reading, parsed, sensor_of, texts_of
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.files import read_model
from trackwright.trackers.recordings.kinds import table_kinds
from trackwright.trackers.recordings.tables import TableFile

PRESETS = {path.stem: path for path in (Path(__file__).parent / "presets").glob("[!_]*.toml")}
"""The presets by name; the head of each says what it reads, the units and frames, and where anchors come from."""

ORIGIN = "_origin"  # column of a table while it is imported: the number of its part times 2⁴⁰, and of the row there


@dataclass(frozen=True, kw_only=True)
class TableMapping(Reading):
    """A table of a source, in the keys of docs/import.md."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}
    table: str
    columns: Mapping[str, str] = field(default_factory=dict)
    topic: str | None = None
    tag: str | None = None
    where: Mapping[str, list[bool | str | int | float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.table not in table_kinds():
            raise UnusableInput(f"table {self.table!r}; expected one of {', '.join(table_kinds())}")


def read_mapping(path: Path) -> list[TableMapping]:
    """The mappings of a preset, by its name, or of a TOML file with entries [[tables]]; raises UnusableInput."""
    expected = f"entries [[tables]], or a preset by name: {', '.join(sorted(PRESETS))}{near(str(path), PRESETS)}"
    content = read_model(PRESETS.get(str(path), path), dict[Literal["tables"], list[TableMapping]], expected)
    if tables := content.get("tables"):
        return tables
    raise UnusableInput(f"{path}: no tables; expected {expected}")


@dataclass
class Source:
    """Tables by name, notices, and the `parts` of files that the rows' ORIGIN names."""

    tables: dict[str, pl.DataFrame] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)
    parts: list[tuple[TableFile, dict[str, str]]] = field(default_factory=list)

    def read(self, file: TableFile, mapping: TableMapping) -> None:
        """Adds the table that a mapping makes of the columns of a file; raises UnusableInput."""
        name, groups, tables = mapping.table, dict[str | None, dict[str, Expression]](), list[pl.DataFrame]()
        for target, text in mapping.columns.items():
            groups.setdefault(sensor_of(target)[1], {})[sensor_of(target)[0]] = parsed(target, text, file)
        asked = pl.repeat(True, len(file.frame), eager=True)
        for column, values in mapping.where.items():
            texts = texts_of(file.frame[parsed("where", f"`{column}`", file).sources[0]])
            numbers = [float(value) for value in values if not isinstance(value, str)]
            same = texts.is_in([str(value) for value in values]) | texts.cast(pl.Float64, strict=False).is_in(numbers)
            if not (asked := asked & same.fill_null(False)).any():
                found = f"{listed(map(str, values))} fits no row; found {listed(texts.unique(maintain_order=True))}"
                raise UnusableInput(f"{file.path}: {name}: where {column} = {found}; expected one of these")
        if left := len(asked) - int(asked.sum()):
            self.notices.append(f"{name}: {counted(left, 'row')} left out: with another {', '.join(mapping.where)}")
            lines = None if file.lines is None else pl.Series(file.lines).filter(asked)
            file = TableFile(file.path, file.frame.filter(asked), lines, file.decimal, file.thousands)
        used, shared = {*mapping.where}, groups.pop(None, {})
        for sensor, own in (groups or {None: {}}).items():
            columns = _complete(file, mapping, shared | own, sensor)
            ids = table_kinds()[name].layout([*columns]).ids
            table = pl.DataFrame({n: e.ids(file) if n in ids else e.numbers(file) for n, e in columns.items()})
            tables.append(table.with_columns(pl.int_range(pl.len()).alias(ORIGIN) + len(self.parts) * 2**40))
            self.parts.append((file, {n: "+".join(e.sources) or e.text for n, e in columns.items()}))
            used |= {source for e in columns.values() for source in e.sources}
        # In the order of the source, in which a clock that goes back is found.
        table = pl.concat(tables, how="diagonal").sort(pl.col(ORIGIN) % 2**40, maintain_order=True)
        wanted = table_kinds()[name].layout(table.columns)
        filled = table.filter(pl.any_horizontal(pl.col(wanted.values).is_not_null()))
        if len(filled) < len(table):
            self.notices.append(f"{name}: {counted(len(table) - len(filled), 'row')} without a value left out")
        if filled.is_empty():
            raise UnusableInput(f"{file.path}: no row has a value of {', '.join(wanted.values)}; look at the mapping")
        if unused := [column for column in file.frame.columns if column not in used | {"line", *wanted.ids}]:
            self.notices.append(f"{name}: columns not used: {listed(unused, 12)}")
        for (tag,), rows in filled.partition_by("tag", as_dict=True).items() if name in ("truth", "fixes") else ():
            where = f"{file.path}: column {self.parts[-1][1]['t_s']}"
            refuse_lost_digits(where, rows, f"poses of tag {tag}", ", or add their column: t_s=secs+nsecs*1e-9")
        filled, notices = without_identities(filled)
        self.notices += [f"{name}: {line}" for line in notices]
        before = [self.tables[name]] if name in self.tables else []
        table = pl.concat([*before, filled], how="diagonal")
        self.tables[name] = table.sort("t_s", maintain_order=True) if before else table

    def location(self, table: str, row: int, column: str) -> str:
        """Where a cell of a table stands in the source, in words."""
        part, row = divmod(self.tables[table][ORIGIN][row], 2**40)
        file, names = self.parts[part]
        return file.location(row, names.get(column, column))


def refuse_lost_digits(where: str, table: pl.DataFrame, what: str = "poses", fix: str = "") -> None:
    """Raises UnusableInput where most poses of a table have the time of another; one that is repeated counts once."""
    poses = table.unique([name for name in ("t_s", "x_m", "y_m", "z_m") if name in table.columns])
    if 2 * (times := poses["t_s"].n_unique()) < len(poses):
        found = f"{len(poses)} {what}, {'one time' if times == 1 else f'{times} times'}"
        raise UnusableInput(f"{where}: {found}: the stamps have lost their digits; write them with all digits{fix}")


def without_identities(table: pl.DataFrame) -> tuple[pl.DataFrame, list[str]]:
    """The table without attitudes where all are the identity, which programs write that have none, and a notice."""
    one = [(pl.col(name) == (name == "qw")).all() for name in QUATERNION]
    if not {*QUATERNION} <= {*table.columns} or not table.select(pl.all_horizontal(one)).item():
        return table, []
    return table.drop(QUATERNION), ["every quaternion is the identity; read as positions without attitude"]


def _complete(
    file: TableFile, mapping: TableMapping, expressions: dict[str, Expression], sensor: str | None
) -> dict[str, Expression]:
    """The expressions of all columns of a table, of one sensor or of all; raises UnusableInput for one that lacks."""
    present, table, where = file.frame.columns, mapping.table, f"{file.path}: {mapping.table}"
    wanted = table_kinds()[table].layout([*expressions, *(name for name in present if name not in expressions)])
    own, ids = expressions.get("tag", Expression("tag", "tag", ("tag",))), wanted.ids[1:]
    given, column = mapping.tag or own.constant, next(iter(own.sources), "tag")
    texts = {*texts_of(file.frame[column])} - {None, ""} if given and column in present else set()
    if (others := texts - {given}) and (mapping.tag or len(others) > 1):
        one, found = given if given in texts else min(others), f"column {column} has {listed(sorted(others))}"
        fix = f'leave it out, or read one alone: where = {{ {column} = ["{one}"] }} in a file of --mapping'
        raise UnusableInput(f"{file.path}: the {found}, which --tag {given} would overwrite; {fix}")
    constants = {} if mapping.tag is None else {"tag": mapping.tag}
    if sensor is not None:
        each = [sensor] if len(ids) == 1 else [one.strip() for one in sensor.split(",")]
        if len(each) != len(ids):
            raise UnusableInput(f"{where}: [{sensor}] in the columns; expected anchors or stations: {ids or 'none'}")
        constants |= dict(zip(ids, each, strict=True))
    expressions |= {name: Expression(name, repr(text), constant=text) for name, text in constants.items()}
    known = ("t_s", *wanted.ids, *wanted.values, *wanted.optional)
    # Signal quality may have any name that is not like one of the others.
    quality = [name for name in expressions if name in wanted.quality and not get_close_matches(name, known, 1, 0.75)]
    if unknown := [name for name in expressions if name not in (*known, *quality)]:
        found = f"has no column {unknown[0]}{near(unknown[0], known)}"
        raise UnusableInput(f"{where} {found}; expected {listed(known, 12)}")
    expressions |= {n: parsed(n, f"`{n}`", file) for n in known if n not in expressions and n in present}
    needed = ("t_s", *wanted.ids, *(wanted.values or table_kinds()[table].least))
    if missing := [name for name in needed if name not in expressions]:
        unnamed = [column for column in present if column not in known]
        like = [c for c in unnamed if missing[0] == "t_s" and re.search(r"time|stamp|date|epoch|clock", c.lower())]
        like = like or get_close_matches(missing[0].rpartition("_")[0], unnamed, 1, 0.3)
        example = f"{missing[0]}={(like or ['COLUMN'])[0]}" + " in UNIT" * ("_" in missing[0])
        empty = ", or add an empty column where none is measured" * (missing[0] in ("z_m", "elevation_rad"))
        fix = f"add --columns '{example}'{empty}; a file without a header: --header none"
        fix = "give --tag ID (in Python: tag=)" if missing[0] == "tag" else fix
        found = f"needs {missing[0]}, which no column gives; found {listed(map(repr, present), 12)}"
        raise UnusableInput(f"{where} {found}; {fix}")
    if 0 < sum(name in expressions for name in QUATERNION) < 4:
        raise UnusableInput(f"{where} has a part of qw, qx, qy, qz; expected all or none")
    return {name: expressions[name] for name in (*known, *quality) if name in expressions}
