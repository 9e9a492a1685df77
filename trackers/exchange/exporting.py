"""The export of tracks or truth into files of other programs."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Literal

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.exchange.exported_tracks import tracks_of, write_bag, write_rrd
from trackwright.trackers.exchange.trajectories import write_trajectory, written_files
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.trackers.recordings.rig_file import RIG_FILE
from trackwright.trackers.recordings.tracks_table import read_tracks, source_paths

Format = Literal["tum", "kitti", "csv", "ros2", "rrd"]


def export_tracks(run: Path, format: Format, out: Path, tag: str | None = None, force: bool = False) -> Iterator[str]:
    """Exports the tracks in a folder of `track`, or the truth of a recording; a line for each file.

    `format`: tum, kitti, csv, ros2 or rrd. `force`: replace a file that exists. Raises UnusableInput.
    """

    def refuse_existing(*files: Path) -> None:
        if out.is_dir() and any(out.iterdir()):
            raise UnusableInput(f"--out {out}: is a folder with content; expected a new file or an empty folder")
        if not force and (old := next((file for file in files if file.is_file()), None)):
            raise UnusableInput(f"--out {old}: exists; expected a new file; --force replaces it")

    refuse_existing(out)
    known: list[RecordingFolder] = []
    if is_recording := (run / RIG_FILE).is_file():
        known = [read_recording(run)]
    else:
        for path in source_paths(run) if format == "rrd" else ():
            try:
                known.append(read_recording(path))
            except UnusableInput as problem:
                yield f"notice: without its anchors and truth: {problem}"
    truths = [f.tables["truth"].with_columns(recording=pl.lit(f.name)) for f in known if "truth" in f.tables]
    if is_recording and not truths:
        raise UnusableInput(f"{run}: has no truth table; expected a folder of `track`, or a recording with truth")
    table = truths.pop() if is_recording else read_tracks(run)
    if tag is not None:
        tags = sorted(table["tag"].cast(pl.String).unique())
        table = table.filter(pl.col("tag").cast(pl.String) == tag)
        if table.is_empty():
            raise UnusableInput(f"--tag {tag}: no row of it; found {listed(tags)}")
    if format == "csv":
        atomic_write(out, table.write_csv)
        yield f"wrote {out}: {counted(len(table), 'row')}"
        return
    tracks = tracks_of(table)
    if format == "ros2":
        yield f"wrote {out}: a ROS 2 bag with {listed(write_bag(out, tracks))}"
    elif format == "rrd":
        true = [track for truth in truths for track in tracks_of(truth) if tag in (None, track.tag)]
        rigs = {folder.name: folder.rig for folder in known}
        atomic_write(out, partial(write_rrd, tracks=tracks, truths=true, rigs=rigs))
        yield f"wrote {out}: {counted(len(tracks), 'track')}; see it: rerun {out}"
    else:
        alone = len(tracks) == 1 and bool(out.suffix)
        files = [out] if alone else [out / f"{track.file_name}.{format}" for track in tracks]
        refuse_existing(*(file for path in files for file in written_files(path, format)))
        files[0].parent.mkdir(parents=True, exist_ok=True)
        for track, path in zip(tracks, files, strict=True):
            write_trajectory(track.poses, path, format)
            yield f"wrote {path}: {counted(len(track.poses), 'pose')}"
