"""`trackwright import` and `trackwright export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from trackwright.experiments.cli.options import File, Folder, Name, Seconds

Table = Literal["ranges", "tdoa", "fixes", "bearings", "phases", "imu", "odometry", "truth"]


def import_source(
    source: Path, /, *, out: Folder, table: Table | None = None,
    columns: tuple[Annotated[str, Parameter(metavar="TARGET=COLUMN")], ...] = (), mapping: File | None = None,
    topic: str | None = None, tag: str | None = None, rig: File | None = None, format: Name | None = None,
    separator: str | None = None, decimal: Literal[".", ","] = ".",
    origin: Annotated[str, Parameter(metavar="start|S|DATE")] | None = None,
    transform: Annotated[str, Parameter(metavar="X,Y,Z,YAW,S", allow_leading_hyphen=True)] | None = None,
    align_truth: Annotated[tuple[Literal["xy"], ...] | None, Parameter(consume_multiple=True)] = None,
    interval: Seconds | None = None, skip_bad_lines: bool = False,
    header: Annotated[str, Parameter(metavar="LINE|none")] = "", skip: int = 0,
    missing: Annotated[tuple[str, ...], Parameter(metavar="MARK")] = (),
    thousands: Annotated[str, Parameter(metavar="MARK")] = "", encoding: str = "", replace: bool = False,
    messages: tuple[File, ...] = (),
) -> int:  # fmt: skip
    """Import CSV, JSON lines, ROS bags, MCAP, TUM, EuRoC or logs of UWB kits.

    Nothing is guessed: what is not mapped is skipped with a notice. docs/import.md has an example of each.

    Args:
        source: a file, or the folder of a ROS 2 bag.
        out: the recording folder to write, whose name is the recording's; tables are added to an existing one.
        table: what the rows or messages are.
        columns: TARGET=COLUMN for each column with another name, e.g. "range_m=distance in mm", "t_s=secs+nsecs*1e-9",
            "t_s=stamp in iso" or "in mm/dd/yyyy", "range_m[A1]=d1" for a column of each anchor; more in docs/import.md.
        mapping: a TOML file with these options for several tables, or a preset for logs of a data set or kit:
            crazyflie, crazyflie-tdoa, isas-walk, miluv, starloc, util.
        topic: of a bag.
        tag: the id of the tag, where no column has it.
        rig: a rig.toml, a table of anchors with columns anchor, x, y, z, or, with a preset, the makers' file of
            anchors; default: those in the log, if it has any.
        format: csv, ros, dwm1001, trek1000, fira, tum, kitti, euroc, json, or FILE.py:NAME of a function of your own;
            default: by name and first lines.
        separator: of the cells of a table in text, ' ' for blanks; default: the one in its header.
        decimal: the mark in the numbers of a table in text.
        origin: the time of the source that becomes t_s = 0 in every table: start (the earliest measurement), seconds
            on its clock, or a date such as 2026-05-01T12:00:00.25, UTC without a zone; default: times stay.
        transform: turns a truth about z by YAW, °, shifts it by X, Y, Z, m, and its times by S, s; S may be left out.
        align_truth: find these numbers by the readings of the recording in --out; a shift in z that they do not
            determine to 5 cm is left out where it may be zero, and in any case with xy after the option.
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
    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.core.wording import counted
    from trackwright.trackers.exchange.expressions import columns_of
    from trackwright.trackers.exchange.importing import Import
    from trackwright.trackers.exchange.mapping import TableMapping

    given = TableMapping(
        table=table or "ranges", columns=columns_of(columns), topic=topic, tag=tag, separator=separator,
        decimal=decimal, thousands=thousands, header=header, skip=skip, missing=list(missing), encoding=encoding,
    )  # fmt: skip
    tables, _ = Import(
        source, out, given, bool(table), mapping, format, rig, origin, transform, align_truth, interval,
        skip_bad_lines, messages, replace, notice,
    ).run()  # fmt: skip
    rows = ", ".join(f"{table} {counted(len(rows), 'row')}" for table, rows in tables.items())
    print(f"wrote {out}: {rows}")
    return 0


def export(
    run: Path, /, *, format: Literal["tum", "kitti", "csv", "ros2", "rrd"],
    out: Annotated[Path, Parameter(metavar="PATH")], tag: str | None = None, force: bool = False,
) -> int:  # fmt: skip
    """Export tracks or truth: TUM, KITTI, CSV, ROS 2 bag, Rerun.

    csv has every column of tracks.parquet; ros2 and rrd have the covariances of the positions. tum and kitti have
    positions alone (attitude: the identity where there is none); kitti has the times in a second file, NAME.times.txt.

    Args:
        run: the output folder of `track`; or a recording folder, of which the truth is written.
        format: of the file; ros2 needs the extra trackwright[ros], rrd the extra trackwright[rerun].
        out: the file; of several tracks in tum or kitti, and for ros2, a new folder.
        tag: this tag alone.
        force: replace a file that exists.
    """
    from trackwright.trackers.exchange.exported_tracks import export_tracks

    print("\n".join(export_tracks(run, format, out, tag, force)))
    return 0
