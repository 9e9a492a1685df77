"""Files and frames of other programs made recordings: read, put together, checked as any, and written at once."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed, require
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.core.user_file import fault_of, from_file, split_name
from trackwright.trackers.exchange.expressions import UNITS, columns_of, parsed
from trackwright.trackers.exchange.formats import FORMATS, has_tables
from trackwright.trackers.exchange.mapping import ORIGIN, Asked, MappingFile, Source, TableMapping
from trackwright.trackers.exchange.text_tables import Reading, read_rows
from trackwright.trackers.recordings.atomic import beside
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording
from trackwright.trackers.recordings.kinds import first_time
from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig, rig_text
from trackwright.trackers.recordings.tables import SUFFIXES, TableFile, first_row, unwrapped_times


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The tables of a source in the format of this name, or a user's own; raises UnusableInput with file and line."""
    if not has_tables(name) and not asked.mappings and name != "ros":
        raise UnusableInput(f"{path}: no table given; expected --table, or a file of mappings: --mapping FILE.toml")
    if name in FORMATS:
        module = import_module(f"trackwright.trackers.exchange.{FORMATS[name].module}")
        return module.read_source(path, name, asked)  # type: ignore[no-any-return]
    function: Callable[[Path], Any] = from_file(name, "format", "function", lambda x: isinstance(x, FunctionType))
    try:
        frames = function(path)
    except UnusableInput:
        raise
    except Exception as error:
        fault = fault_of(error, Path(split_name(name)[0]))
        raise UnusableInput(f"{path}: {name} fails ({fault}); correct either") from error
    if not isinstance(frames, Mapping) or not frames:
        raise UnusableInput(f"{name}: gave {type(frames).__name__} of {path}; expected tables by name, one at least")
    (mapping,) = asked.mappings
    return _of_frames(frames, dict.fromkeys(frames, mapping.columns), mapping.tag, f"{name}: ")


def _of_frames(
    frames: Mapping[str, Any], columns: Mapping[str, Mapping[str, str]], tag: str | None, where: str
) -> Source:
    source = Source()
    for table, frame in frames.items():
        try:
            mapping = TableMapping(table=table, columns=columns.get(table, {}), tag=tag)
            file = TableFile(Path(f"{where}{table}"), _polars(frame, table))
        except UnusableInput as problem:
            raise UnusableInput(f"{where}{problem}") from None
        source.read(file, mapping)
    return source


def import_frames(
    frames: Mapping[str, Any],
    rig: Rig | Path | str | None = None,
    columns: Mapping[str, Sequence[str]] | None = None,
    tag: str | None = None,
    name: str | None = None,
    origin: float | str | None = None,
) -> RecordingFolder:
    """A recording from pandas or polars frames by table, checked as if it were read from a folder.

    `rig`: the geometry, or the path of a rig.toml; needed for readings of anchors and stations. `columns`: by table,
    expressions such as `range_m=distance_mm*0.001` or `t_s=stamp in ms` (docs/import.md); columns that have the name of
    their target need none. `tag`: the id of all rows, where no column has it. `name`: of the recording, by default that
    of the rig. `origin`: the time, s, that becomes `t_s` = 0 in all tables, a date, or `start`, the earliest
    measurement. Raises UnusableInput.
    """
    require(isinstance(frames, Mapping), "import_frames", frames, "frames by table, as {'ranges': frame}")
    fits = columns is None or isinstance(columns, Mapping)
    require(fits, "import_frames: columns", columns, "expressions by table, as {'ranges': ['range_m=distance in mm']}")
    source = _of_frames(frames, {table: columns_of(e) for table, e in (columns or {}).items()}, tag, "frame ")
    tables = source.tables if origin is None else since(source.tables, origin_of(str(origin), source.tables))
    folder = assembled(name, read_rig(Path(rig))[0] if isinstance(rig, (str, Path)) else rig, tables)
    with tempfile.TemporaryDirectory() as scratch:
        read = _written(folder, Path(scratch) / "recording", source)
    return replace(read, path=None, notices=(*source.notices, *read.notices))


def _polars(frame: Any, table: str) -> pl.DataFrame:
    if isinstance(frame, pl.LazyFrame | pl.DataFrame):
        return frame.lazy().collect()
    if type(frame).__module__.partition(".")[0] != "pandas":
        raise UnusableInput(f"{table}: found {type(frame).__name__}; expected a pandas or polars frame")
    # An index that is not the row number holds values, often the times.
    frame = frame if type(frame.index).__name__ == "RangeIndex" else frame.reset_index()
    columns = {}
    for name, column in frame.items():
        values = column.to_numpy()
        values = values.astype("datetime64[ns]") if values.dtype.kind == "M" else values
        if values.dtype == object:
            values = [None if lost else value for lost, value in zip(column.isna(), values, strict=True)]
        columns[str(name)] = pl.Series(values)
    return pl.DataFrame(columns)


def assembled(
    name: str | None,
    rig: Rig | None,
    tables: Mapping[str, pl.DataFrame],
    anchors: Mapping[str, Sequence[float]] | None = None,
    preset: MappingFile | None = None,
) -> RecordingFolder:
    """The recording of tables, with a rig, or the anchors of a log, and the bodies of a preset; or UnusableInput."""
    if rig is None and not anchors and "ranges" in tables:
        fix = "give a rig.toml or a table of them by --rig (in Python: rig=), a rig.toml without anchors for a survey"
        raise UnusableInput(f"ranges: no positions of anchors; {fix}")
    rig, preset = rig or Rig(name or "imported"), preset or MappingFile()
    there = {tag for table in tables.values() for tag in table["tag"].unique()}
    tags = {tag: Tag(offset=np.array(one["offset_m"])) for tag, one in preset.tags.items() if one and tag in there}
    carried = {body: tuple(t for t in one.get("tags", ()) if t in there) for body, one in preset.bodies.items()}
    rig = replace(
        rig,
        name=name or rig.name,
        anchors=rig.anchors or {key: np.array(place) for key, place in (anchors or {}).items()},
        tags=tags | dict(rig.tags),
        bodies={body: names for body, names in carried.items() if len(names) > 1} | dict(rig.bodies),
    )
    return RecordingFolder(rig.name, None, rig, dict(tables))


def save(folder: RecordingFolder, out: Path, source: Source, replaced: bool = False) -> RecordingFolder:
    """Writes the recording, or adds its tables to that in `out`; returns it as read back, with new notices.

    Rows are checked in the order of the source and written by time; nothing is written of what is refused.
    """
    there = _read(out) if (out / RIG_FILE).is_file() else None
    if there is None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UnusableInput(f"--out {out}: exists; expected a new folder, or a recording to add tables to")
    known = {} if there is None else dict(there.tables)
    if not replaced and (twice := [name for name in folder.tables if name in known]):
        raise UnusableInput(f"--out {out}: has the table {twice[0]} already; expected another; --replace replaces it")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside(out, Path.mkdir) as scratch:
            read = _written(replace(folder, tables=known | dict(folder.tables)), scratch / "recording", source)
            out.mkdir(exist_ok=True)
            for name in folder.tables:
                for suffix in SUFFIXES:
                    (out / f"{name}{suffix}").unlink(missing_ok=True)
            same = there is not None and rig_text(folder.rig) == rig_text(there.rig)
            for file in (*(f"{name}.parquet" for name in folder.tables), *([] if same else [RIG_FILE])):
                (scratch / "recording" / file).replace(out / file)
    except OSError as error:
        raise UnusableInput(f"--out {out}: cannot be written ({error.strerror}); check its permissions") from error
    before = () if there is None else there.notices
    return replace(read, path=out, notices=tuple(line for line in read.notices if line not in before))


def _written(folder: RecordingFolder, path: Path, source: Source) -> RecordingFolder:
    """The recording, written to `path` and read back; a refusal names the place in the source."""
    tables = {name: table.drop(ORIGIN, strict=False) for name, table in folder.tables.items()}
    write_recording(replace(folder, tables=tables), path)

    def original(match: re.Match[str]) -> str:
        return source.location(match[1], int(match[2]) - 1, match[3]) if match[1] in source.tables else match[0]

    try:
        read = _read(path)
    except UnusableInput as problem:
        cell = rf"{re.escape(str(path))}/(\w+)\.parquet: row (\d+), column (\w+)"
        raise UnusableInput(re.sub(cell, original, str(problem)).replace(str(path), "imported")) from problem
    for name, table in tables.items():
        if not table["t_s"].is_sorted():
            _by_time(table).write_parquet(path / f"{name}.parquet")
    return read


def _by_time(table: pl.DataFrame) -> pl.DataFrame:
    times, _ = unwrapped_times(table["t_s"].to_numpy())
    return table.with_columns(t_s=times).sort("t_s", maintain_order=True)


def _read(path: Path) -> RecordingFolder:
    """The recording; its ranges may be to anchors that are to be surveyed where its rig has none."""
    return read_recording(path, placed=bool(read_rig(path / RIG_FILE)[0].anchors))


def read_geometry(
    path: Path | None, out: Path, preset: MappingFile, reading: Reading
) -> tuple[Rig | None, dict[str, tuple[float, ...]], list[str]]:
    """The rig in `out`, or where that is empty, by `path`, or the positions, m, of anchors in `path`; and notices."""
    there = read_rig(out / RIG_FILE)[0] if (out / RIG_FILE).is_file() else None
    if path is None:
        return there, {}, []
    if there is not None and (there.anchors or there.stations):
        raise UnusableInput(f"--rig {path}: {out} has a rig.toml already; expected one; leave --rig out")
    if path.suffix != ".toml":
        return there, *((preset.positions(path), []) if preset.anchors else _read_anchors(path, reading))
    rig = read_rig(path)[0]
    if there is not None:
        rig = replace(rig, name=there.name, tags=dict(there.tags) | dict(rig.tags))
    return rig, {}, []


def _read_anchors(path: Path, reading: Reading) -> tuple[dict[str, tuple[float, ...]], list[str]]:
    """The positions, m, of anchors in a table with ids and columns as `X`, `x_mm`, `x [mm]`, `X (m)`; and notices."""
    file, notices = read_rows(path, reading)
    matches = {n: re.fullmatch(r"([xyz])(?:[\W_]+(\w+)\W*)?", n.strip().lower()) for n in file.frame.columns}
    axes = {m[1]: f"`{n}` in {m[2] or 'm'}" for n, m in matches.items() if m and (m[2] or "m") in UNITS["m"]}
    others = [name for name, match in matches.items() if not match]
    ids = [name for name in others if name.lower() in ("anchor", "anchor_id", "id", "name")] or others
    if {*axes} != {*"xyz"} or not ids or (len(ids) > 1 and ids == others):
        found, expected = listed(map(repr, matches), 12), "anchor, x, y, z (m; x_mm or x [mm]: mm), or a rig.toml"
        raise UnusableInput(f"--rig {path}: columns {found}; expected {expected}")
    places = [parsed("x_m", axes[axis], file).numbers(file).alias(axis) for axis in "xyz"]
    rows = pl.DataFrame([file.frame[ids[0]].cast(pl.String).str.strip_chars().alias("id"), *places])
    wrong = rows.select(
        (pl.col("id") == "") | ~pl.col("id").is_first_distinct() | pl.any_horizontal(pl.all().is_null())
    )
    if wrong.to_series().any():
        row = first_row(wrong.to_series())
        raise UnusableInput(f"--rig {file.location(row, ids[0])}: {rows.row(row)}; expected each id once, with x, y, z")
    units = f"ids are in column {ids[0]}, positions in {', '.join(axes[axis] for axis in 'xyz')}"
    return {key: tuple(place) for key, *place in rows.rows()}, [f"{path}: {line}" for line in (*notices, units)]


def origin_of(text: str, tables: Mapping[str, pl.DataFrame]) -> float:
    """The origin, s: a number, a date, UTC without a time zone, or `start`, the earliest measurement or row."""
    if text == "start":
        return first_time({name: _by_time(table) for name, table in tables.items()})
    with suppress(ValueError):
        if math.isfinite(seconds := float(text)):
            return seconds
    with suppress(ValueError):
        date = datetime.fromisoformat(text)
        return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    raise UnusableInput(f"--origin {text}: expected start, seconds, or a date such as 2026-05-01T12:00:00.25")


def since(tables: Mapping[str, pl.DataFrame], origin: float) -> dict[str, pl.DataFrame]:
    """The tables with times, s, from the origin on."""
    return {name: table.with_columns(pl.col("t_s") - origin) for name, table in tables.items()}
