"""`trackwright import`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace as replaced
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from cyclopts import Parameter

from trackwright.experiments.cli.options import File, Folder, Seconds
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange.formats import FORMATS

if TYPE_CHECKING:
    import polars as pl

    from trackwright.trackers.exchange.mapping import TableMapping
    from trackwright.trackers.line.truth import KnotTimes
    from trackwright.trackers.recordings.folder import RecordingFolder

Table = Literal["ranges", "tdoa", "fixes", "bearings", "phases", "imu", "odometry", "truth"]
FormatName = Annotated[
    str,
    Parameter(
        metavar="NAME",
        help=f"of the file: {', '.join(FORMATS)}, or FILE.py:NAME of a function of your own, from its path to tables; "
        "default: by its name and first lines.",
        completer=lambda context: list(FORMATS),
    ),
]
"""A format by name, or a user's own."""


def import_source(
    source: Path, /, *, out: Folder, table: Table | None = None,
    columns: tuple[Annotated[str, Parameter(metavar="TARGET=COLUMN")], ...] = (), mapping: File | None = None,
    topic: str | None = None, tag: str | None = None, rig: File | None = None, format: FormatName | None = None,
    separator: str | None = None, decimal: Literal[".", ","] = ".",
    origin: Annotated[str, Parameter(metavar="start|S|DATE")] | None = None,
    transform: Annotated[str, Parameter(metavar="X,Y,Z,YAW,S", allow_leading_hyphen=True)] | None = None,
    align_truth: Annotated[tuple[Literal["xy"], ...] | None, Parameter(consume_multiple=True)] = None,
    path: bool = False, interval: Seconds | None = None, skip_bad_lines: bool = False,
    header: Annotated[str, Parameter(metavar="LINE|none")] = "", skip: int = 0,
    missing: Annotated[tuple[str, ...], Parameter(metavar="MARK")] = (),
    thousands: Annotated[str, Parameter(metavar="MARK")] = "", encoding: str = "", replace: bool = False,
    messages: tuple[File, ...] = (),
) -> int:  # fmt: skip
    """Import CSV, JSON lines, ROS bags, MCAP, TUM, EuRoC or logs of UWB kits.

    Nothing is guessed: what is not mapped is skipped with a notice. docs/import.md has an example of each.

    Args:
        source: a file, or the folder of a ROS 2 bag; with --path a recording folder.
        out: the recording folder to write, whose name is the recording's; tables are added to an existing one.
        table: what the rows or messages are.
        columns: TARGET=COLUMN for each column with another name, e.g. "range_m=distance_mm*0.001",
            "range_m=distance in mm", "t_s=stamp in iso" or "in mm/dd/yyyy", "t_s=secs+nsecs*1e-9",
            "anchor=header.frame_id", "range_m[A1]=d1" for a column of each anchor.
        mapping: a TOML file with the table, columns, topic, tag and form of several tables, instead of these options,
            or a preset for logs of a data set or kit: crazyflie, crazyflie-tdoa, isas-walk, miluv, starloc, util.
        topic: of a bag.
        tag: the id of the tag, where no column has it.
        rig: a rig.toml with the positions of anchors or stations, a table of anchors with columns anchor, x, y, z, or,
            with a preset, the makers' file of anchors; default: those in the log, if it has any.
        separator: of the cells of a table in text, ' ' for blanks; default: the one in its header.
        decimal: the mark in the numbers of a table in text.
        origin: the time of the source that becomes t_s = 0 in every table: start (the earliest measurement), seconds
            on its clock, or a date such as 2026-05-01T12:00:00.25, UTC without a zone; default: times stay.
        transform: brings a truth over to the frame of the rig and the clock of the readings: a turn about z by YAW, °,
            then a shift, m; S, seconds added to its times, may be left out.
        align_truth: find these numbers by the readings of the recording in --out; a shift in z that they do not
            determine to 5 cm is left out where it may be zero, and in any case with xy after the option.
        path: fit a truth along [path] of the rig.toml of a recording to its fixes, or to positions from its ranges, at
            a constant speed on each segment, with rests at the knots; --out gets the recording with this truth.
        interval: s between the lines of a log without times.
        header: the line of a table in text with the names of columns, or none; default: the first that is no comment.
        skip: lines above a table in text to leave out.
        missing: marks of missing values, such as N/A.
        thousands: the mark that groups thousands in numbers.
        encoding: of a text, such as cp1252; default: UTF-8, or UTF-16 with its mark.
        replace: a table that the recording in --out has already.
        skip_bad_lines: leave lines of a log that are not understood out, and count them.
        messages: .msg files, PACKAGE/msg/NAME.msg, of message types that a bag does not define.
    """
    if path:
        reading = (table, columns, mapping, topic, tag, rig, format, separator, origin, interval, messages)
        marks = (header, skip, missing, thousands, encoding, replace, transform, skip_bad_lines, decimal != ".")
        if align_truth is not None or any((*reading, *marks)):
            raise UnusableInput("--path: fits a truth to a recording folder; expected no other option but --out")
        return _fit_truth(source, out)
    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.core.data.seconds import moment
    from trackwright.trackers.core.wording import counted
    from trackwright.trackers.exchange.expressions import columns_of
    from trackwright.trackers.exchange.formats import format_of, has_tables
    from trackwright.trackers.exchange.imported import assembled, origin_of, read_geometry, read_source, save, since
    from trackwright.trackers.exchange.mapping import PRESETS, Asked, MappingFile, TableMapping, read_mapping
    from trackwright.trackers.exchange.truth_frame import with_truth_moved
    from trackwright.trackers.recordings.folder import read_recording
    from trackwright.trackers.recordings.rig_file import RIG_FILE

    preset = MappingFile() if mapping is None else read_mapping(mapping)
    name = format or ("csv" if any(one.file for one in preset.tables) else format_of(source))
    asked = [one for one in preset.tables if (one.topic is not None) == (name == "ros")] or preset.tables
    if left := [one.table for one in preset.tables if one not in asked]:
        kind = "other files" if name == "ros" else "bags"
        notice(f"notice: {mapping}: its entries for {kind} are skipped ({', '.join(left)})")
    own_tables = has_tables(name)
    notice(f"{source}: read as {name}" + ("" if format else "; another format: --format"))
    given = TableMapping(
        table=table or "ranges", columns=columns_of(columns), topic=topic, tag=tag, separator=separator,
        decimal=decimal, thousands=thousands, header=header, skip=skip, missing=list(missing), encoding=encoding,
    )  # fmt: skip
    mappings = _mappings(source, own_tables, table, given, asked)
    there = (out / RIG_FILE).is_file()
    if origin == "start" and there:
        words = "expected their origin, as its first import printed it: --origin SECONDS, or none where that had none"
        raise UnusableInput(f"--origin start: {out} has tables already; {words}")
    geometry, anchors, lines = read_geometry(rig, out, preset, given)
    try:
        imported = read_source(source, name, Asked(mappings, interval, skip_bad_lines, messages))
    except UnusableInput as problem:
        if mapping is None:
            raise
        text, add, _ = str(problem).partition("; add --columns")
        other = f"; another mapping? presets: {', '.join(sorted(PRESETS))}" if add else ""
        raise UnusableInput(f"{text}{other}") from None
    tables = imported.tables
    if origin is not None:
        begin = origin_of(origin, tables)
        tables = since(tables, begin)
        notice(f"notice: t_s = 0 is {moment(begin)} of {source}; give further tables the same --origin {begin!r}")
    # Recordings of one installation share its rig, but not their name.
    title = None if there else out.resolve().name
    for line in (*imported.notices, *lines):
        notice(f"notice: {line}")
    folder = assembled(title, geometry, tables, anchors or imported.anchors, preset)
    if transform is not None or align_truth is not None:
        recording = read_recording(out) if there else folder
        folder, said = with_truth_moved(folder, recording, transform, bool(align_truth))
        for line in said:
            notice(f"notice: {line}")
    written = save(folder, out, imported, replace)
    for line in written.notices:
        notice(f"notice: {out}: {line}")
    rows = ", ".join(f"{table} {counted(len(rows), 'row')}" for table, rows in tables.items())
    own = "" if set(tables) <= {*get_args(Table)} else " --tracker FILE.py:NAME"
    surveyed = "ranges" in written.tables and not written.rig.anchors
    follows = f"survey {out} --out SITE/rig.toml" if surveyed else f"check {out}{own}"
    print(f"wrote {out}: {rows}; next: trackwright {follows}")
    return 0


def _mappings(
    source: Path, own_tables: bool, table: str | None, given: TableMapping, tables: Sequence[TableMapping]
) -> list[TableMapping]:
    """The mappings of the tables of a source, by the options `given`, or the `tables` of the file of --mapping."""
    if tables:
        if own_tables:
            raise UnusableInput("--mapping: a file of this format has its tables; leave it out")
        if table or given != type(given)(table="ranges", tag=given.tag):
            raise UnusableInput(
                "--mapping and --table, --columns, --topic or the form of a text; give one or the other"
            )
        return [m if m.tag else replaced(m, tag=given.tag) for m in tables]
    if own_tables and (table or given.topic is not None):
        raise UnusableInput(f"{source}: a file of this format has its tables; leave --table and --topic out")
    if given.columns and not (table or own_tables):
        raise UnusableInput("--columns without --table; expected --table ranges, fixes, truth or another table")
    return [given] if table or own_tables else []


def _fit_truth(recording: Path, out: Path) -> int:
    """Writes the recording with a truth along its known path into the new folder `out`."""
    started = datetime.now(UTC)
    from trackwright.experiments.cli.console import read_with_notices
    from trackwright.experiments.cli.runtime import keep_programs, write_manifest
    from trackwright.trackers.recordings.folder import write_recording

    (folder,) = read_with_notices((recording,))
    keep_programs()
    # jax takes a second to import, which the help and a refused recording need not wait for.
    from trackwright.trackers.line.rows import fit_path_truth

    fitted, knot_times = fit_path_truth(folder)
    table = fitted.tables["truth"]
    _notice_deviation(folder, table)
    write_recording(fitted, out)
    write_manifest(out, sys.argv, {"recording": str(recording)}, started)
    print("\n".join(_knots_line(tag, times) for tag, times in knot_times.items()))
    print(f"wrote {out}: the recording with a fitted truth of {len(table)} rows; use it: evaluate … --truth {out}")
    return 0


def _knots_line(tag: str, fitted: KnotTimes) -> str:
    import numpy as np

    lengths = np.sqrt((np.diff(fitted.knots, axis=0) ** 2).sum(axis=1))
    segments = [
        f"{a:.2f}-{b:.2f} s ({n / (b - a):.2f} m/s)"
        for a, b, n in zip(fitted.departed, fitted.arrived, lengths, strict=True)
        if b > a
    ]
    return f"tag {tag}: {fitted.rms:.3f} m RMS about the path; segments {', '.join(segments)}"


def _notice_deviation(folder: RecordingFolder, table: pl.DataFrame) -> None:
    """Notice of the deviation from the recording's own truth, if it has one."""
    if "truth" not in folder.tables:
        return
    import numpy as np

    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.recordings.truth import TruePaths

    fitted = TruePaths.of_table(table, folder.name)
    for tag in sorted(folder.paths.number.keys() & fitted.number.keys()):
        times, positions = fitted.of_tag(tag)
        known, _ = folder.paths.at([tag], np.array([0, len(times)]), times)
        deviation = np.sqrt(((positions - known)[:, :2] ** 2).sum(axis=1))
        if np.isfinite(deviation).any():
            rms = np.sqrt(np.nanmean(deviation**2))
            notice(f"notice: tag {tag}: the recording's own truth is replaced; RMS deviation {rms:.3f} m")
