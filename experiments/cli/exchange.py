"""`trackwright import` and `trackwright export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, get_args

from cyclopts import Parameter

from trackwright.experiments.cli.options import File, Folder, Name, Numbers, Seconds
from trackwright.trackers.exchange.formats import FORMATS

Table = Literal["ranges", "tdoa", "fixes", "bearings", "phases", "imu", "odometry", "truth"]
FormatName = Annotated[
    str,
    Parameter(
        metavar="NAME",
        help=f"of the file: {', '.join(FORMATS)}, or FILE.py:NAME of a function of your own, from its path to tables; "
        "default: by its name and first lines.",
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
    tables, written = Import(
        source, out, given, bool(table), mapping, format, rig, origin, transform, align_truth, interval,
        skip_bad_lines, messages, replace, notice,
    ).run()  # fmt: skip
    rows = ", ".join(f"{table} {counted(len(rows), 'row')}" for table, rows in tables.items())
    own = "" if set(tables) <= {*get_args(Table)} else " --tracker FILE.py:NAME"
    surveyed = "ranges" in written.tables and not written.rig.anchors
    follows = f"survey {out} --out SITE/rig.toml" if surveyed else f"check {out}{own}"
    print(f"wrote {out}: {rows}; next: trackwright {follows}")
    return 0


Format = Literal["tum", "kitti", "csv", "ros2", "rrd", "c"]


def export(
    run: Path, /, *, format: Format, out: Annotated[Path, Parameter(metavar="PATH")], tag: str | None = None,
    tracker: Name | None = None, noise: File | None = None, force: bool = False,
) -> int:  # fmt: skip
    """Export tracks or truth: TUM, KITTI, CSV, ROS 2 bag, Rerun; or a tracker as C.

    csv has every column of tracks.parquet; ros2 and rrd have the covariances of the positions. tum and kitti have
    positions alone (attitude: the identity where there is none); kitti has the times in a second file, NAME.times.txt.

    c is a tracker for a recording folder, with its header, and the rows of the first tag as CSV, which `main` replays.

    Args:
        run: the output folder of `track`; or a recording folder, of which the truth is written.
        format: of the file; ros2 needs the extra trackwright[ros], rrd the extra trackwright[rerun].
        out: the file; of several tracks in tum or kitti, and for ros2, a new folder.
        tag: this tag alone.
        tracker: of c; default: as in `--noise`, else the one that fits the tables.
        noise: of c: a tuned.toml of `trackwright tune`.
        force: replace a file that exists.
    """
    if format != "c":
        from trackwright.trackers.exchange.exported_tracks import export_tracks

        print("\n".join(export_tracks(run, format, out, tag, force)))
        return 0
    from trackwright.trackers.c_source import write_c
    from trackwright.trackers.catalogue import fitting
    from trackwright.trackers.recordings.archives import require_new
    from trackwright.trackers.recordings.folder import read_recording
    from trackwright.trackers.recordings.selection import Selection

    require_new(out, "tracker.c", force)
    numbers = Numbers(tracker=tracker, noise=noise)
    numbers.read()
    folder = Selection(() if tag is None else (tag,)).of(read_recording(run))
    written = write_c(numbers.build(numbers.named or fitting(folder), folder), folder, out)
    print(f"wrote {', '.join(map(str, written))}")
    return 0
