"""`trackwright export`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from trackwright.trackers.core.errors import UnusableInput, listed

if TYPE_CHECKING:
    from collections.abc import Iterable

    import polars as pl

    from trackwright.trackers.core.model.rig import Rig
    from trackwright.trackers.exchange.exported_tracks import ExportedTrack
    from trackwright.trackers.recordings.folder import RecordingFolder

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
    import polars as pl

    from trackwright.trackers.core.wording import counted
    from trackwright.trackers.exchange.exported_tracks import tracks_of, write_bag, write_rrd
    from trackwright.trackers.exchange.trajectories import write_trajectory, written_files
    from trackwright.trackers.recordings.atomic import atomic_write

    _refuse_existing([out], force)
    table, rigs, truths = _table(run, format)
    if tag is not None:
        known = sorted(table["tag"].cast(pl.String).unique())
        table = table.filter(pl.col("tag").cast(pl.String) == tag)
        if table.is_empty():
            raise UnusableInput(f"--tag {tag}: no row of it; found {listed(known)}")
    if format == "csv":
        _new(out)
        atomic_write(out, table.write_csv)
        print(f"wrote {out}: {counted(len(table), 'row')}")
        return 0
    tracks = tracks_of(table)
    if format == "ros2":
        print(f"wrote {out}: a ROS 2 bag with {listed(write_bag(out, tracks))}")
    elif format == "rrd":
        _new(out)
        true = [track for truth in truths for track in tracks_of(truth) if tag in (None, track.tag)]
        atomic_write(out, partial(write_rrd, tracks=tracks, truths=true, rigs=rigs))
        print(f"wrote {out}: {counted(len(tracks), 'track')}; see it: rerun {out}")
    else:
        files = _files(out, tracks, format)
        _refuse_existing([file for path in files for file in written_files(path, format)], force)
        for track, path in zip(tracks, files, strict=True):
            write_trajectory(track.poses, path, format)
            print(f"wrote {path}: {counted(len(track.poses), 'pose')}")
    return 0


def _refuse_existing(files: Iterable[Path], force: bool) -> None:
    if not force and (old := next((file for file in files if file.is_file()), None)):
        raise UnusableInput(f"--out {old}: exists; expected a new file; --force replaces it")


def _table(run: Path, format: Format) -> tuple[pl.DataFrame, dict[str, Rig], list[pl.DataFrame]]:
    """The table to export, and for the viewer the rigs and truths of the tracked recordings."""
    from trackwright.trackers.recordings.folder import read_recording
    from trackwright.trackers.recordings.rig_file import RIG_FILE
    from trackwright.trackers.recordings.tracks_table import read_tracks

    if not (run / RIG_FILE).is_file():
        known = _recordings(run) if format == "rrd" else []
        truths = [_truth(folder) for folder in known if "truth" in folder.tables]
        return read_tracks(run), {folder.name: folder.rig for folder in known}, truths
    recording = read_recording(run)
    if "truth" not in recording.tables:
        raise UnusableInput(f"{run}: has no truth table; expected a folder of `track`, or a recording with truth")
    return _truth(recording), {recording.name: recording.rig}, []


def _truth(folder: RecordingFolder) -> pl.DataFrame:
    import polars as pl

    return folder.tables["truth"].with_columns(recording=pl.lit(folder.name))


def _files(out: Path, tracks: list[ExportedTrack], format: Format) -> list[Path]:
    """The file of each track: `out` of one track, else its recording and tag in the folder `out`."""
    _new(out)
    if len(tracks) == 1 and out.suffix:
        return [out]
    out.mkdir(parents=True, exist_ok=True)
    return [out / f"{track.file_name}.{format}" for track in tracks]


def _new(out: Path) -> None:
    if out.is_dir() and any(out.iterdir()):
        raise UnusableInput(f"--out {out}: is a folder with content; expected a new file or an empty folder")


def _recordings(run: Path) -> list[RecordingFolder]:
    """The tracked recordings; a notice for each that cannot be read any more."""
    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.recordings.folder import read_recording
    from trackwright.trackers.recordings.tracks_table import source_paths

    recordings = []
    for path in source_paths(run):
        try:
            recordings.append(read_recording(path))
        except UnusableInput as problem:
            notice(f"notice: without its anchors and truth: {problem}")
    return recordings
