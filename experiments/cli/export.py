"""`trackwright export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

Format = Literal["tum", "kitti", "csv", "ros2", "rrd"]


def export(
    run: Path, /, *, format: Format, out: Annotated[Path, Parameter(metavar="PATH")], tag: str | None = None,
    force: bool = False,
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

    for line in export_tracks(run, format, out, tag, force):
        print(line)
    return 0
