"""Files and frames of other programs made recordings: read, put together, checked as any, and written at once."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from importlib import import_module
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed, require
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.core.user_file import fault_of, from_file, split_name
from trackwright.trackers.exchange.formats import FORMATS, has_tables
from trackwright.trackers.exchange.mapping import Asked, Source, TableMapping, checked, columns_of, mapped_table
from trackwright.trackers.exchange.ros_reader import topics_in
from trackwright.trackers.recordings.atomic import atomic_write, beside
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording
from trackwright.trackers.recordings.kinds import KINDS, first_time
from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig
from trackwright.trackers.recordings.table_file import TableFile
from trackwright.trackers.recordings.tables import unwrapped_times


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The tables of a source in the format of this name, or a user's own; raises UnusableInput with file and line."""
    if not has_tables(name) and not asked.mappings:
        topics = f"; topics: {topics_in(path, asked.definitions)}" if name == "ros" else ""
        raise UnusableInput(
            f"{path}: no table given; expected --table, or a file of mappings: --mapping FILE.toml{topics}"
        )
    if name in FORMATS:
        module = import_module(f"trackwright.trackers.exchange.{FORMATS[name].module}")
        return module.read_source(path, name, asked)
    return _by_file(path, name, *asked.mappings)


def _by_file(path: Path, name: str, mapping: TableMapping) -> Source:
    """The tables that a user's function gives of a source: pandas or polars frames by table, with their columns."""
    if mapping.columns:
        raise UnusableInput(
            f"{path}: {listed(mapping.columns)}: a file of this format has its columns; leave --columns out"
        )
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
    source = Source()
    for table, frame in frames.items():
        try:
            source.add(table, *_of_frame(path, frame, TableMapping(table, tag=mapping.tag)))
        except UnusableInput as problem:
            raise UnusableInput(f"{name}: {str(problem).partition('; add --columns')[0]}") from problem
    return source


def _of_frame(path: Path, frame: Any, mapping: TableMapping) -> tuple[pl.DataFrame, list[str]]:
    """The table that the mapping makes of a pandas or polars frame, named as `path`, and notices."""
    return mapped_table(TableFile(path, _polars(frame, mapping.table)), checked(mapping))


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
    tables, notices = {}, []
    for table, frame in frames.items():
        try:
            mapping = TableMapping(table, columns_of((columns or {}).get(table, ())), tag=tag)
            tables[table], lines = _of_frame(Path(f"frame {table}"), frame, mapping)
        except UnusableInput as problem:
            raise UnusableInput(_in_python(str(problem), table)) from None
        notices += [f"{table}: {line}" for line in lines]
    if origin is not None:
        tables = since(tables, origin_of(str(origin), tables))
    folder = assembled(name, read_rig(Path(rig))[0] if isinstance(rig, (str, Path)) else rig, tables)
    with tempfile.TemporaryDirectory() as scratch:
        read = _written(folder, Path(scratch) / "recording")
    return replace(read, path=None, notices=(*notices, *read.notices))


def _in_python(message: str, table: str) -> str:
    """The message with arguments of `import_frames` in place of the command line's options."""
    message = re.sub(r"--columns ('[^']*')", rf"columns={{'{table}': [\1]}}", message)
    return message.replace("--tag ID", "tag='ID'").replace("--tag ", "tag=").replace("--columns", "columns=")


def _polars(frame: Any, table: str) -> pl.DataFrame:
    if isinstance(frame, pl.LazyFrame):
        return frame.collect()
    if isinstance(frame, pl.DataFrame):
        return frame
    if type(frame).__module__.partition(".")[0] != "pandas":
        raise UnusableInput(f"{table}: found {type(frame).__name__}; expected a pandas or polars frame")
    # An index that is not the row number holds values, often the times.
    frame = frame if type(frame.index).__name__ == "RangeIndex" else frame.reset_index()
    columns = {}
    for name in frame.columns:
        values = frame[name].to_numpy()
        if values.dtype.kind == "M":
            values = values.astype("datetime64[ns]")
        if values.dtype == object:
            missing = frame[name].isna().to_numpy()
            values = [None if lost else value for lost, value in zip(missing, values, strict=True)]
        columns[str(name)] = pl.Series(str(name), values)
    return pl.DataFrame(columns)


def assembled(
    name: str | None,
    rig: Rig | None,
    tables: Mapping[str, pl.DataFrame],
    anchors: Mapping[str, Sequence[float]] | None = None,
    offsets: Mapping[str, Sequence[float]] | None = None,
    bodies: Mapping[str, Sequence[str]] | None = None,
) -> RecordingFolder:
    """The recording of tables, with a rig or the anchors that a log names; raises UnusableInput for unknown sensors.

    Ranges of a rig that is given without anchors are those of a site to survey.
    `name`: of the recording, by default that of the rig. `offsets`, `bodies`: places of tags on their body, m, and the
    tags of each, of which those of the tables are added to the rig's.
    """
    to_survey = "ranges" if rig is not None and not rig.anchors else None
    if rig is None:
        rig = Rig(name or "imported", {key: np.array(place) for key, place in (anchors or {}).items()})
    there = {tag for table in tables.values() for tag in table["tag"].unique()}
    tags = {tag: Tag(offset=np.array(place)) for tag, place in (offsets or {}).items() if tag in there}
    on_bodies = {body: tuple(t for t in names if t in there) for body, names in (bodies or {}).items()}
    on_bodies = {body: names for body, names in on_bodies.items() if len(names) > 1}
    rig = replace(rig, name=name or rig.name, tags=tags | dict(rig.tags), bodies=on_bodies | dict(rig.bodies))
    for table, kind in KINDS.items():
        section, known = f"{kind.noun}s", kind.places(rig)
        for column in kind.sensors if table in tables and table != to_survey else ():
            ids = tables[table][column].unique(maintain_order=True).to_list()
            unknown = [sensor for sensor in ids if sensor not in known]
            if unknown:
                raise UnusableInput(
                    f"{table}: {column} {listed(map(repr, unknown))} without a position; the rig has "
                    f"{listed(known) or 'none'}; give a rig.toml with [{section}] by --rig (in Python: rig=)"
                    + ("" if known or table != "ranges" else ", or without, for trackwright survey to find them")
                )
    return RecordingFolder(rig.name, None, rig, dict(tables))


def save(folder: RecordingFolder, out: Path) -> RecordingFolder:
    """Writes the recording, or adds its tables to the recording in `out`; returns it as read back, with new notices.

    Nothing is written of one that cannot be read, and no table is replaced. Rows are checked in the order of the source
    and written in that of time. Raises UnusableInput.
    """
    if (out / RIG_FILE).is_file():
        return _added(folder, out)
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise UnusableInput(f"--out {out}: exists; expected a new folder, or a recording to add tables to")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside(out, Path.mkdir) as scratch:
            read = _written(folder, scratch / "recording")
            for name, table in folder.tables.items():
                if not table["t_s"].is_sorted():
                    _by_time(table).write_parquet(scratch / "recording" / f"{name}.parquet")
            if out.exists():
                out.rmdir()
            (scratch / "recording").rename(out)
    except OSError as error:
        raise UnusableInput(f"--out {out}: cannot be written ({error.strerror}); check its permissions") from error
    return replace(read, path=out)


def _added(folder: RecordingFolder, out: Path) -> RecordingFolder:
    there = _read(out)
    twice = [name for name in folder.tables if name in there.tables]
    if twice:
        raise UnusableInput(f"--out {out}: has the table {twice[0]} already; expected another table; remove it first")
    with tempfile.TemporaryDirectory() as scratch:
        read = _written(replace(there, tables=dict(there.tables) | dict(folder.tables)), Path(scratch) / out.name)
    for name, table in folder.tables.items():
        atomic_write(out / f"{name}.parquet", partial(pl.DataFrame.write_parquet, _by_time(table)))
    new = tuple(line for line in read.notices if line not in there.notices)
    return replace(read, path=out, notices=new)


def _by_time(table: pl.DataFrame) -> pl.DataFrame:
    times, _ = unwrapped_times(table["t_s"].to_numpy())
    return table.with_columns(t_s=times).sort("t_s", maintain_order=True)


def _written(folder: RecordingFolder, path: Path) -> RecordingFolder:
    """The recording after it was written to `path` and read back."""
    write_recording(folder, path)
    try:
        return _read(path)
    except UnusableInput as problem:
        raise UnusableInput(str(problem).replace(f"{path}/", "imported ").replace(str(path), "imported")) from problem


def _read(path: Path) -> RecordingFolder:
    """The recording; its ranges may be to anchors that are to be surveyed where its rig has none."""
    return read_recording(path, placed=bool(read_rig(path / RIG_FILE)[0].anchors))


def origin_of(text: str, tables: Mapping[str, pl.DataFrame]) -> float:
    """The origin, s on the clock of the source: `start`, the earliest measurement, a number, or a date.

    `start` is the earliest row where the tables have no measurements. A date without a time zone is UTC. Raises
    UnusableInput for another text.
    """
    if text == "start":
        return first_time(tables)
    try:
        seconds = float(text)
    except ValueError:
        try:
            date = datetime.fromisoformat(text)
        except ValueError:
            seconds = math.nan
        else:
            seconds = (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
    if not math.isfinite(seconds):
        raise UnusableInput(f"--origin {text}: expected start, seconds, or a date such as 2026-05-01T12:00:00.25")
    return seconds


def since(tables: Mapping[str, pl.DataFrame], origin: float) -> dict[str, pl.DataFrame]:
    """The tables with times, s, from the origin on."""
    return {name: table.with_columns(pl.col("t_s") - origin) for name, table in tables.items()}
