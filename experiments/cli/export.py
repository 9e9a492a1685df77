"""`trackwright export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from trackwright.experiments.cli.options import File, Numbers, Tracker, TrackOptions

Format = Literal["tum", "csv", "c"]


def export(
    run: Path, /, *, format: Format, out: Annotated[Path, Parameter(metavar="PATH")], tag: str | None = None,
    tracker: Tracker | None = None, noise: File | None = None, force: bool = False,
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
        force: replace a file that exists.
    """
    if format == "c":
        return _export_c(run, out, tag, tracker, noise, force)
    from trackwright.trackers.exchange.trajectories import export_tracks

    print(export_tracks(run, format, out, tag, force))
    return 0


def _export_c(run: Path, out: Path, tag: str | None, tracker: str | None, noise: Path | None, force: bool) -> int:
    from trackwright.trackers.c_source import write_c
    from trackwright.trackers.catalogue import build, fitting
    from trackwright.trackers.recordings.archives import require_new
    from trackwright.trackers.recordings.folder import read_recording
    from trackwright.trackers.recordings.selection import Selection

    require_new(out, "tracker.c", force)
    options = TrackOptions(out=out.parent, numbers=Numbers(tracker=tracker), noise=noise)
    options.read()
    folder = Selection(() if tag is None else (tag,)).of(read_recording(run))
    written = write_c(options.valued(build(options.named or fitting(folder), folder)), folder, out)
    print(f"wrote {', '.join(map(str, written))}")
    return 0
