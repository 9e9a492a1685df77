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
from trackwright.trackers.evaluation.rows import AXES, covariances
from trackwright.trackers.exchange.expressions import numbers_of
from trackwright.trackers.exchange.mapping import Asked, Source, refuse_lost_digits
from trackwright.trackers.exchange.text_tables import Reading, read_rows
from trackwright.trackers.recordings.atomic import write_whole
from trackwright.trackers.recordings.columns import QUATERNION, float_column
from trackwright.trackers.recordings.folder import read_recording
from trackwright.trackers.recordings.rig_file import RIG_FILE
from trackwright.trackers.recordings.tables import TableFile, first_row, restarted_at, unwrapped_times
from trackwright.trackers.recordings.tracks_table import HEADING, NO_ESTIMATE, is_bearing, read_tracks

TUM = ("t_s", *AXES, *QUATERNION[1:], QUATERNION[0])
_TUM_WORDS = "8 numbers in each line: time in s, x, y, z in m, quaternion x, y, z, w; other files: `trackwright import`"
_STDS, _VELOCITY = tuple(f"std_{axis}" for axis in AXES), tuple(f"v{axis}_mps" for axis in "xyz")


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
    given = np.isfinite(q).all() and q.any(axis=1).all()
    return Poses(
        float_column(rows, "t_s"), stacked(rows, AXES), Rotation.from_quat(q, scalar_first=True) if given else None
    )


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
        """The image of a table: positions, attitudes, velocities and covariances, where it has them."""
        q = stacked(tracks, QUATERNION)
        known = np.isfinite(q).all(axis=1)
        turned = Rotation.from_matrix(self.rotation) * Rotation.from_quat(q[known], scalar_first=True)
        q[known] = turned.as_quat(canonical=True, scalar_first=True)
        velocities = replace(self, translation=np.zeros(3)).points(stacked(tracks, _VELOCITY))
        columns = dict(zip(AXES, self.points(stacked(tracks, AXES)).T, strict=True))
        columns |= dict(zip((*_VELOCITY, *QUATERNION), (*velocities.T, *q.T), strict=True))
        if _STDS[0] in tracks.columns:
            # An unknown variance of a height that is left alone must not reach the other axes.
            P, F, k = covariances(tracks), self.scale * self.rotation, 2 if self.flat else 3
            P[:, :k, k:] = F[:k, :k] @ P[:, :k, k:]
            P[:, k:, :k] = P[:, :k, k:].transpose(0, 2, 1)
            P[:, :k, :k] = F[:k, :k] @ P[:, :k, :k] @ F[:k, :k].T
            columns |= {name: np.sqrt(P[:, i, i]) for i, name in enumerate(_STDS)}
            columns |= {f"cov_{'xyz'[i]}{'xyz'[j]}_m2": P[:, i, j] for i, j in ((0, 1), (0, 2), (1, 2))}
        kept = {name: values for name, values in columns.items() if name in tracks.columns}
        return tracks.with_columns(pl.Series(name, values).fill_nan(None) for name, values in kept.items())


def read_trajectory(path: Path | str) -> tuple[pl.DataFrame, list[str]]:
    """The poses in a TUM file, sorted by time, in the columns of a truth, and notices; # begins a comment.

    A file whose attitudes are all the identity has none. Raises UnusableInput with file and line.
    """
    file, _ = read_rows(Path(path), Reading(separator=" ", header="none"))
    counts = file.frame.select(pl.sum_horizontal(pl.all().str.strip_chars().fill_null("") != "")).to_series()
    if (counts != len(TUM)).any():
        row = first_row(counts != len(TUM))
        raise UnusableInput(f"{file.location(row, f'column{counts[row]}')}, the last; expected {_TUM_WORDS}")
    table = pl.DataFrame({name: numbers_of(file, f"column{k}") for k, name in enumerate(TUM, 1)})
    for name, values in zip(TUM, table, strict=True):
        if not (known := values.is_finite().fill_null(False)).all():
            row, column = first_row(~known), f"column{TUM.index(name) + 1}"
            raise UnusableInput(f"{file.location(row, column)}: not finite; expected {_TUM_WORDS}")
    if (zero := table.select(pl.all_horizontal(pl.col(QUATERNION) == 0)).to_series()).any():
        raise UnusableInput(f"{file.location(first_row(zero), 'column5')}: a zero quaternion; leave the pose out")
    times, notices = unwrapped_times(table["t_s"].to_numpy())
    refuse_lost_digits(f"{path}", table := table.with_columns(t_s=times))
    if (at := restarted_at(times)) is not None:
        found = f"pose {at + 1}: {times[at]:.3f} s after {times[:at].max():.3f} s: the clock went back"
        raise UnusableInput(f"{path}: {found}; expected times that increase; make the poses before and after two files")
    if (steps := np.diff(times)).min(initial=0) < 0:
        back = f"{int((steps < 0).sum())}, by {-float(steps.min()):.6g} s at most"
        notices.append(f"rows earlier than the previous row: {back}; sorted")
    if (table["qw"] == 1).all() and not table.select(QUATERNION[1:]).to_numpy().any():
        notices.append("every quaternion is the identity; read as positions without attitude")
        table = table.drop(QUATERNION)
    return table.sort("t_s", maintain_order=True), notices


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The poses of a TUM file as the table of each mapping; raises UnusableInput with file and line."""
    source, (poses, notices) = Source(), read_trajectory(path)
    for mapping in asked.mappings:
        if mapping.table not in ("truth", "fixes"):
            raise UnusableInput(f"{path}: poses are a table truth or fixes, not {mapping.table}; give --table truth")
        source.notices += [f"{mapping.table}: {line}" for line in notices]
        source.read(TableFile(path, poses), mapping)
    return source


def write_trajectory(table: pl.DataFrame, path: Path | str) -> Path:
    """Writes the usable poses of one tag as TUM with all digits, and returns the path.

    An unknown height is written as 0; an unknown attitude is that of a level body by its heading, or the identity.
    """
    rows = usable_rows(table)
    numbers, half = np.nan_to_num(stacked(rows, TUM)), np.nan_to_num(float_column(rows, HEADING)) / 2
    level = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    numbers[:, 4:] = np.where(numbers[:, 4:].any(axis=1, keepdims=True), numbers[:, 4:], level)
    return write_whole(Path(path), "".join(" ".join(map(repr, row)) + "\n" for row in numbers.tolist()))


def export_tracks(
    run: Path, format: Literal["tum", "csv"], out: Path, tag: str | None = None, force: bool = False
) -> Iterator[str]:
    """Exports the tracks in a folder of `track`, or the truth of a recording; a line for each file.

    `tum`: a file for each track, of one track `out`. `force`: replace a file that exists. Raises UnusableInput.
    """
    if not (run / RIG_FILE).is_file():
        table = read_tracks(run)
    elif "truth" in (recording := read_recording(run)).tables:
        table = recording.tables["truth"].with_columns(recording=pl.lit(recording.name))
    else:
        raise UnusableInput(f"{run}: has no truth table; expected a folder of `track`, or a recording with truth")
    if tag is not None:
        tags = sorted(table["tag"].cast(pl.String).unique())
        table = table.filter(pl.col("tag").cast(pl.String) == tag)
        if table.is_empty():
            raise UnusableInput(f"--tag {tag}: no row of it; found {listed(tags)}")
    if format == "tum" and is_bearing(table):
        raise UnusableInput("the tracks hold bearings, no positions; --format csv writes them")
    tracks = {out: table}
    if format == "tum":
        usable = usable_rows(table).partition_by(["recording", "tag"], as_dict=True, maintain_order=True)
        names = (re.sub(r"[^\w.-]", "_", f"{recording}-{tag}")[:100] for recording, tag in usable)
        files = [out] if len(usable) == 1 and out.suffix else [out / f"{name}.tum" for name in names]
        tracks = dict(zip(files, usable.values(), strict=True))
    if not tracks:
        raise UnusableInput("no track holds an estimate; run `trackwright check` on the recording")
    if out.is_dir() and any(out.iterdir()):
        raise UnusableInput(f"--out {out}: is a folder with content; expected a new file or an empty folder")
    if not force and (old := next((path for path in (out, *tracks) if path.is_file()), None)):
        raise UnusableInput(f"--out {old}: exists; expected a new file; --force replaces it")
    for path, rows in tracks.items():
        if format == "csv":
            write_whole(path, rows.write_csv())
        else:
            write_trajectory(rows, path)
        yield f"wrote {path}: {counted(len(rows), 'pose' if format == 'tum' else 'row')}"
