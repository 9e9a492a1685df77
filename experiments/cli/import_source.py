"""`trackwright import`."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from cyclopts import Parameter

from trackwright.experiments.cli.options import File, Folder, Readings
from trackwright.trackers.core.errors import UnusableInput

Table = Literal["ranges", "tdoa", "fixes", "bearings", "phases", "imu", "odometry", "truth"]
FormatName = Annotated[
    str,
    Parameter(
        metavar="NAME",
        help="of the file: csv, json, tum, ros, or FILE.py:NAME of a function of your own, from its path to tables; "
        "default: by its ending, else csv.",
        completer=lambda context: ["csv", "json", "tum", "ros"],
    ),
]
"""A format by name, or a user's own."""


def import_source(
    source: Path, /, *, out: Folder, table: Table | None = None,
    columns: tuple[Annotated[str, Parameter(metavar="TARGET=COLUMN")], ...] = (), mapping: File | None = None,
    topic: str | None = None, tag: str | None = None, rig: File | None = None, format: FormatName | None = None,
    separator: str | None = None, decimal: Literal[".", ","] = ".",
    transform: Annotated[str, Parameter(metavar="X,Y,Z,YAW,S", allow_leading_hyphen=True)] | None = None,
    align_truth: bool = False,
    path: bool = False, header: Annotated[str, Parameter(metavar="LINE|none")] = "", skip: int = 0,
    missing: Annotated[tuple[str, ...], Parameter(metavar="MARK")] = (),
    thousands: Annotated[str, Parameter(metavar="MARK")] = "", encoding: str = "", replace: bool = False,
) -> int:  # fmt: skip
    """Import CSV, JSON lines, ROS bags, MCAP, TUM or logs of UWB kits.

    Nothing is guessed: what is not mapped is skipped with a notice. docs/import.md has an example of each.

    Args:
        source: a file, or the folder of a ROS 2 bag; with --path a recording folder.
        out: the recording folder to write, whose name is the recording's; tables are added to an existing one.
        table: what the rows or messages are.
        columns: TARGET=COLUMN for each column with another name, e.g. "range_m=distance_mm*0.001",
            "range_m=distance in mm", "t_s=stamp in iso" or "in mm/dd/yyyy", "t_s=secs+nsecs*1e-9",
            "anchor=header.frame_id", "range_m[A1]=d1" for a column of each anchor.
        mapping: a TOML file with the table, columns, topic, tag and form of several tables, instead of these options
            (--columns and --tag add to it), or a preset: dwm1001, isas-walk.
        topic: of a bag.
        tag: the id of the tag, where no column has it.
        rig: a rig.toml with the positions of anchors or stations, or a table of anchors with columns anchor, x, y, z.
        separator: of the cells of a table in text, ' ' for blanks; default: the one in its header.
        decimal: the mark in the numbers of a table in text.
        transform: brings a truth over to the frame of the rig and the clock of the readings: a turn about z by YAW, °,
            then a shift, m; S, seconds added to its times, may be left out.
        align_truth: find these numbers by the readings of the recording in --out; a shift in z without which
            errors are about as small is left out.
        path: fit a truth along [path] of the rig.toml of a recording to its fixes, or to positions from its ranges, at
            a constant speed on each segment, with rests at the knots; --out gets the recording with this truth.
        header: the line of a table in text with the names of columns, or none; default: the first that is no comment.
        skip: lines above a table in text to leave out.
        missing: marks of missing values, such as N/A.
        thousands: the mark that groups thousands in numbers.
        encoding: of a text, such as cp1252; default: UTF-8, or UTF-16 with its mark.
        replace: a table that the recording in --out has already.
    """
    if path:
        reading = (table, columns, mapping, topic, tag, rig, format, separator)
        marks = (header, skip, missing, thousands, encoding, replace, transform, decimal != ".")
        if align_truth or any((*reading, *marks)):
            raise UnusableInput("--path: fits a truth to a recording folder; expected no other option but --out")
        return _fit_truth(source, out)
    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.core.wording import counted
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
    tables, written = import_file(source, out, mappings, tag, format, rig, transform, align_truth, replace, notice)
    rows = ", ".join(f"{table} {counted(len(rows), 'row')}" for table, rows in tables.items())
    own = "" if set(tables) <= {*get_args(Table)} else " --tracker FILE.py:NAME"
    surveyed = "ranges" in written.tables and not written.rig.anchors
    follows = f"survey {out} --out SITE/rig.toml" if surveyed else f"check {out}{own}"
    print(f"wrote {out}: {rows}; next: trackwright {follows}")
    return 0


def _fit_truth(recording: Path, out: Path) -> int:
    """Writes the recording with a truth along its known path into the new folder `out`."""
    started = datetime.now(UTC)
    from trackwright.experiments.cli.console import keep_programs, notices, prepared, write_manifest
    from trackwright.trackers.recordings.folder import write_recording

    (folder,) = prepared((recording,), Readings(), check=False)
    keep_programs()
    # jax takes a second to import, which the help and a refused recording need not wait for.
    from trackwright.trackers.line.rows import fit_path_truth

    fitted, knot_times = fit_path_truth(folder)
    if "truth" in folder.tables:
        notices([f"{recording}: its own truth is replaced"])
    write_recording(fitted, out)
    write_manifest(out, {"recording": str(recording)}, started)
    for tag, times in knot_times.items():
        passed = zip(times.departed, times.arrived, strict=True)
        segments = ", ".join(f"{begin:.2f}-{end:.2f} s" for begin, end in passed if end > begin)
        print(f"tag {tag}: {times.rms:.3f} m RMS about the path; segments {segments}")
    rows = len(fitted.tables["truth"])
    print(f"wrote {out}: the recording with a fitted truth of {rows} rows; use it: evaluate … --truth {out}")
    return 0
