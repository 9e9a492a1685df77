"""Recordings made from tables that were read elsewhere: put together, checked as any recording, written at once."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.mapped_table import mapped_table
from trackwright.trackers.exchange.mapping import TableMapping, checked, columns_of
from trackwright.trackers.exchange.origin import origin_of, since
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.beside import beside
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig
from trackwright.trackers.recordings.table_file import TableFile


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
    tables, notices = {}, []
    for table, frame in frames.items():
        try:
            mapping = checked(TableMapping(table, columns_of((columns or {}).get(table, ())), tag=tag))
            tables[table], found = mapped_table(TableFile(Path(f"frame {table}"), _polars(frame, table)), mapping)
        except UnusableInput as problem:
            raise UnusableInput(_in_python(str(problem), table)) from None
        notices += [f"{table}: {line}" for line in found]
    if origin is not None:
        tables = since(tables, origin_of(str(origin), tables))
    folder = assembled(name, read_rig(Path(rig))[0] if isinstance(rig, (str, Path)) else rig, tables)
    with tempfile.TemporaryDirectory() as scratch:
        read = _written(folder, Path(scratch) / "recording")
    return replace(read, path=None, notices=(*notices, *read.notices))


def _in_python(message: str, table: str) -> str:
    """The message with arguments of `import_frames` in place of the command line's options."""
    message = re.sub(r"--columns ('[^']*')", rf"columns={{'{table}': [\1]}}", message)
    return message.replace("--tag ID", "tag='ID'").replace("--columns", "columns=")


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
    anchors: Mapping[str, tuple[float, float, float]] | None = None,
) -> RecordingFolder:
    """The recording of tables, with a rig or the anchors that a log names; raises UnusableInput for unknown sensors.

    `name`: of the recording, by default that of the rig.
    """
    if rig is None:
        rig = Rig(name or "imported", {key: np.array(place) for key, place in (anchors or {}).items()})
    rig = replace(rig, name=name or rig.name)
    for table, kind in KINDS.items():
        section, known = f"{kind.noun}s", kind.places(rig)
        for column in kind.sensors if table in tables else ():
            found = tables[table][column].unique(maintain_order=True).to_list()
            unknown = [sensor for sensor in found if sensor not in known]
            if unknown:
                raise UnusableInput(
                    f"{table}: {column} {listed(map(repr, unknown))} without a position; the rig has "
                    f"{listed(known) or 'none'}; give a rig.toml with [{section}] by --rig (in Python: rig=)"
                )
    return RecordingFolder(rig.name, None, rig, dict(tables))


def save(folder: RecordingFolder, out: Path) -> RecordingFolder:
    """Writes the recording, or adds its tables to the recording in `out`; returns it as read back, with new notices.

    Nothing is written of one that cannot be read, and no table is replaced. Raises UnusableInput.
    """
    if (out / RIG_FILE).is_file():
        return _added(folder, out)
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise UnusableInput(f"--out {out}: exists; expected a new folder, or a recording to add tables to")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside(out, Path.mkdir) as scratch:
            read = _written(folder, scratch / "recording")
            if out.exists():
                out.rmdir()
            (scratch / "recording").rename(out)
    except OSError as error:
        raise UnusableInput(f"--out {out}: cannot be written ({error.strerror}); check its permissions") from error
    return replace(read, path=out)


def _added(folder: RecordingFolder, out: Path) -> RecordingFolder:
    there = read_recording(out)
    twice = [name for name in folder.tables if name in there.tables]
    if twice:
        raise UnusableInput(f"--out {out}: has the table {twice[0]} already; expected another table; remove it first")
    with tempfile.TemporaryDirectory() as scratch:
        read = _written(replace(there, tables=dict(there.tables) | dict(folder.tables)), Path(scratch) / out.name)
    for name, table in folder.tables.items():
        atomic_write(out / f"{name}.parquet", partial(pl.DataFrame.write_parquet, table))
    new = tuple(line for line in read.notices if line not in there.notices)
    return replace(read, path=out, notices=new)


def _written(folder: RecordingFolder, path: Path) -> RecordingFolder:
    """The recording after it was written to `path` and read back."""
    write_recording(folder, path)
    try:
        return read_recording(path)
    except UnusableInput as problem:
        raise UnusableInput(str(problem).replace(f"{path}/", "imported ").replace(str(path), "imported")) from problem
