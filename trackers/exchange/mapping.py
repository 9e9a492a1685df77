"""Mappings from the columns or message fields of other programs to the tables of a recording, and their TOML files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed, near
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.expressions import Expression, order_in, parsed, sensor_of, texts_of
from trackwright.trackers.exchange.text_tables import Reading, read_json, read_rows
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.input_file import file_bytes, read_model
from trackwright.trackers.recordings.kinds import table_kinds
from trackwright.trackers.recordings.tables import TableFile

PRESETS = {path.stem: path for path in (Path(__file__).parent / "presets").glob("[!_]*.toml")}
"""The presets by name; the head of each says what it reads, the units and frames, and where anchors come from."""

ORIGIN = "_origin"  # column of a table while it is imported: the number of its part times 2⁴⁰, and of the row there
_HOLE = re.compile(r"\{(\w+)\}")


@dataclass(frozen=True, kw_only=True)
class TableMapping(Reading):
    """A table of a source, in the keys of docs/import.md; `offsets`: of tags, m, on a body whose poses are read."""

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
        if self.table not in table_kinds():
            raise UnusableInput(f"table {self.table!r}; expected one of {', '.join(table_kinds())}")
        if self.anchors and ({*self.anchors} != {"x_m", "y_m", "z_m"} or "anchor" not in self.columns):
            raise UnusableInput(f"anchors with {listed(self.anchors)}; expected x_m, y_m, z_m beside a column anchor")
        _ = self.sources

    @cached_property
    def sources(self) -> set[str]:
        """The columns, or fields of messages, of the source that are asked for."""
        expressions = (parsed(*item) for item in (*self.columns.items(), *self.anchors.items()))
        return {source for e in expressions for source in e.sources} | set(self.where)


@dataclass(frozen=True, kw_only=True)
class MappingFile:
    """A file of mappings for bags, with a topic, and other files; `anchors`: the pattern of one in the makers' file."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    tables: list[TableMapping] = field(default_factory=list)
    anchors: re.Pattern[str] | None = None
    tags: Mapping[str, Mapping[Literal["offset_m"], tuple[float, float, float]]] = field(default_factory=dict)
    bodies: Mapping[str, Mapping[Literal["tags"], Sequence[str]]] = field(default_factory=dict)

    def positions(self, path: Path) -> dict[str, tuple[float, ...]]:
        """The positions of anchors, m, in a text file of the makers; raises UnusableInput."""
        anchors: dict[str, tuple[float, ...]] = {}
        try:
            for match in self.anchors.finditer(file_bytes(path).decode("utf-8")) if self.anchors else ():
                put(anchors, f"--rig {path}", match["anchor"], tuple(float(match[axis]) for axis in "xyz"))
        except (OSError, ValueError, IndexError) as error:
            raise UnusableInput(f"--rig {path}: {error}; expected anchors, a pattern anchor, x, y, z") from error
        if not anchors:
            raise UnusableInput(f"--rig {path}: no anchor in it; expected the makers' file, or a rig.toml")
        return anchors


def read_mapping(path: Path) -> MappingFile:
    """The mappings of a preset, by its name, or of a TOML file with entries [[tables]]; raises UnusableInput."""
    expected = f"entries [[tables]], or a preset by name: {', '.join(sorted(PRESETS))}{near(str(path), PRESETS)}"
    content = read_model(PRESETS.get(str(path), path), MappingFile, expected)
    if not content.tables:
        raise UnusableInput(f"{path}: no tables; expected {expected}")
    offsets = {tag: place["offset_m"] for tag, place in content.tags.items() if place}
    return replace(content, tables=[replace(t, offsets=offsets if t.body else {}) for t in content.tables])


class Asked(NamedTuple):
    """What is asked of a source: tables, s between lines without times, bad lines left out, .msg files for a bag."""

    mappings: Sequence[TableMapping] = ()
    interval: float | None = None
    skip: bool = False
    definitions: Sequence[Path] = ()


def put(anchors: dict[str, tuple[float, ...]], where: str, anchor: str, place: tuple[float, ...]) -> None:
    """Adds the position, m, of an anchor, read `where`; raises UnusableInput for one that moves."""
    if anchors.setdefault(anchor, place) != place:
        fix = "expected anchors that stay; cut the log where it was moved, or keep one of the set-ups"
        raise UnusableInput(f"{where}: anchor {anchor} at {place}, before at {anchors[anchor]}; {fix}")


@dataclass
class Source:
    """Tables by name, notices, positions of anchors, m, and the `parts` of files that the rows' ORIGIN names."""

    tables: dict[str, pl.DataFrame] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)
    anchors: dict[str, tuple[float, ...]] = field(default_factory=dict)
    parts: list[tuple[TableFile, dict[str, str]]] = field(default_factory=list)

    def read(self, file: TableFile, mapping: TableMapping) -> None:
        """Adds the table that a mapping makes of the columns of a file, and its anchors; raises UnusableInput."""
        mapping, whole, notices, name = spelled_out(mapping, file.frame.columns), file, list[str](), mapping.table
        expressions = {target: parsed(target, text, file) for target, text in mapping.columns.items()}
        places = [parsed(*item, file) for item in mapping.anchors.items()]
        named = {source for e in (*expressions.values(), *places) for source in e.sources} | {*mapping.where}
        by_sensor: dict[str | None, dict[str, Expression]] = {None: {}}
        for target, e in expressions.items():
            by_sensor.setdefault(sensor_of(target)[1], {})[e.target] = e
            if e.unit == "iso" and (order := order_in(e.date_texts(file), "iso")) != "yyyy-mm-dd":
                notices.append(f"column {' + '.join(e.sources)}: dates are read as {order}")
        if not (asked := _asked(file, mapping, named)).all():
            why = f"with another {', '.join(mapping.where)}, or empty" if mapping.where else "empty"
            notices.append(f"{counted(int((~asked).sum()), 'row')} left out: {why}")
            lines = None if file.lines is None else pl.Series(file.lines).filter(asked)
            file = replace(file, frame=file.frame.filter(asked), lines=lines)
        shared, tables, known = by_sensor.pop(None), [], dict[Expression, pl.Series]()
        for sensor, own in (by_sensor or {None: {}}).items():
            columns = _complete(file, mapping, shared | own, sensor)
            ids = table_kinds()[name].layout([*columns]).ids
            known |= {e: e.ids(file) if n in ids else e.numbers(file) for n, e in columns.items() if e not in known}
            table = pl.DataFrame({n: known[e] for n, e in columns.items()})
            tables.append(table.with_columns(pl.int_range(pl.len()).alias(ORIGIN) + len(self.parts) * 2**40))
            self.parts.append((file, {n: "+".join(e.sources) or e.text for n, e in columns.items()}))
        table, wanted = pl.concat(tables), table_kinds()[name].layout(tables[0].columns)
        filled = table.filter(pl.any_horizontal(pl.col(wanted.values).is_not_null()))
        if len(filled) < len(table):
            notices.append(f"{counted(len(table) - len(filled), 'row')} without a value left out")
        if filled.is_empty():
            raise UnusableInput(f"{file.path}: no row has a value of {', '.join(wanted.values)}; look at the mapping")
        used = named | {"t_s", *wanted.ids, *wanted.values, *wanted.optional}
        if unused := [column for column in file.frame.columns if column not in used]:
            notices.append(f"columns not used: {listed(unused, 12)}")
        for (tag,), rows in filled.partition_by("tag", as_dict=True).items() if name in ("truth", "fixes") else ():
            where = f"{file.path}: column {self.parts[-1][1]['t_s']}"
            refuse_lost_digits(where, rows, f"poses of tag {tag}", ", or add their column: t_s=secs+nsecs*1e-9")
        if mapping.body:
            if QUATERNION[0] not in filled.columns:
                raise UnusableInput(f"{name}: body = true without an attitude; expected qw, qx, qy, qz in columns")
            q, at = (
                filled.select(QUATERNION).to_numpy(),
                [mapping.offsets.get(t, (0.0, 0.0, 0.0)) for t in filled["tag"]],
            )
            turns = rotation_matrices(q / np.linalg.norm(q, axis=1, keepdims=True))
            moved = np.einsum("nij,nj->ni", turns, np.array(at, float))
            filled = filled.with_columns(pl.col(f"{a}_m") + pl.Series(x) for a, x in zip("xyz", moved.T, strict=True))
        filled = filled.sort("t_s", maintain_order=True) if len(tables) > 1 else filled
        if name in self.tables:
            filled = pl.concat([self.tables[name], filled], how="diagonal").sort("t_s", maintain_order=True)
        self.tables[name] = filled
        self.notices += [f"{name}: {line}" for line in notices]
        if places:
            rows = pl.DataFrame([expressions["anchor"].ids(whole), *(e.numbers(whole).alias(e.target) for e in places)])
            distinct = rows.with_row_index("").unique(rows.columns, keep="first", maintain_order=True)
            for row, anchor, *place in distinct.drop_nulls().rows():
                put(self.anchors, whole.location(row, "anchor"), anchor, tuple(x + 0.0 for x in place))

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


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The tables that the mappings make of a file of text or Parquet, or of a folder's files; raises UnusableInput."""
    source = Source()
    for mapping in asked.mappings:
        pattern = _HOLE.sub("*", mapping.file or "").lstrip("/")
        names = [one.relative_to(path).as_posix() for one in sorted(path.glob(pattern))] if pattern else [""]
        if not (found := _fitting(mapping.file or "", names)):
            raise UnusableInput(f"{path}: no folder with {mapping.file}; check the path")
        for file, holes in found:
            one = replace(mapping, tag=mapping.tag and _filled(mapping.tag, holes))
            read = partial(read_json, interval=asked.interval, skip=asked.skip) if name == "json" else read_rows
            rows, notices = read(path / file, one)
            source.notices += [line for line in notices if line not in source.notices]
            if mapping.table == "truth" and len(asked.mappings) > 1 and one.sources.isdisjoint(rows.frame.columns):
                source.notices.append(f"{rows.path.name}: no truth, which has none of the columns of its mapping")
            else:
                source.read(rows, one)
    return source


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
    for target, text in mapping.columns.items():
        holes = re.search(r"[^\s*/+()]*\{\w+\}[^\s*/+()]*", text)
        for name, found in _fitting(holes[0], names) if holes else [("", {})]:
            columns[_filled(target, found)] = text.replace(holes[0], f"`{name}`") if holes else text
    return replace(mapping, columns=columns)


def _asked(file: TableFile, mapping: TableMapping, named: set[str]) -> pl.Series:
    """Whether a mapping asks for each row; where one of several tables side by side ends, rows are empty."""
    wanted, frame = table_kinds()[mapping.table].layout(file.frame.columns), file.frame
    used = [n for n in frame.columns if n in named | {"t_s", *wanted.ids, *wanted.values}] or frame.columns
    full = [pl.col(n) != "" if frame[n].dtype == pl.String else pl.col(n).is_not_null() for n in used]
    asked = frame.select(asked=pl.any_horizontal(full).fill_null(False))["asked"]
    for name, values in mapping.where.items():
        texts = texts_of(frame[parsed("where", f"`{name}`", file).sources[0]])
        asked &= texts.is_in([str(value) for value in values]).fill_null(False)
    return asked


def _complete(
    file: TableFile, mapping: TableMapping, expressions: dict[str, Expression], sensor: str | None
) -> dict[str, Expression]:
    """The expressions of all columns of a table, of one sensor or of all; raises UnusableInput for one that lacks."""
    present, table = file.frame.columns, mapping.table
    wanted = table_kinds()[table].layout([*expressions, *(name for name in present if name not in expressions)])
    own = expressions.get("tag", Expression("tag", "tag", ("tag",)))
    given, column = mapping.tag or own.constant, next(iter(own.sources), "tag")
    texts = {*texts_of(file.frame[column])} - {None, ""} if given and column in present else set()
    tags = texts - {given}
    if tags and (mapping.tag or len(tags) > 1):
        alone = given if given in texts else min(tags)
        fix = f'leave it out, or read one alone: where = {{ {column} = ["{alone}"] }} in a file of --mapping'
        found = f"the column {column} has {listed(sorted(tags))}, which --tag {given} would overwrite"
        raise UnusableInput(f"{file.path}: {found}; {fix}")
    constants = {} if mapping.tag is None else {"tag": mapping.tag}
    if sensor is not None:
        each = [sensor] if len(wanted.ids) == 2 else [one.strip() for one in sensor.split(",")]
        if len(each) != len(wanted.ids) - 1:
            expected = f"[{','.join(wanted.ids[1:])}]" if wanted.ids[1:] else "none: it has no anchors or stations"
            raise UnusableInput(f"{table}: [{sensor}] in the columns; expected {expected}")
        constants |= dict(zip(wanted.ids[1:], each, strict=True))
    expressions |= {name: Expression(name, repr(text), constant=text) for name, text in constants.items()}
    known = ("t_s", *wanted.ids, *wanted.values, *wanted.optional)
    # Signal quality may have any name that is not like one of the others.
    quality = [name for name in expressions if name in wanted.quality and not get_close_matches(name, known, 1, 0.75)]
    if unknown := next((name for name in expressions if name not in (*known, *quality)), None):
        raise UnusableInput(f"{table}: has no column {unknown}{near(unknown, known)}; expected {listed(known, 12)}")
    expressions |= {n: parsed(n, f"`{n}`", file) for n in known if n not in expressions and n in present}
    for name in ("t_s", *wanted.ids, *(wanted.values or table_kinds()[table].least)):
        if name not in expressions:
            source = get_close_matches(name.rpartition("_")[0], [c for c in present if c not in known], 1, 0.3)
            example = f"{name}={(source or ['COLUMN'])[0]}" + " in UNIT" * ("_" in name)
            headless = any(re.fullmatch(r"[-+\d.,eE]+", name) for name in present)
            fix = f"add --columns '{example}'" + "; a file without a header: --header none" * headless
            fix = {
                "tag": "give --tag ID (in Python: tag=)",
                "z_m": "add an empty column where no height is measured",
            }.get(name, fix)
            found = f"found {listed(map(repr, present), 12)}"
            raise UnusableInput(f"{file.path}: {table} needs {name}, which no column gives; {found}; {fix}")
    if 0 < sum(name in expressions for name in QUATERNION) < 4:
        raise UnusableInput(f"{file.path}: has a part of qw, qx, qy, qz; expected all or none")
    return {name: expressions[name] for name in (*known, *quality) if name in expressions}
