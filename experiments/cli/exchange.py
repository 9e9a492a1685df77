"""`trackwright import` and `trackwright export`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from trackwright.experiments.cli.options import File, Folder, Name, Numbers
from trackwright.trackers.core.errors import UnusableInput


def import_source(
    source: Path, /, *, out: Folder,
    table: Literal["ranges", "tdoa", "fixes", "bearings", "phases", "imu", "odometry", "truth"] | None = None,
    columns: tuple[Annotated[str, Parameter(metavar="TARGET=COLUMN")], ...] = (), mapping: File | None = None,
    topic: str | None = None, tag: str | None = None, rig: File | None = None, format: Name | None = None,
    separator: str | None = None, decimal: Literal[".", ","] = ".",
    transform: Annotated[str, Parameter(metavar="X,Y,Z,YAW,S", allow_leading_hyphen=True)] | None = None,
    align_truth: bool = False, header: Annotated[str, Parameter(metavar="LINE|none")] = "", skip: int = 0,
    missing: Annotated[tuple[str, ...], Parameter(metavar="MARK")] = (),
    thousands: Annotated[str, Parameter(metavar="MARK")] = "", encoding: str = "", replace: bool = False,
) -> int:  # fmt: skip
    """Import CSV, JSON lines, ROS bags, MCAP, TUM or logs of UWB kits.

    Nothing is guessed: what is not mapped is skipped with a notice. docs/import.md has an example of each.

    Args:
        source: a file, or the folder of a ROS 2 bag.
        out: the recording folder to write, whose name is the recording's; tables are added to an existing one.
        table: what the rows or messages are.
        columns: TARGET=COLUMN for each column with another name, e.g. "range_m=distance_mm\\*0.001",
            "range_m=distance in mm", "t_s=stamp in iso" or "in mm/dd/yyyy", "t_s=secs+nsecs\\*1e-9",
            "anchor=header.frame_id", "range_m[A1]=d1" for a column of each anchor.
        mapping: a TOML file with the table, columns, topic, tag and form of several tables, instead of these options
            (--columns and --tag add to it), or a preset: dwm1001, isas-walk.
        topic: of a bag.
        tag: the id of the tag, where no column has it.
        rig: a rig.toml with the positions of anchors or stations, or a table of anchors with columns anchor, x, y, z.
        format: csv, json, tum, ros, or FILE.py:NAME of a function of your own, from a path to tables; default: by the
            file's ending, else csv.
        separator: of the cells of a table in text, ' ' for blanks; default: the one in its header.
        decimal: the mark in the numbers of a table in text.
        transform: brings a truth over to the frame of the rig and the clock of the readings: a turn about z by YAW, °,
            then a shift, m; S, seconds added to its times, may be left out.
        align_truth: find these numbers by the readings of the recording in --out; a shift in z without which
            errors are about as small is left out.
        header: the line of a table in text with the names of columns, or none; default: the first that is no comment.
        skip: lines above a table in text to leave out.
        missing: marks of missing values, such as N/A.
        thousands: the mark that groups thousands in numbers.
        encoding: of a text, such as cp1252; default: UTF-8, or UTF-16 with its mark.
        replace: a table that the recording in --out has already.
    """
    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.core.errors import counted
    from trackwright.trackers.exchange.importing import import_file
    from trackwright.trackers.exchange.mapping import TableMapping, read_mapping
    from trackwright.trackers.exchange.text_tables import columns_of

    form: dict[str, Any] = {
        "topic": topic, "separator": separator, "thousands": thousands, "header": header, "skip": skip,
        "missing": list(missing), "encoding": encoding, "decimal": "" if decimal == "." else decimal,
    }  # fmt: skip
    form = {name: value for name, value in form.items() if value}
    if (form and table is None) or (table and mapping):
        option = next(iter(form), "mapping")
        raise UnusableInput(f"--{option}: a file of --mapping has tables with their form; give --table or --mapping")
    added, tables_of = columns_of(columns), [] if mapping is None else read_mapping(mapping)
    mappings = [dataclasses.replace(m, tag=m.tag or tag, columns={**m.columns, **added}) for m in tables_of]
    if table is not None:
        mappings = [TableMapping(table=table, columns=added, tag=tag, **form)]
    tables, _ = import_file(source, out, mappings, tag, format, rig, transform, align_truth, replace, notice)
    rows = ", ".join(f"{table} {counted(len(rows), 'row')}" for table, rows in tables.items())
    print(f"wrote {out}: {rows}")
    return 0


def export(
    run: Path, /, *, format: Literal["tum", "csv", "c"], out: Annotated[Path, Parameter(metavar="PATH")],
    tag: str | None = None, tracker: Name | None = None, noise: File | None = None, force: bool = False,
) -> int:  # fmt: skip
    """Export tracks or truth as TUM or CSV; or a tracker as C.

    csv has every column of tracks.parquet; tum has poses (attitude: the identity where there is none).

    c is a tracker for a recording folder, with its header, and the rows of the first tag as CSV, which `main` replays.

    Args:
        run: the output folder of `track`; or a recording folder, of which the truth is written.
        format: of the file.
        out: the file.
        tag: this tag alone; tum holds one.
        tracker: of c; default: as in `--noise`, else the one that fits the tables.
        noise: of c: a tuned.toml of `trackwright tune`.
        force: replace files that exist.
    """
    if format != "c":
        from trackwright.trackers.exchange.trajectories import export_tracks

        print(export_tracks(run, format, out, tag, force))
        return 0
    from trackwright.experiments.cli.console import chosen_tracker
    from trackwright.trackers.c_source import write_c
    from trackwright.trackers.recordings.folder import Selection, read_recording

    numbers, part = Numbers(tracker=tracker, noise=noise), Selection(() if tag is None else (tag,))
    folder = part.of(read_recording(run))
    numbers.read()
    written = write_c(numbers.build(chosen_tracker([folder], numbers), folder), folder, out, force=force)
    print(f"wrote {', '.join(map(str, written))}")
    return 0
