"""Mappings from the columns or message fields of other programs to the tables of a recording, and their TOML files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed, near
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.dates import order_in
from trackwright.trackers.exchange.expressions import Expression, Term, parsed, sensor_of, texts_of
from trackwright.trackers.exchange.source_rows import Reading, read_json, read_rows
from trackwright.trackers.recordings.input_file import file_bytes, read_model
from trackwright.trackers.recordings.kinds import QUATERNION, layout, table_kinds
from trackwright.trackers.recordings.table_file import TableFile, first_row

PRESETS = {path.stem: path for path in (Path(__file__).parent / "presets").glob("*.toml")}
"""The presets by name; the head of each says what it reads, the units and frames, and where anchors come from."""

ORIGIN = "_origin"
"""The column of a table while it is imported: the number of its part times 2⁴⁰, and of the row there."""

_HOLE = re.compile(r"\{(\w+)\}")
_UNIT_IN_NAME = re.compile(r"[\W_](mm|cm|ms|us|ns|deg|km|ft)$|[\[(](mm|cm|ms|us|ns|deg|km|ft)[\])]$", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class TableMapping(Reading):
    """The columns of a table from a source's, and how a source that is text is read.

    `columns`: by target, or by target and sensor as `range_m[A1]`, an expression; a column of the source that has the
    name of a target needs none; `{a}` in both stands for all that names of the source have there. `topic`: of a bag.
    `tag`: the id of all rows, where no column has it. `file`: of a folder; `{a}` in it may stand in `tag`. `where`: by
    column, the values of the rows that are read. `anchors`: x_m, y_m, z_m of each row's anchor. `body`: whether the
    rows are poses of a body, which are moved to the `offsets` of its tags, (3,) m. Raises UnusableInput.
    """

    table: str
    columns: Mapping[str, str] = field(default_factory=dict)
    topic: str | None = None
    tag: str | None = None
    file: str | None = None
    where: Mapping[str, list[str | int | float]] = field(default_factory=dict)
    anchors: Mapping[str, str] = field(default_factory=dict)
    body: bool = False
    offsets: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.table not in table_kinds():
            raise UnusableInput(f"table {self.table!r}; expected one of {', '.join(table_kinds())}")
        if self.anchors and (set(self.anchors) != {"x_m", "y_m", "z_m"} or "anchor" not in self.columns):
            found = f"anchors with {listed(self.anchors)}, columns with {listed(self.columns) or 'none'}"
            raise UnusableInput(f"{found}; expected x_m, y_m and z_m beside a column of anchor")
        _ = self.expressions, self.places

    @cached_property
    def expressions(self) -> dict[str, Expression]:
        """The expressions of the columns, by target."""
        return {target: parsed(target, text) for target, text in self.columns.items()}

    @cached_property
    def places(self) -> dict[str, Expression]:
        """The expressions of the coordinates of anchors."""
        return {target: parsed(target, text) for target, text in self.anchors.items()}

    @property
    def sources(self) -> set[str]:
        """The columns, or fields of messages, of the source that are asked for."""
        expressions = (*self.expressions.values(), *self.places.values())
        return {source for e in expressions for source in e.sources} | set(self.where)


@dataclass(frozen=True, kw_only=True)
class MappingFile:
    """A file of mappings; those with a topic are for bags, the others for other files.

    `anchors`: the pattern of an anchor in a text file of positions, with the groups anchor, x, y, z, m. `tags`,
    `bodies`: as in a rig.
    """

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    tables: list[TableMapping] = field(default_factory=list)
    anchors: str | None = None
    tags: Mapping[str, Mapping[Literal["offset_m"], tuple[float, float, float]]] = field(default_factory=dict)
    bodies: Mapping[str, Mapping[Literal["tags"], Sequence[str]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        try:
            groups = {*re.compile(self.anchors or "").groupindex}
        except re.error as error:
            raise UnusableInput(f"anchors = {self.anchors!r}: is no pattern ({error})") from error
        if self.anchors is not None and groups != {"anchor", *"xyz"}:
            raise UnusableInput(f"anchors = {self.anchors!r}; expected a pattern with groups anchor, x, y, z")

    @property
    def offsets(self) -> dict[str, tuple[float, float, float]]:
        """The place of each tag on its body, m."""
        return {tag: place["offset_m"] for tag, place in self.tags.items() if place}

    @property
    def carried(self) -> dict[str, Sequence[str]]:
        """The tags of each body."""
        return {body: one["tags"] for body, one in self.bodies.items() if one}

    def positions(self, path: Path) -> dict[str, tuple[float, ...]]:
        """The positions of anchors, m, in a text file of the makers; raises UnusableInput."""
        anchors: dict[str, tuple[float, ...]] = {}
        try:
            for match in re.finditer(str(self.anchors), file_bytes(path).decode("utf-8")):
                put(anchors, f"--rig {path}", match["anchor"], tuple(float(match[axis]) for axis in "xyz"))
        except (OSError, ValueError) as error:
            raise UnusableInput(f"--rig {path}: cannot be read ({error}); expected positions of anchors") from error
        if not anchors:
            raise UnusableInput(f"--rig {path}: no anchor in it; expected the makers' file, or a rig.toml")
        return anchors


def read_mapping(path: Path) -> MappingFile:
    """The mappings of a preset, by its name, or of a TOML file with entries [[tables]]; raises UnusableInput."""
    expected = f"entries [[tables]], or a preset by name: {', '.join(sorted(PRESETS))}{near(str(path), PRESETS)}"
    content = read_model(PRESETS.get(str(path), path), MappingFile, expected)
    if not content.tables:
        raise UnusableInput(f"{path}: no tables; expected {expected}")
    return replace(content, tables=[replace(t, offsets=content.offsets if t.body else {}) for t in content.tables])


class Asked(NamedTuple):
    """What is asked of a source: `mappings`, one for each table; of a log its tag alone.

    `interval`: s between the lines of a log without times. `skip`: whether lines of a log that are not understood are
    left out. `definitions`: .msg files of the types that a bag does not define.
    """

    mappings: Sequence[TableMapping] = ()
    interval: float | None = None
    skip: bool = False
    definitions: Sequence[Path] = ()


def put(anchors: dict[str, tuple[float, ...]], where: str, anchor: str, place: tuple[float, ...]) -> None:
    """Adds the position, m, of an anchor, read `where`; raises UnusableInput for one that moves."""
    if anchors.setdefault(anchor, place) != place:
        raise UnusableInput(
            f"{where}: anchor {anchor} at {place}, before at {anchors[anchor]}; expected anchors that stay; "
            "cut the log where it was moved, or keep one of the set-ups"
        )


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
        """Adds the table that a mapping makes of the columns of a file, and its anchors; raises UnusableInput.

        A target without an expression is taken from the column of the same name. Rows without any value are left out.
        """
        whole = file
        file, mapping, notices = _rows_asked(file, mapping)
        parts = self.parts.setdefault(mapping.table, [])
        table = pl.concat(_parts(file, mapping, parts))
        wanted = layout(mapping.table, table.columns)
        filled = table.filter(pl.any_horizontal(pl.col(wanted.values).is_not_null()))
        if len(filled) < len(table):
            notices.append(f"{counted(len(table) - len(filled), 'row')} without a value left out")
        if filled.is_empty():
            raise UnusableInput(f"{file.path}: no row has a value of {', '.join(wanted.values)}; look at the mapping")
        used = mapping.sources | {"t_s", *wanted.ids, *wanted.values, *wanted.optional}
        if unused := [name for name in file.frame.columns if name not in used]:
            notices.append(f"columns not used: {listed(unused, 12)}")
        if mapping.table in ("truth", "fixes"):
            where, fix = (
                f"{file.path}: column {parts[-1][1]['t_s']}",
                ", or add the column of the fraction: t_s=secs+nsecs*1e-9",
            )
            for (tag,), rows in filled.partition_by("tag", as_dict=True).items():
                refuse_lost_digits(where, rows, f"poses of tag {tag}", fix)
        filled = _at_the_tags(filled, mapping) if mapping.body else filled
        self.add(
            mapping.table, filled.sort("t_s", maintain_order=True) if len(table) > len(file.frame) else filled, notices
        )
        if mapping.places:
            places = [e.values(whole, name).alias(name) for name, e in mapping.places.items()]
            anchors = pl.DataFrame([mapping.expressions["anchor"].ids(whole, "anchor").alias("anchor"), *places])
            for anchor, *place in anchors.unique(maintain_order=True).rows():
                put(self.anchors, str(file.path), anchor, tuple(x + 0.0 for x in place))

    def add(self, name: str, table: pl.DataFrame, notices: Sequence[str]) -> None:
        """Adds a table, after the rows of another part of it."""
        if name in self.tables:
            table = pl.concat([self.tables[name], table], how="diagonal").sort("t_s", maintain_order=True)
        self.tables[name] = table
        self.notices += [f"{name}: {line}" for line in notices]

    def location(self, table: str, row: int, column: str) -> str:
        """Where a cell of a table stands in the source, in words; empty where that is not known."""
        origins = self.tables[table]
        if ORIGIN not in origins.columns:
            return ""
        part, row = divmod(origins[ORIGIN][row], 2**40)
        file, names = self.parts[table][part]
        return file.location(row, names.get(column, column))


def refuse_lost_digits(where: str, table: pl.DataFrame, what: str = "poses", fix: str = "") -> None:
    """Raises UnusableInput where most poses of a table have the time of another; one that is repeated counts once."""
    poses = table.unique([name for name in ("t_s", "x_m", "y_m", "z_m") if name in table.columns])
    if 2 * (times := poses["t_s"].n_unique()) < len(poses):
        found = "one time" if times == 1 else f"{times} times"
        raise UnusableInput(
            f"{where}: {len(poses)} {what}, {found}: the stamps have lost their digits; expected a time for each pose; "
            f"write them with all digits{fix}"
        )


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The tables that the mappings make of a file of text or Parquet; raises UnusableInput with file and line."""
    source = Source()
    for file, mapping in (pair for one in asked.mappings for pair in _files(path, one)):
        if name == "json":
            rows, notices = read_json(file, mapping, asked.interval, asked.skip)
        else:
            rows, notices = read_rows(file, mapping)
        source.notices += [line for line in notices if line not in source.notices]
        if mapping.table == "truth" and len(asked.mappings) > 1 and mapping.sources.isdisjoint(rows.frame.columns):
            source.notices.append(f"{file.name}: no truth, which has none of the columns of its mapping")
            continue
        source.read(rows, mapping)
    return source


def _files(path: Path, mapping: TableMapping) -> list[tuple[Path, TableMapping]]:
    """The files of a mapping, several of a folder, each with the mapping for it."""
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


def spelled_out(mapping: TableMapping, names: Sequence[str]) -> TableMapping:
    """The mapping with a column for each of the source's `names` that fits one with holes."""
    columns = {}
    for target, e in mapping.expressions.items():
        holes = next(filter(_HOLE.search, e.sources), "")
        for name, found in _fitting(holes, names) if holes else [("", {})]:
            columns[_filled(target, found)] = e.text.replace(holes, f"`{name}`") if holes else e.text
    return replace(mapping, columns=columns)


def _rows_asked(file: TableFile, mapping: TableMapping) -> tuple[TableFile, TableMapping, list[str]]:
    """The rows of a file that a mapping asks for, the mapping without holes, and notices.

    Rows of tables that stand side by side are empty where one ends before the others.
    """
    mapping, frame, notices = spelled_out(mapping, file.frame.columns), file.frame, list[str]()
    wanted = layout(mapping.table, frame.columns)
    named = {*mapping.sources, "t_s", *wanted.ids, *wanted.values}
    used = [name for name in frame.columns if name in named] or frame.columns
    full = [pl.col(n) != "" if frame[n].dtype == pl.String else pl.col(n).is_not_null() for n in used]
    asked = frame.select(asked=pl.any_horizontal(full).fill_null(False))["asked"]
    for name, values in mapping.where.items():
        (term,) = Expression(name, (Term(name),)).terms_in(file, "where")
        asked &= texts_of(frame[term.source]).is_in([str(value) for value in values])
    if not asked.all():
        why = f"with another {', '.join(mapping.where)}, or empty" if mapping.where else "empty"
        notices.append(f"{counted(int((~asked).sum()), 'row')} left out: {why}")
        lines = None if file.lines is None else pl.Series(file.lines).filter(asked)
        file = replace(file, frame=frame.filter(asked), lines=lines)
    for target, e in mapping.expressions.items():
        if e.date and (order := order_in(e.dates(file, target), e.date)) != e.date:
            notices.append(f"column {' + '.join(e.sources)}: dates are read as {order}")
    return file, mapping, notices


def _at_the_tags(table: pl.DataFrame, mapping: TableMapping) -> pl.DataFrame:
    """The table with positions of bodies moved to their tags."""
    if QUATERNION[0] not in table.columns:
        raise UnusableInput(f"{mapping.table}: body = true without an attitude; expected qw, qx, qy, qz in columns")
    q = table.select(QUATERNION).to_numpy()
    offsets = np.array([mapping.offsets.get(tag, (0.0, 0.0, 0.0)) for tag in table["tag"]], float)
    moved = np.einsum("nij,nj->ni", rotation_matrices(q / np.linalg.norm(q, axis=1, keepdims=True)), offsets)
    return table.with_columns(pl.col(f"{a}_m") + pl.Series(x) for a, x in zip("xyz", moved.T, strict=True))


def _parts(file: TableFile, mapping: TableMapping, known: list[tuple[TableFile, dict[str, str]]]) -> list[pl.DataFrame]:
    """The rows of each sensor that columns name, or of all where the source has a column of it, with ORIGIN.

    The parts of the source are added to those `known`.
    """
    by_sensor: dict[str | None, dict[str, Expression]] = {}
    for target, expression in mapping.expressions.items():
        name, sensor = sensor_of(target)
        by_sensor.setdefault(sensor, {})[name] = expression
    shared, parts, read = by_sensor.pop(None, {}), [], dict[tuple[str, str], pl.Series]()
    for sensor, own in (by_sensor or {None: {}}).items():
        columns = _columns(file, mapping, shared | own, sensor)
        for name, e in columns.items():
            if (name, e.text) not in read:
                is_id = name in layout(mapping.table, [*columns]).ids
                read[name, e.text] = (e.ids if is_id else e.values)(file, name)
        table = pl.DataFrame({name: read[name, e.text] for name, e in columns.items()})
        _refuse_empty(file, mapping, columns, table)
        parts.append(table.with_columns(pl.int_range(pl.len(), dtype=pl.Int64).alias(ORIGIN) + len(known) * 2**40))
        known.append((file, {name: "+".join(e.sources) or e.text for name, e in columns.items()}))
    return parts


def _columns(
    file: TableFile, mapping: TableMapping, expressions: dict[str, Expression], sensor: str | None
) -> dict[str, Expression]:
    """The expressions of all columns of a table, of one sensor or of all; raises UnusableInput for one that lacks."""
    present = file.frame.columns
    wanted = layout(mapping.table, [*expressions, *(name for name in present if name not in expressions)])
    ids = wanted.ids
    _refuse_other_tags(file, mapping.tag, expressions.get("tag", parsed("tag", "tag")))
    constants = {} if mapping.tag is None else {"tag": mapping.tag}
    if sensor is not None:
        if len(ids) < 2:
            raise UnusableInput(f"{mapping.table}: has no anchors or stations; leave [{sensor}] out of the columns")
        each = [sensor] if len(ids) == 2 else [one.strip() for one in sensor.split(",")]
        if len(each) != len(ids) - 1:
            raise UnusableInput(f"{mapping.table}: [{sensor}] in the columns; expected [{','.join(ids[1:])}]")
        constants |= dict(zip(ids[1:], each, strict=True))
    expressions |= {name: Expression(repr(text), constant=text) for name, text in constants.items()}
    known = ("t_s", *ids, *wanted.values, *wanted.optional)
    # Signal quality may have any name that is not like one of the others.
    quality = [name for name in expressions if name in wanted.quality and not get_close_matches(name, known, 1, 0.75)]
    if unknown := next((name for name in expressions if name not in (*known, *quality)), None):
        alike = get_close_matches(unknown, known, 1, 0.5) or [listed(known, 12)]
        raise UnusableInput(f"{mapping.table}: has no column {unknown}; expected {alike[0]}; rename it")
    expressions |= {n: parsed(n, f"`{n}`") for n in known if n not in expressions and n in present}
    for name in ("t_s", *ids, *(wanted.values or table_kinds()[mapping.table].least)):
        if name not in expressions:
            raise UnusableInput(_missing(file, mapping.table, name))
    attitude = [name for name in QUATERNION if name in expressions]
    if attitude and len(attitude) < 4:
        raise UnusableInput(f"{file.path}: {', '.join(attitude)} alone; expected all of qw, qx, qy, qz or none")
    return {name: expressions[name] for name in (*known, *quality) if name in expressions}


def _refuse_empty(
    file: TableFile, mapping: TableMapping, columns: Mapping[str, Expression], table: pl.DataFrame
) -> None:
    """Raises UnusableInput for a row with a value but without its time or an id."""
    wanted = layout(mapping.table, table.columns)
    for name in ("t_s", *wanted.ids):
        lost = table[name].is_null() if name == "t_s" else table[name].fill_null("") == ""
        if lost.any():
            values = [pl.col(n).is_not_null() for n in wanted.values if n in table.columns]
            lost &= table.select(pl.any_horizontal(*values, pl.lit(False))).to_series()
        if lost.any():
            what = "no time; remove the row" if name == "t_s" else f"empty; expected the id for {name}"
            where = file.location(first_row(lost), " + ".join(columns[name].sources))
            raise UnusableInput(f"{where}: {what}")


def _refuse_other_tags(file: TableFile, tag: str | None, own: Expression) -> None:
    """Raises UnusableInput where a `tag` for all rows, or `own` as a text, overwrites others that the rows have."""
    given, column = own.constant if tag is None else tag, next(iter(own.sources), "tag")
    found = {*texts_of(file.frame[column])} - {None, ""} if given and column in file.frame.columns else set()
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
    alike = get_close_matches(name.rpartition("_")[0] or name, [c for c in columns if c not in standard], 1, 0.3)
    source = alike[0] if alike else "COLUMN"
    unit = _UNIT_IN_NAME.search(source)
    example = f"{name}={source}" + (f" in {(unit[1] or unit[2]).lower()}" if unit and "_" in name else "")
    return f"{unmapped}; add --columns {example!r}"
