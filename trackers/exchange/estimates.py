"""Estimates of any program and true paths in files, trajectories or tables as of `track`, and their errors by track."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.expressions import numbers_of
from trackwright.trackers.exchange.formats import beginning_of
from trackwright.trackers.exchange.mapping import refuse_lost_digits
from trackwright.trackers.exchange.pose_errors import TrajectoryErrors, compare_trajectories, step_of
from trackwright.trackers.exchange.trajectories import read_trajectory, trajectory_of_table
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tables import SUFFIXES, check_stds, read_table_file
from trackwright.trackers.recordings.tracks_table import is_bearing

_TEXT = ("recording", "tag", "station", "status", "wrapped")


def read_estimates(path: Path) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """The estimates in a TUM, KITTI or EuRoC file, or a table with columns that `track` writes, and notices."""
    name = path.name.lower()
    if not name.endswith(SUFFIXES) or (name.endswith(".csv") and "t_s" not in beginning_of(path).partition("\n")[0]):
        trajectory = read_trajectory(path)
        return trajectory.to_polars().drop("tag"), trajectory.notices
    file = read_table_file(path)
    columns = file.frame.columns
    stds = {"std_x_m", "std_y_m"} if {"std_x_m", "std_y_m"} & {*columns} else set()
    if missing := sorted({"t_s", "x_m", "y_m", *stds} - {*columns}):
        expected = "expected t_s, x_m, y_m and optionally z_m, std_x_m with std_y_m …, qw … qz"
        fix = "bring it into this form by `trackwright import`"
        raise UnusableInput(f"{path}: no column {', '.join(missing)}; found {listed(columns, 12)}; {expected}; {fix}")
    frame = file.frame.select(
        pl.col(name).cast(pl.String) if name in _TEXT else numbers_of(file, name) for name in columns
    )
    # That of a known height is 0.
    reported = frame.select(pl.col("^std_.*$").replace(0.0, None))
    check_stds(file, reported, reported.columns)
    keys = [name for name in ("recording", "tag", "station") if name in columns]
    for rows in frame.partition_by(keys) if keys else [frame]:
        refuse_lost_digits(f"{path}", rows)
    return frame, ()


def read_truth(path: Path, tag: str) -> RecordingFolder:
    """The true path of one tag in a file, as a recording of that name; raises UnusableInput as `read_estimates`."""
    table, notices = read_estimates(path)
    table = table if "tag" in table.columns else table.with_columns(tag=pl.lit(tag))
    columns = [name for name in ("t_s", "tag", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz") if name in table.columns]
    return RecordingFolder(path.stem, path, Rig(path.stem), {"truth": table.select(columns)}, notices)


def assigned(tracks: pl.DataFrame, truths: dict[str, pl.DataFrame], tag: str | None, path: Path) -> pl.DataFrame:
    """The estimates with `recording` and `tag`, those of the truth where the file at `path` names none."""
    tags = sorted({str(t) for truth in truths.values() for t in truth["tag"].unique()})
    for name, known, option in (("recording", [*truths], "--truth"), ("tag", tags, "--tag")):
        if name not in tracks.columns:
            given = known if tag is None or name == "recording" else [one for one in known if one == tag]
            if len(given) != 1:
                found = f"{path}: names no {name}; the truth has {listed(known)}"
                raise UnusableInput(f"{found}; give one of these that it follows by {option}")
            tracks = tracks.with_columns(pl.lit(given[0]).alias(name))
    return tracks


class ComparedTrack(NamedTuple):
    """The errors of the track of one tag."""

    recording: str
    tag: str
    errors: TrajectoryErrors

    def to_dict(self) -> dict[str, Any]:
        """All of it in plain numbers, for JSON."""
        return {"recording": self.recording, "tag": self.tag} | self.errors.to_dict()


def compare_tracks(
    tracks: pl.DataFrame, truths: Mapping[str, pl.DataFrame], *options: Any, **named: Any
) -> tuple[pl.DataFrame, list[ComparedTrack]]:
    """The estimates, each track aligned and shifted in time, and the errors of each track that has a truth.

    `truths`: by recording, a truth table. Further arguments as of `compare_trajectories`. Raises UnusableInput.
    """
    if is_bearing(tracks):
        raise UnusableInput("the tracks hold bearings; expected positions x_m, y_m; leave the trajectory options out")
    moved, compared = [], []
    for (recording, tag), rows in tracks.partition_by(["recording", "tag"], as_dict=True, maintain_order=True).items():
        none = pl.DataFrame(schema={"tag": pl.String})
        truth = truths.get(str(recording), none).filter(pl.col("tag").cast(pl.String) == str(tag))
        if truth.is_empty():
            continue
        of = f"of tag {tag} in '{recording}'"
        own, true = trajectory_of_table(rows, f"track {of}"), trajectory_of_table(truth, f"truth {of}")
        errors = compare_trajectories(own, true, *options, **named)
        moved.append(errors.similarity.table(rows).with_columns(pl.col("t_s") + errors.time_offset))
        compared.append(ComparedTrack(str(recording), str(tag), errors))
    if not compared:
        known = [f"{name}: {listed(sorted(truth['tag'].unique().cast(pl.String)))}" for name, truth in truths.items()]
        recordings, tags = (listed(tracks[name].unique(maintain_order=True)) for name in ("recording", "tag"))
        found = f"tracks of {recordings}, tags {tags}; truth of {listed(known) or 'no recording'}"
        raise UnusableInput(f"no track has a truth: {found}; give the --truth of the same recording and tag")
    return pl.concat(moved), compared


def pooled_names(steps: Sequence[str]) -> list[str]:
    """The names that `pooled` may have with relative errors over these steps."""
    return ["ape_m", *(f"rpe_{step_of(step)[0]}_m" for step in steps), "speed_mps"]


def pooled(compared: Sequence[ComparedTrack]) -> dict[str, float]:
    """Root mean squares over all tracks, for `--fail-if`: ape_m, rpe_STEP_m, speed_mps."""
    of = [track.errors for track in compared]
    rows = [("ape_m", e.ape_m) for e in of] + [(f"rpe_{s}_m", x) for e in of for s, x in e.rpe_m.items()]
    rows += [("speed_mps", e.speed_mps) for e in of if e.speed_mps is not None]
    by_name = {name: [x for n, x in rows if n == name] for name, _ in rows}
    return {name: math.sqrt(sum(x["sse"] for x in all_) / sum(x["n"] for x in all_)) for name, all_ in by_name.items()}
