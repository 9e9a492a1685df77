"""Trajectories: lists of poses, the maps that move them, and their files in the formats TUM, KITTI and EuRoC."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation

from trackwright.trackers.core.data.seconds import span
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.evaluation.rows import AXES, covariances
from trackwright.trackers.exchange.expressions import numbers_of
from trackwright.trackers.exchange.formats import FORMATS, beginning_of
from trackwright.trackers.exchange.mapping import Asked, Source, refuse_lost_digits
from trackwright.trackers.exchange.text_tables import Reading, read_rows
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.columns import QUATERNION, float_column
from trackwright.trackers.recordings.tables import TableFile, first_row, restarted_at, unwrapped_times
from trackwright.trackers.recordings.tracks_table import NO_ESTIMATE

Kind = Literal["tum", "kitti", "euroc"]

_FORMS: dict[str, tuple[int, str, str]] = {
    "tum": (8, " ", "8 numbers: time in s, x, y, z in m, quaternion x, y, z, w, separated by blanks"),
    "kitti": (12, " ", "12 numbers: the upper three rows of the pose matrix, separated by blanks"),
    "euroc": (8, ",", "at least 8 numbers: time in ns, x, y, z in m, quaternion w, x, y, z, separated by commas"),
}
"""By the name of a format: numbers of a line, what separates them, and both in words."""

_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
_STDS, _VELOCITY = tuple(f"std_{axis}" for axis in AXES), tuple(f"v{axis}_mps" for axis in "xyz")


@dataclass(frozen=True, eq=False)
class PoseTrajectory:
    """Poses over time: `times` (n,) s, `positions` (n, 3) m, `quaternions` (n, 4) w, x, y, z, body to world, or None.

    The height is NaN where it is unknown. Raises UnusableInput for other shapes, and what is not finite.
    """

    times: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray | None = None
    name: str = "trajectory"
    notices: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.times)
        q = np.tile(_IDENTITY, (n, 1)) if self.quaternions is None else self.quaternions
        if n == 0 or np.shape(self.positions) != (n, 3) or np.shape(q) != (n, 4):
            found = f"{n} times, positions {np.shape(self.positions)}, quaternions {np.shape(q)}"
            raise UnusableInput(f"{self.name}: {found}; expected one pose at least, (n, 3) and (n, 4)")
        sizes = np.linalg.norm(q, axis=1)
        usable = np.isfinite(np.column_stack([self.times, self.positions[:, :2], sizes])).all(axis=1) & (sizes > 0)
        if not usable.all():
            expected = "finite times and positions, and no zero quaternion; leave such poses out"
            raise UnusableInput(f"{self.name}: pose {usable.argmin() + 1} is unusable; expected {expected}")
        if self.quaternions is not None:
            object.__setattr__(self, "quaternions", q / sizes[:, None])

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        what = "positions" if self.quaternions is None else "poses"
        return f"<PoseTrajectory {self.name!r}: {len(self)} {what} from {span(self.times[0], self.times[-1])}>"

    def at_rows(self, rows: Sequence[int] | np.ndarray) -> PoseTrajectory:
        """The poses of these rows."""
        quaternions = None if self.quaternions is None else self.quaternions[rows]
        return replace(self, times=self.times[rows], positions=self.positions[rows], quaternions=quaternions)

    def to_polars(self, tag: str = "") -> pl.DataFrame:
        """A table t_s, tag, x_m, y_m, z_m and, of poses, qw, qx, qy, qz: the columns of a truth table."""
        columns: dict[str, Any] = {"t_s": self.times, "tag": [tag] * len(self)}
        columns |= dict(zip(AXES, self.positions.T, strict=True))
        columns |= {} if self.quaternions is None else dict(zip(QUATERNION, self.quaternions.T, strict=True))
        return pl.DataFrame(columns).with_columns(pl.col(AXES).fill_nan(None))


def usable_rows(table: pl.DataFrame) -> pl.DataFrame:
    """The rows with an estimate, by `status`, time and position, in the order of time."""
    usable = pl.all_horizontal(pl.col("t_s", "x_m", "y_m").is_finite()).fill_null(False)
    if "status" in table.columns:
        usable &= ~pl.col("status").is_in(NO_ESTIMATE).fill_null(False)
    return table.filter(usable).sort("t_s", maintain_order=True)


def trajectory_of_table(table: pl.DataFrame, name: str) -> PoseTrajectory:
    """The usable rows of a table of one tag, with attitudes where all have one; raises UnusableInput without any."""
    rows = usable_rows(table)
    attitude = _stacked(rows, QUATERNION)
    given = attitude if np.isfinite(attitude).all() and len(attitude) else None
    return PoseTrajectory(float_column(rows, "t_s"), _stacked(rows, AXES), given, name)


def _stacked(table: pl.DataFrame, names: Sequence[str]) -> np.ndarray:
    return np.stack([float_column(table, name) for name in names], axis=1)


def quaternions_of(matrices: np.ndarray) -> np.ndarray:
    """The unit quaternions (n, 4) w, x, y, z, w not negative, of rotation matrices (n, 3, 3)."""
    return np.asarray(Rotation.from_matrix(matrices).as_quat(canonical=True, scalar_first=True))


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

    def attitudes(self, quaternions: np.ndarray) -> np.ndarray:
        """The images of quaternions (n, 4), those that are NaN as they are."""
        turned, known = quaternions.copy(), np.isfinite(quaternions).all(axis=1)
        turned[known] = quaternions_of(self.rotation @ rotation_matrices(quaternions[known]))
        return turned

    def trajectory(self, poses: PoseTrajectory) -> PoseTrajectory:
        """The image of a trajectory; attitudes are turned with it."""
        turned = None if poses.quaternions is None else self.attitudes(poses.quaternions)
        return replace(poses, positions=self.points(poses.positions), quaternions=turned)

    def table(self, tracks: pl.DataFrame) -> pl.DataFrame:
        """The image of a table of estimates: positions, attitudes, velocities and covariances, where it has them."""
        velocities, columns = replace(self, translation=np.zeros(3)).points, dict[str, np.ndarray]()
        for names, moved in ((AXES, self.points), (_VELOCITY, velocities), (QUATERNION, self.attitudes)):
            columns |= dict(zip(names, moved(_stacked(tracks, names)).T, strict=True))
        if _STDS[0] in tracks.columns:
            P, factor = covariances(tracks), self.scale * self.rotation
            k = 2 if self.flat else 3
            if self.flat:
                # An unknown variance of the height, which is left alone, must not reach the other axes.
                P[:, :2, 2] = P[:, 2, :2] = P[:, :2, 2] @ factor[:2, :2].T
            P[:, :k, :k] = factor[:k, :k] @ P[:, :k, :k] @ factor[:k, :k].T
            columns |= {name: np.sqrt(P[:, k, k]) for k, name in enumerate(_STDS)}
            columns |= {f"cov_{'xyz'[i]}{'xyz'[j]}_m2": P[:, i, j] for i, j in ((0, 1), (0, 2), (1, 2))}
        kept = {name: values for name, values in columns.items() if name in tracks.columns}
        return tracks.with_columns(pl.Series(name, values).fill_nan(None) for name, values in kept.items())


def read_trajectory(path: Path | str, kind: Kind | None = None) -> PoseTrajectory:
    """The poses in a TUM, KITTI or EuRoC file, by its name or first lines, sorted by time; # begins a comment.

    KITTI poses have no times: their rows are counted as seconds. A file whose attitudes are all the identity has none.
    Raises UnusableInput with file and line.
    """
    path, notices = Path(path), list[str]()
    ending = path.suffix.lower().removeprefix(".")
    begin = "" if kind or ending in _FORMS else beginning_of(path)
    alike = [k for k in _FORMS if k == ending or re.search(FORMATS[k].begins, begin, re.MULTILINE)]
    if not (kind or alike):
        forms = "; or ".join(words for *_, words in _FORMS.values())
        raise UnusableInput(f"{path}: no trajectory; expected lines of {forms}; or a table by `trackwright import`")
    known = kind or alike[0]
    wanted, separator, words = _FORMS[known]
    file, _ = read_rows(path, Reading(separator=separator, header="none"))
    counts = file.frame.select(pl.sum_horizontal(pl.all().str.strip_chars().fill_null("") != "")).to_series()
    if (wrong := counts < wanted if known == "euroc" else counts != wanted).any():
        where = file.location(first_row(wrong), f"column{counts[first_row(wrong)]}, the last")
        raise UnusableInput(f"{where}; expected {words}")
    numbers = np.stack([numbers_of(file, name).to_numpy() for name in file.frame.columns[:wanted]], axis=1)
    if not (finite := np.isfinite(numbers)).all():
        row, column = np.argwhere(~finite)[0].tolist()
        raise UnusableInput(f"{file.location(row, f'column{column + 1}')}: not finite; expected {words}")
    if known == "kitti":
        matrices, stamps = numbers.reshape(-1, 3, 4), np.arange(len(numbers), dtype=float)
        turns, positions = matrices[:, :, :3], matrices[:, :, 3]
        error = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        if (turned := (error > 1e-3) | (np.linalg.det(turns) < 0)).any():
            raise UnusableInput(f"{file.location(int(turned.argmax()), 'column1')}: no rotation; expected {words}")
        quaternions = quaternions_of(turns)
        notices.append("KITTI poses have no times; the rows are counted as seconds; a TUM file or a table has times")
    else:
        stamps, positions = numbers[:, 0] / (1e9 if known == "euroc" else 1.0), numbers[:, 1:4]
        quaternions = np.roll(numbers[:, 4:8], 1, axis=1) if known == "tum" else numbers[:, 4:8]
    stamps, wraps = unwrapped_times(stamps)
    refuse_lost_digits(f"{path}", pl.DataFrame({"t_s": stamps, **dict(zip(AXES, positions.T, strict=True))}))
    if (at := restarted_at(stamps)) is not None:
        found = f"pose {at + 1}: {stamps[at]:.3f} s after {stamps[:at].max():.3f} s: the clock went back"
        raise UnusableInput(f"{path}: {found}; expected times that increase; make the poses before and after two files")
    steps, order = np.diff(stamps), np.argsort(stamps, kind="stable")
    if (steps < 0).any():
        back = f"{int((steps < 0).sum())}, by {-float(steps.min()):.6g} s at most"
        wraps.append(f"rows earlier than the previous row: {back}; sorted")
    if still := bool((quaternions == _IDENTITY).all()):
        wraps.append("every quaternion is the identity; read as positions without attitude")
    attitude = None if still else quaternions[order]
    return PoseTrajectory(stamps[order], positions[order], attitude, path.name, (*notices, *wraps))


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The poses of a file as the table of each mapping; raises UnusableInput with file and line."""
    source, poses = Source(), read_trajectory(path, name)  # type: ignore[arg-type]
    for mapping in asked.mappings:
        if mapping.table not in ("truth", "fixes"):
            raise UnusableInput(f"{path}: poses are a table truth or fixes, not {mapping.table}; give --table truth")
        source.notices += [f"{mapping.table}: {line}" for line in poses.notices]
        source.read(TableFile(path, poses.to_polars().drop("tag")), mapping)
    return source


def write_trajectory(trajectory: PoseTrajectory, path: Path | str, kind: Literal["tum", "kitti"] | None = None) -> Path:
    """Writes the poses with all digits in a format, by default the ending of the name, and returns the path.

    KITTI has times in a second file. An unknown height is written as 0, an unknown attitude as the identity. Raises
    UnusableInput for another format.
    """
    path = Path(path)
    kind = kind or path.suffix.lower().removeprefix(".")  # type: ignore[assignment]
    given, positions = trajectory.quaternions, np.nan_to_num(trajectory.positions)
    q = np.tile(_IDENTITY, (len(trajectory), 1)) if given is None else given
    if kind not in ("tum", "kitti"):
        raise UnusableInput(f"{path}: the format is not clear from the name; expected tum or kitti")
    rows = np.column_stack([trajectory.times, positions, np.roll(q, -1, axis=1)])
    if kind == "kitti":
        stamps = "".join(f"{time!r}\n" for time in trajectory.times.tolist())
        atomic_write(written_files(path, kind)[1], lambda target: target.write_text(stamps, encoding="utf-8"))
        rows = np.concatenate([rotation_matrices(q), positions[:, :, None]], axis=2).reshape(-1, 12)
    text = "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist())
    return atomic_write(path, lambda target: target.write_text(text, encoding="utf-8"))


def written_files(path: Path, kind: str) -> list[Path]:
    """The files that `write_trajectory` writes: the path, and for KITTI poses the file of their times."""
    return [path, path.with_suffix(".times.txt")] if kind == "kitti" else [path]
