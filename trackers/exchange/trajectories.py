"""Trajectories as tables of poses: the maps that move them, TUM files, and the export of tracks and truths."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.rows import AXES
from trackwright.trackers.exchange.expressions import numbers_of
from trackwright.trackers.exchange.mapping import refuse_lost_digits, without_identities
from trackwright.trackers.exchange.text_tables import Reading, read_rows
from trackwright.trackers.recordings.atomic import write_whole
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import read_recording
from trackwright.trackers.recordings.kinds import QUATERNION
from trackwright.trackers.recordings.rig_file import RIG_FILE
from trackwright.trackers.recordings.selection import Selection
from trackwright.trackers.recordings.table_file import SUFFIXES, TableFile, first_row, read_table_file
from trackwright.trackers.recordings.tables import check_stds, restarted_at, unwrapped_times
from trackwright.trackers.recordings.tracks_table import NO_ESTIMATE, is_bearing, read_tracks

TUM = ("t_s", *AXES, *QUATERNION[1:], QUATERNION[0])
_TUM_WORDS = "8 numbers in each line: time in s, x, y, z in m, quaternion x, y, z, w; other files: `trackwright import`"
_TEXT = ("recording", "tag", "station", "status", "wrapped")


class Poses(NamedTuple):
    """`times` (n,) s, in order, `positions` (n, 3) m, the height NaN where unknown, and attitudes, or None."""

    times: np.ndarray
    positions: np.ndarray
    attitudes: Rotation | None

    def at(self, rows: np.ndarray) -> Poses:
        """The poses of these rows."""
        return Poses(self.times[rows], self.positions[rows], None if self.attitudes is None else self.attitudes[rows])


def usable_rows(table: pl.DataFrame) -> pl.DataFrame:
    """The rows with an estimate, by `status`, time and position, in the order of time."""
    usable = pl.all_horizontal(pl.col("t_s", "x_m", "y_m").is_finite()).fill_null(False)
    if "status" in table.columns:
        usable &= ~pl.col("status").is_in(NO_ESTIMATE).fill_null(False)
    return table.filter(usable).sort("t_s", maintain_order=True)


def poses_of(table: pl.DataFrame, name: str) -> Poses:
    """The usable poses of a table of one tag, with attitudes where all rows have one; raises UnusableInput for none."""
    rows = usable_rows(table)
    if rows.is_empty():
        raise UnusableInput(f"{name}: no pose; expected rows with t_s, x_m, y_m and, where known, z_m, qw … qz")
    q = stacked(rows, QUATERNION)
    if not q.any(axis=1).all():
        raise UnusableInput(f"{name}: pose {int(np.argmin(q.any(axis=1))) + 1} has a zero quaternion; leave it out")
    attitudes = Rotation.from_quat(q, scalar_first=True) if np.isfinite(q).all() else None
    return Poses(float_column(rows, "t_s"), stacked(rows, AXES), attitudes)


def stacked(table: pl.DataFrame, names: Sequence[str]) -> np.ndarray:
    """Columns as an array (n, m), NaN where a value or a column is missing."""
    return np.stack([float_column(table, name) for name in names], axis=1)


@dataclass(frozen=True, eq=False)
class Similarity:
    """A map of space: p → `scale` · `rotation` p + `translation`, m; `flat` where it leaves heights alone."""

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0
    flat: bool = False

    def points(self, positions: np.ndarray) -> np.ndarray:
        """The images (n, 3) of positions (n, 3), m; an unknown height stays unknown where heights are left alone."""
        if self.flat:
            moved = positions.copy()
            moved[:, :2] = positions[:, :2] @ self.rotation[:2, :2].T + self.translation[:2]
            return moved
        return self.scale * positions @ self.rotation.T + self.translation

    def table(self, tracks: pl.DataFrame) -> pl.DataFrame:
        """The image of a table of poses; where they move, velocities and covariances are left out."""
        if self.flat and np.array_equal(self.rotation, np.eye(3)) and not self.translation.any():
            return tracks
        q = stacked(tracks, QUATERNION)
        known = np.isfinite(q).all(axis=1)
        turned = Rotation.from_matrix(self.rotation) * Rotation.from_quat(q[known], scalar_first=True)
        q[known] = turned.as_quat(canonical=True, scalar_first=True)
        columns = dict(zip((*AXES, *QUATERNION), (*self.points(stacked(tracks, AXES)).T, *q.T), strict=True))
        kept = tracks.select(pl.exclude("^(std_.*|cov_.*|v[xyz]_mps|heading_rad)$"))
        return kept.with_columns(pl.Series(n, x).fill_nan(None) for n, x in columns.items() if n in kept.columns)


def read_tum(path: Path) -> TableFile:
    """The columns of a TUM file as texts; # begins a comment. Raises UnusableInput with file and line."""
    file, _ = read_rows(path, Reading(separator=" ", header="none"))
    counts = file.frame.select(pl.sum_horizontal(pl.all().is_not_null())).to_series()
    if (counts != len(TUM)).any():
        row = first_row(counts != len(TUM))
        raise UnusableInput(f"{file.location(row, f'column{counts[row]}')}, the last; expected {_TUM_WORDS}")
    return replace(file, frame=file.frame.rename(dict(zip(file.frame.columns, TUM, strict=True))))


def read_trajectory(path: Path | str) -> tuple[pl.DataFrame, list[str]]:
    """The poses in a TUM file, or a table with columns that `track` writes, by time, and notices; or UnusableInput."""
    is_table = Path(path).name.lower().endswith(SUFFIXES)
    file = read_table_file(Path(path)) if is_table else read_tum(Path(path))
    columns = file.frame.columns
    if missing := {"t_s", "x_m", "y_m", *({"std_x_m", "std_y_m"} if "std_x_m" in columns else ())} - {*columns}:
        fix = "expected also z_m, std_x_m …, qw … qz where known; bring it into this form by `trackwright import`"
        raise UnusableInput(f"{path}: no column {listed(sorted(missing))}; found {listed(columns, 12)}; {fix}")
    table = file.frame.select(pl.col(n).cast(pl.String) if n in _TEXT else numbers_of(file, n) for n in columns)
    # The standard deviation of a known height is 0.
    reported = table.select(pl.col("^std_.*$").replace(0.0, None))
    check_stds(file, reported, reported.columns)
    table, notices = without_identities(table)
    keys, tracks = [name for name in ("recording", "tag", "station") if name in columns], list[pl.DataFrame]()
    for rows in table.partition_by(keys, maintain_order=True) if keys else [table]:
        times, said = unwrapped_times(rows["t_s"].to_numpy())
        tracks.append(rows.with_columns(t_s=times).sort("t_s", maintain_order=True))
        refuse_lost_digits(f"{path}", tracks[-1])
        if (at := restarted_at(times)) is not None:
            found = f"pose {at + 1}: {times[at]:.3f} s after {times[:at].max():.3f} s: the clock went back"
            raise UnusableInput(f"{path}: {found}; expected times that increase; make two files of it")
        late = int((np.diff(times) < 0).sum())
        notices += said + [f"rows earlier than the previous row: {late}; sorted"] * bool(late)
    return pl.concat(tracks), notices


def write_trajectory(table: pl.DataFrame, path: Path | str) -> Path:
    """Writes the usable poses of one tag as TUM with all digits, and returns the path.

    An unknown height is written as 0, an unknown attitude as the identity.
    """
    numbers = np.nan_to_num(stacked(usable_rows(table), TUM))
    numbers[:, 7] = np.where(numbers[:, 4:].any(axis=1), numbers[:, 7], 1.0)
    return write_whole(Path(path), "".join(" ".join(map(repr, row)) + "\n" for row in numbers.tolist()))


def export_tracks(
    run: Path, format: Literal["tum", "csv"], out: Path, tag: str | None = None, force: bool = False
) -> Iterator[str]:
    """Exports the tracks in a folder of `track`, or the truth of a recording; a line for each file.

    `tum`: a file for each track, of one track `out`. `force`: replace a file that exists. Raises UnusableInput.
    """
    recording = read_recording(run) if (run / RIG_FILE).is_file() else None
    table = read_tracks(run) if recording is None else recording.tables.get("truth")
    if table is None:
        raise UnusableInput(f"{run}: has no truth table; expected a folder of `track`, or a recording with truth")
    table = Selection(() if tag is None else (tag,)).of_estimates(table)
    if recording is not None:
        table = table.with_columns(recording=pl.lit(recording.name))
    tracks = {out: table}
    if format == "tum":
        if is_bearing(table) or (table := usable_rows(table)).is_empty():
            raise UnusableInput(f"{run}: holds no estimate of a position; --format csv writes what there is")
        parts = table.partition_by(["recording", "tag"], as_dict=True, maintain_order=True)
        names = (re.sub(r"[^\w.-]", "_", f"{recording}-{tag}")[:100] for recording, tag in parts)
        files = [out] if len(parts) == 1 and out.suffix else [out / f"{name}.tum" for name in names]
        tracks = dict(zip(files, parts.values(), strict=True))
    if out.is_dir() and any(out.iterdir()):
        raise UnusableInput(f"--out {out}: is a folder with content; expected a new file or an empty folder")
    if not force and (old := next((path for path in (out, *tracks) if path.is_file()), None)):
        raise UnusableInput(f"--out {old}: exists; expected a new file; --force replaces it")
    for path, rows in tracks.items():
        write_whole(path, rows.write_csv()) if format == "csv" else write_trajectory(rows, path)
        yield f"wrote {path}: {counted(len(rows), 'pose' if format == 'tum' else 'row')}"
