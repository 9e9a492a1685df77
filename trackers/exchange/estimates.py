"""Estimates of any program and true paths in files, and their errors track by track.

The files are trajectories, or tables with the columns of `track`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.expressions import numbers_of
from trackwright.trackers.exchange.formats import beginning_of
from trackwright.trackers.exchange.mapping import refuse_lost_digits
from trackwright.trackers.exchange.pose_errors import (
    Alignment,
    Statistics,
    TrajectoryErrors,
    compare_trajectories,
    step_of,
)
from trackwright.trackers.exchange.trajectories import Kind, read_trajectory, trajectory_of_table
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.table_file import SUFFIXES, TableFile, read_table_file
from trackwright.trackers.recordings.tables import check_stds
from trackwright.trackers.recordings.tracks_table import is_bearing

_TEXT = ("recording", "tag", "station", "status", "wrapped")


def read_estimates(path: Path, kind: Kind | None = None) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """The estimates in a TUM, KITTI or EuRoC file or a table, and notices.

    A table, CSV or Parquet, has t_s, x_m, y_m and what else of the columns that `track` writes, with `qw, qx, qy, qz`.
    Raises UnusableInput with file and line.
    """
    if kind is None and _is_table(path):
        return _table(read_table_file(path)), ()
    trajectory = read_trajectory(path, kind)
    return trajectory.to_polars().drop("tag"), trajectory.notices


def read_truth(path: Path, tag: str) -> RecordingFolder:
    """The true path of one tag in a file, as a recording of that name; raises UnusableInput as `read_estimates`."""
    table, notices = read_estimates(path)
    given = "tag" in table.columns
    table = table if given else table.with_columns(tag=pl.lit(tag))
    columns = [name for name in ("t_s", "tag", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz") if name in table.columns]
    return RecordingFolder(path.stem, path, Rig(path.stem), {"truth": table.select(columns)}, notices)


def assigned(tracks: pl.DataFrame, truths: dict[str, pl.DataFrame], tag: str | None, path: Path) -> pl.DataFrame:
    """The estimates of a file with `recording` and `tag`; where the file does not name them, the truth does.

    `tag`: the one that the file follows, needed where the truth has several. Raises UnusableInput where it is not clear
    which truth is meant.
    """
    if "recording" not in tracks.columns:
        if len(truths) != 1:
            raise UnusableInput(f"{path}: names no recording; found {len(truths)} with truth; give one in --truth")
        tracks = tracks.with_columns(recording=pl.lit(next(iter(truths))))
    if "tag" not in tracks.columns:
        known = sorted({str(t) for truth in truths.values() for t in truth["tag"].unique()})
        if tag is None and len(known) != 1:
            raise UnusableInput(
                f"{path}: names no tag; the truth has {listed(known)}; give the tag it follows in --tag"
            )
        if tag is not None and tag not in known:
            raise UnusableInput(f"--tag {tag}: the truth has no such tag; found {listed(known)}")
        tracks = tracks.with_columns(tag=pl.lit(tag if tag is not None else known[0]))
    return tracks


def _is_table(path: Path) -> bool:
    """Whether the file is a table with a head, and not a list of poses."""
    name = path.name.lower()
    return name.endswith(SUFFIXES) and (not name.endswith(".csv") or "t_s" in beginning_of(path).partition("\n")[0])


def _table(file: TableFile) -> pl.DataFrame:
    columns = file.frame.columns
    missing = [name for name in ("t_s", "x_m", "y_m") if name not in columns]
    if missing:
        raise UnusableInput(
            f"{file.path}: no column {', '.join(missing)}; found {listed(columns, 12)}; expected t_s, x_m, y_m and "
            "optionally z_m, std_x_m …, qw … qz; bring it into this form by `trackwright import`"
        )
    if len(lacking := {"std_x_m", "std_y_m"} - {*columns}) == 1:
        raise UnusableInput(
            f"{file.path}: no column {lacking.pop()}; expected std_x_m with std_y_m, or neither; add it"
        )
    texts = [pl.col(name).cast(pl.String) for name in columns if name in _TEXT]
    frame = file.frame.select(texts + [numbers_of(file, name) for name in columns if name not in _TEXT])
    # That of a known height is 0.
    stds = frame.select(pl.col("^std_.*$").replace(0.0, None))
    check_stds(file, stds, stds.columns)
    of_track = [name for name in ("recording", "tag", "station") if name in columns]
    for rows in frame.partition_by(of_track) if of_track else [frame]:
        refuse_lost_digits(f"{file.path}", rows)
    return frame


class ComparedTrack(NamedTuple):
    """The errors of the track of one tag."""

    recording: str
    tag: str
    errors: TrajectoryErrors

    def to_dict(self) -> dict[str, Any]:
        """All of it in plain numbers, for JSON."""
        return {"recording": self.recording, "tag": self.tag} | self.errors.to_dict()


def compare_tracks(
    tracks: pl.DataFrame,
    truths: Mapping[str, pl.DataFrame],
    align: Alignment = "none",
    time_offset: float | Literal["auto"] = 0.0,
    tolerance: float = 0.01,
    rpe: Sequence[str] = ("1m", "1s"),
    all_pairs: bool = False,
) -> tuple[pl.DataFrame, list[ComparedTrack]]:
    """The estimates, each track aligned and shifted in time, and the errors of each track that has a truth.

    `tracks`: the columns of tracks.parquet. `truths`: by recording, a truth table. Further arguments as of
    `compare_trajectories`, which is called for each track. Raises UnusableInput as it does, for bearings, and where no
    track has a truth.
    """
    if is_bearing(tracks):
        raise UnusableInput("the tracks hold bearings; expected positions x_m, y_m; leave the trajectory options out")
    moved, compared = [], []
    for (recording, tag), rows in tracks.partition_by(["recording", "tag"], as_dict=True, maintain_order=True).items():
        truth = truths.get(str(recording))
        true_rows = None if truth is None else truth.filter(pl.col("tag").cast(pl.String) == str(tag))
        if true_rows is None or true_rows.is_empty():
            continue
        name = f"track of tag {tag} in '{recording}'"
        errors = compare_trajectories(
            trajectory_of_table(rows, name),
            trajectory_of_table(true_rows, f"truth of tag {tag} in '{recording}'"),
            align, time_offset, tolerance, rpe, all_pairs,
        )  # fmt: skip
        moved.append(errors.similarity.table(rows).with_columns(pl.col("t_s") + errors.time_offset))
        compared.append(ComparedTrack(str(recording), str(tag), errors))
    if not compared:
        known = [f"{name}: {listed(sorted(truth['tag'].unique().cast(pl.String)))}" for name, truth in truths.items()]
        recordings, tags = (listed(tracks[name].unique(maintain_order=True)) for name in ("recording", "tag"))
        raise UnusableInput(
            f"no track has a truth: tracks of {recordings}, tags {tags}; truth of {listed(known) or 'no recording'}; "
            "give the --truth of the same recording and tag"
        )
    return pl.concat(moved), compared


def pooled_names(steps: Sequence[str]) -> list[str]:
    """The names that `pooled` may have with relative errors over these steps."""
    return ["ape_m", *(f"rpe_{step_of(step)[0]}_m" for step in steps), "speed_mps"]


def pooled(compared: Sequence[ComparedTrack]) -> dict[str, float]:
    """Root mean squares over all tracks, for `--fail-if`: ape_m, rpe_STEP_m, speed_mps."""
    parts: dict[str, list[Statistics]] = {}
    for track in compared:
        by_name = {"ape_m": track.errors.ape_m}
        by_name |= {f"rpe_{step}_m": errors for step, errors in track.errors.rpe_m.items()}
        if track.errors.speed_mps is not None:
            by_name["speed_mps"] = track.errors.speed_mps
        for name, errors in by_name.items():
            parts.setdefault(name, []).append(errors)
    return {name: math.sqrt(sum(e["sse"] for e in all_) / sum(e["n"] for e in all_)) for name, all_ in parts.items()}
