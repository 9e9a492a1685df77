"""Files of other programs read as tables of a recording: what kind of file it is, and its tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.exchange.mapped_table import mapped_table
from trackwright.trackers.exchange.mapping import TableMapping
from trackwright.trackers.exchange.ros_reader import message_columns, opened, topics_of
from trackwright.trackers.exchange.serial_logs import TIME, log_kind, read_log
from trackwright.trackers.exchange.trajectory_files import kind_of, read_trajectory
from trackwright.trackers.recordings.input_file import beginning, file_bytes
from trackwright.trackers.recordings.table_file import SUFFIXES, TableFile, read_table_file

SourceKind = Literal["csv", "tum", "kitti", "euroc", "ros", "dwm1001", "trek1000"]

_FORMATS = (
    "a table (.csv, .csv.gz, .parquet), a ROS bag (.bag, .db3, .mcap, or the folder of a ROS 2 bag), a log of a "
    "DWM1001 or TREK1000 kit, or a TUM, KITTI or EuRoC trajectory"
)


@dataclass
class Source:
    """Tables by name, notices on how they were read, and the positions of anchors, m, if the source has them."""

    tables: dict[str, pl.DataFrame] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)
    anchors: dict[str, tuple[float, float, float]] = field(default_factory=dict)


def source_kind(path: Path) -> SourceKind:
    """What kind of file it is, by its name or else its first lines; raises UnusableInput where that is not clear."""
    name = path.name.lower()
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return "ros"
        raise UnusableInput(f"{path}: is a folder without metadata.yaml; expected a ROS 2 bag, or a file")
    if name.endswith((".bag", ".mcap", ".db3")):
        return "ros"
    try:
        begin = beginning(path, 20_000).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if name.endswith(SUFFIXES) and not begin.startswith("#timestamp"):
        return "csv"
    try:
        return log_kind(begin) or kind_of(path)
    except UnusableInput:
        raise UnusableInput(f"{path}: no format is recognised; expected {_FORMATS}; --format names one") from None


def read_source(
    path: Path,
    kind: SourceKind,
    mappings: Sequence[TableMapping],
    interval: float | None = None,
    skip: bool = False,
    definitions: Sequence[Path] = (),
) -> Source:
    """The tables that the mappings make of a source; logs need a tag alone. Raises UnusableInput with file and line."""
    if kind == "dwm1001" or kind == "trek1000":
        (mapping,) = mappings
        time = mapping.columns.get("t_s", TIME)
        if mapping.columns.keys() - {"t_s"} or time.source != "time":
            raise UnusableInput(f"{path}: {listed(mapping.columns)}: a log has one column, t_s=time, as t_s=time in ms")
        log = read_log(path, kind, mapping.tag, interval, skip, time)
        return Source(log.tables(), log.notices, log.anchors)
    if not mappings:
        topics = ""
        if kind == "ros":
            with opened(path, definitions) as reader:
                topics = f"; topics: {topics_of(reader)}"
        raise UnusableInput(
            f"{path}: no table given; expected --table, or a file of mappings: --mapping FILE.toml{topics}"
        )
    found = Source()
    if kind == "ros":
        with opened(path, definitions) as reader:
            for mapping in mappings:
                if mapping.topic is None:
                    raise UnusableInput(f"{path}: no --topic for {mapping.table}; expected one of {topics_of(reader)}")
                file, whole = message_columns(reader, path, mapping)
                _add(found, mapping.table, *mapped_table(file, whole))
        return found
    for mapping in mappings:
        if kind == "csv":
            separator = mapping.separator or _separator_of(path, mapping.decimal)
            if mapping.separator is None and separator != ",":
                found.notices.append(f"cells are read as separated by {separator!r}; another mark: --separator")
            file = read_table_file(path) if separator == "," else _separated(path, separator)
            _add(found, mapping.table, *mapped_table(replace(file, decimal=mapping.decimal), mapping))
        else:
            _add(found, mapping.table, *_poses(path, kind, mapping))
    return found


def _add(source: Source, name: str, table: pl.DataFrame, notices: Sequence[str]) -> None:
    """A table of the source, after the rows of another part of it."""
    if name in source.tables:
        table = pl.concat([source.tables[name], table], how="diagonal").sort("t_s", maintain_order=True)
    source.tables[name] = table
    source.notices += [f"{name}: {line}" for line in notices]


def _poses(path: Path, kind: SourceKind, mapping: TableMapping) -> tuple[pl.DataFrame, list[str]]:
    if mapping.table not in ("truth", "fixes"):
        raise UnusableInput(f"{path}: poses are a table truth or fixes, not {mapping.table}; give --table truth")
    if mapping.columns:
        raise UnusableInput(f"{path}: {listed(mapping.columns)}: the columns of {kind} are fixed; leave --columns out")
    if mapping.tag is None:
        raise UnusableInput(f"{path}: {kind} files do not name the tag; give it: --tag ID")
    poses = read_trajectory(path, kind)  # type: ignore[arg-type]
    table = poses.to_polars(mapping.tag)
    return table if mapping.table == "truth" else table.select("t_s", "tag", "x_m", "y_m", "z_m"), list(poses.notices)


def _separator_of(path: Path, decimal: str) -> str:
    """A semicolon or tab where the header has one and no comma, or numbers have decimal commas; else a comma."""
    if path.name.lower().endswith((".gz", ".parquet")):
        return ","
    head = beginning(path, 20_000).decode("utf-8-sig", errors="replace").partition("\n")[0]
    return next((mark for mark in ";\t" if mark in head and (decimal == "," or "," not in head)), ",")


def _separated(path: Path, separator: str) -> TableFile:
    """The columns of a text file with another separator between its cells."""
    if len(separator) != 1:
        raise UnusableInput(f"--separator {separator!r}; expected one character, such as ';'")
    try:
        text = file_bytes(path).decode("utf-8-sig")
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        raise UnusableInput(f"{path}: is not UTF-8 text at byte {error.start}; export it again in UTF-8") from error
    reader = csv.reader(io.StringIO(text), delimiter=separator)
    rows, lines = [], []
    try:
        names = [name.strip() for name in next(reader, [])]
        for row in reader:
            if len(row) == len(names):
                rows.append(row)
                lines.append(reader.line_num)
            elif any(cell.strip() for cell in row):
                raise UnusableInput(
                    f"{path}: line {reader.line_num} has {len(row)} cells; expected {len(names)} as in line 1"
                )
    except csv.Error as error:
        reason = str(error).partition(" - ")[0]
        raise UnusableInput(
            f"{path}: line {reader.line_num}: {reason}; expected one row a line; export it again"
        ) from error
    if not rows or len(set(names)) < len(names):
        raise UnusableInput(f"{path}: no rows, or a name twice in line 1: {listed(names)}; expected a header and rows")
    return TableFile(path, pl.DataFrame(rows, schema=dict.fromkeys(names, pl.String), orient="row"), lines)
