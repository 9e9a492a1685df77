"""Trajectories: lists of poses, the maps that move them, and their files in the formats TUM, KITTI and EuRoC."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import span
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.rows import covariances
from trackwright.trackers.exchange.formats import FORMATS, beginning_of
from trackwright.trackers.exchange.mapping import Asked, Source, refuse_lost_digits
from trackwright.trackers.exchange.source_rows import Reading, read_rows
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.kinds import QUATERNION
from trackwright.trackers.recordings.tables import restarted_at, unwrapped_times
from trackwright.trackers.recordings.tracks_table import NO_ESTIMATE

AXES = ("x_m", "y_m", "z_m")
Kind = Literal["tum", "kitti", "euroc"]

_FORMS: dict[str, tuple[int, str, str]] = {
    "tum": (8, " ", "8 numbers: time in s, x, y, z in m, quaternion x, y, z, w, separated by blanks"),
    "kitti": (12, " ", "12 numbers: the upper three rows of the pose matrix, separated by blanks"),
    "euroc": (8, ",", "at least 8 numbers: time in ns, x, y, z in m, quaternion w, x, y, z, separated by commas"),
}
"""By the name of a format: numbers of a line, what separates them, and both in words."""

_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
_STDS = tuple(f"std_{axis}" for axis in AXES)
_COVARIANCES = (("cov_xy_m2", 0, 1), ("cov_xz_m2", 0, 2), ("cov_yz_m2", 1, 2))
_VELOCITY = tuple(f"v{axis}_mps" for axis in "xyz")


@dataclass(frozen=True, eq=False)
class PoseTrajectory:
    """Poses over time: `times` (n,) s, `positions` (n, 3) m, `quaternions` (n, 4) w, x, y, z, body to world, or None.

    `name`: in messages and tables. `notices`: one line for each anomaly found while reading. The height is NaN where it
    is unknown. Raises UnusableInput for other shapes, no poses, numbers that are not finite, and a zero quaternion.
    """

    times: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray | None = None
    name: str = "trajectory"
    notices: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.times)
        shapes = {"positions": (n, 3)} | ({} if self.quaternions is None else {"quaternions": (n, 4)})
        for field, shape in shapes.items():
            if np.shape(getattr(self, field)) != shape:
                raise UnusableInput(
                    f"{self.name}: {field} have shape {np.shape(getattr(self, field))}, expected {shape} for {n} times"
                )
        if n == 0:
            raise UnusableInput(f"{self.name}: no poses, expected at least one")
        if not (np.isfinite(self.times).all() and np.isfinite(self.positions[:, :2]).all()):
            raise UnusableInput(f"{self.name}: a time or position is not finite; leave such poses out")
        if self.quaternions is not None:
            sizes = np.linalg.norm(self.quaternions, axis=1, keepdims=True)
            usable = (sizes > 0) & np.isfinite(sizes)
            if not usable.all():
                row = int(np.argmin(usable))
                what = "a zero quaternion" if sizes[row] == 0 else "a quaternion that is not finite"
                raise UnusableInput(f"{self.name}: pose {row + 1} has {what}, expected a unit quaternion")
            object.__setattr__(self, "quaternions", self.quaternions / sizes)

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
        if self.quaternions is not None:
            columns |= dict(zip(QUATERNION, self.quaternions.T, strict=True))
        return pl.DataFrame(columns).with_columns(pl.col(AXES).fill_nan(None))


def usable_rows(table: pl.DataFrame) -> pl.DataFrame:
    """The rows with an estimate, by `status`, time and position, in the order of time."""
    usable = pl.all_horizontal(pl.col("t_s", "x_m", "y_m").is_finite()).fill_null(False)
    if "status" in table.columns:
        usable &= ~pl.col("status").is_in(NO_ESTIMATE).fill_null(False)
    return table.filter(usable).sort("t_s", maintain_order=True)


def trajectory_of_table(table: pl.DataFrame, name: str) -> PoseTrajectory:
    """The poses of a table with columns t_s, x_m, y_m and optionally z_m and qw, qx, qy, qz, of one tag.

    Rows without an estimate are left out; a row without attitude leaves all without. Raises UnusableInput if nothing
    remains.
    """
    rows = usable_rows(table)
    times, *places = (float_column(rows, column) for column in ("t_s", *AXES))
    quaternions = np.stack([float_column(rows, column) for column in QUATERNION], axis=1)
    attitude = quaternions if np.isfinite(quaternions).all() and len(quaternions) else None
    return PoseTrajectory(times, np.stack(places, axis=1), attitude, name)


def quaternions_of(matrices: np.ndarray) -> np.ndarray:
    """The unit quaternions (n, 4) w, x, y, z, w not negative, of rotation matrices (n, 3, 3).

    The largest of the four squares is computed first, so that no division is by a number near zero (Shepperd 1978).
    """
    m = np.asarray(matrices, float)
    trace = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    squares = np.stack([trace, *(2 * m[:, k, k] - trace for k in range(3))], axis=1) + 1.0
    largest = squares.argmax(axis=1)
    # Row k of the symmetric matrix 4 q qᵀ is q times 4 of its component k.
    products = np.empty((len(m), 4, 4))
    products[:, range(4), range(4)] = squares
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        products[:, 0, k + 1] = products[:, k + 1, 0] = m[:, i, j] - m[:, j, i]
        products[:, i + 1, j + 1] = products[:, j + 1, i + 1] = m[:, i, j] + m[:, j, i]
    rows = products[np.arange(len(m)), largest]
    quaternions = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return np.where(quaternions[:, :1] < 0, -quaternions, quaternions)


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

    def trajectory(self, poses: PoseTrajectory) -> PoseTrajectory:
        """The image of a trajectory; attitudes are turned with it."""
        quaternions = poses.quaternions
        if quaternions is not None:
            quaternions = quaternions_of(self.rotation @ rotation_matrices(quaternions))
        return replace(poses, positions=self.points(poses.positions), quaternions=quaternions)

    def table(self, tracks: pl.DataFrame) -> pl.DataFrame:
        """The image of a table of estimates: positions, attitudes, velocities and covariances, where it has them."""
        positions = self.points(np.stack([float_column(tracks, axis) for axis in AXES], axis=1))
        columns = dict(zip(AXES, positions.T, strict=True))
        if _VELOCITY[0] in tracks.columns:
            velocity = np.stack([float_column(tracks, axis) for axis in _VELOCITY], axis=1)
            turned = replace(self, translation=np.zeros(3)).points(velocity)
            columns |= dict(zip(_VELOCITY, turned.T, strict=True))
        if _STDS[0] in tracks.columns:
            columns |= self._covariances(tracks)
        if QUATERNION[0] in tracks.columns:
            quaternions = np.stack([float_column(tracks, name) for name in QUATERNION], axis=1)
            known = np.isfinite(quaternions).all(axis=1)
            quaternions[known] = quaternions_of(self.rotation @ rotation_matrices(quaternions[known]))
            columns |= dict(zip(QUATERNION, quaternions.T, strict=True))
        kept = {name: values for name, values in columns.items() if name in tracks.columns}
        return tracks.with_columns(pl.Series(name, values).fill_nan(None) for name, values in kept.items())

    def _covariances(self, tracks: pl.DataFrame) -> dict[str, np.ndarray]:
        covariance, factor = covariances(tracks), self.scale * self.rotation
        if self.flat:
            # An unknown variance of the height, which the map leaves alone, must not reach the other axes.
            turn = factor[:2, :2]
            covariance[:, :2, :2] = turn @ covariance[:, :2, :2] @ turn.T
            covariance[:, :2, 2] = covariance[:, 2, :2] = covariance[:, :2, 2] @ turn.T
        else:
            covariance = factor @ covariance @ factor.T
        stds = {name: np.sqrt(covariance[:, k, k]) for k, name in enumerate(_STDS)}
        return stds | {name: covariance[:, i, j] for name, i, j in _COVARIANCES}


def read_trajectory(path: Path | str, kind: Kind | None = None) -> PoseTrajectory:
    """The poses in a TUM, KITTI or EuRoC file, sorted by time; lines that begin with # are comments.

    `kind`: the format, by default by the file's name or first lines. The rows of KITTI poses, which have no times,
    are counted as seconds. A file whose attitudes are all the identity has none. Raises UnusableInput with file and
    line.
    """
    path = Path(path)
    ending = path.suffix.lower().removeprefix(".")
    begin = "" if kind or ending in _FORMS else beginning_of(path)
    known: str = kind or next(
        (k for k in _FORMS if k == ending or re.search(FORMATS[k].begins, begin, re.MULTILINE)), ""
    )
    if known not in _FORMS:
        forms = "; or ".join(words for *_, words in _FORMS.values())
        raise UnusableInput(
            f"{path}: no trajectory format is recognised; expected lines of {forms}; name the format, or bring a table "
            "into this form by `trackwright import`"
        )
    numbers, notices = _numbers(path, known), list[str]()
    if known == "kitti":
        matrices = numbers.reshape(-1, 3, 4)
        error = np.abs(matrices[:, :, :3] @ matrices[:, :, :3].transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        wrong = (error > 1e-3) | (np.linalg.det(matrices[:, :, :3]) < 0)
        if wrong.any():
            row = int(wrong.argmax()) + 1
            raise UnusableInput(f"{path}: pose {row}: its first three columns are no rotation; expected KITTI poses")
        stamps, positions, quaternions = np.arange(len(numbers), dtype=float), matrices[:, :, 3], matrices[:, :, :3]
        quaternions = quaternions_of(quaternions)
        notices.append("KITTI poses have no times; the rows are counted as seconds; a TUM file or a table has times")
    else:
        stamps, positions = numbers[:, 0] / (1e9 if known == "euroc" else 1.0), numbers[:, 1:4]
        quaternions = np.roll(numbers[:, 4:8], 1, axis=1) if known == "tum" else numbers[:, 4:8]
    stamps, wraps = unwrapped_times(stamps)
    refuse_lost_digits(f"{path}", pl.DataFrame({"t_s": stamps, **dict(zip(AXES, positions.T, strict=True))}))
    steps = np.diff(stamps)
    if (at := restarted_at(stamps)) is not None:
        raise UnusableInput(
            f"{path}: pose {at + 1}: {stamps[at]:.3f} s after {stamps[:at].max():.3f} s: the clock went back; "
            "expected times that increase; make the poses before and after it two files"
        )
    if (steps < 0).any():
        back = f"{int((steps < 0).sum())}, by {-float(steps.min()):.6g} s at most"
        wraps.append(f"rows earlier than the previous row: {back}; sorted")
        order = np.argsort(stamps, kind="stable")
        stamps, positions, quaternions = stamps[order], positions[order], quaternions[order]
    if no_attitude := bool((quaternions == _IDENTITY).all()):
        wraps.append("every quaternion is the identity; read as positions without attitude")
    attitude = None if no_attitude else quaternions
    return PoseTrajectory(stamps, positions, attitude, path.name, (*notices, *wraps))


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The poses of a file as a table truth or fixes of each mapping; raises UnusableInput with file and line."""
    source = Source()
    for mapping in asked.mappings:
        if mapping.table not in ("truth", "fixes"):
            raise UnusableInput(f"{path}: poses are a table truth or fixes, not {mapping.table}; give --table truth")
        if mapping.columns:
            fixed = f"{listed(mapping.columns)}: the columns of {name} are fixed; leave --columns out"
            raise UnusableInput(f"{path}: {fixed}")
        if mapping.tag is None:
            raise UnusableInput(f"{path}: {name} files do not name the tag; give it: --tag ID")
        poses = read_trajectory(path, name)  # type: ignore[arg-type]
        table = poses.to_polars(mapping.tag)
        table = table if mapping.table == "truth" else table.select("t_s", "tag", *AXES)
        source.add(mapping.table, table, poses.notices)
    return source


def write_trajectory(trajectory: PoseTrajectory, path: Path | str, kind: Literal["tum", "kitti"] | None = None) -> Path:
    """Writes the poses with all digits, and returns the path; the format is by default the ending of the name.

    KITTI poses have no times: these are in a second file, one a line. An unknown height is written as 0, an unknown
    attitude as the identity. Raises UnusableInput where the format is not clear.
    """
    path = Path(path)
    kind = kind or path.suffix.lower().removeprefix(".")  # type: ignore[assignment]
    given = trajectory.quaternions
    quaternions = np.tile(_IDENTITY, (len(trajectory), 1)) if given is None else given
    positions = np.nan_to_num(trajectory.positions)
    if kind == "tum":
        rows = np.column_stack([trajectory.times, positions, np.roll(quaternions, -1, axis=1)])
    elif kind == "kitti":
        stamps = "".join(f"{time!r}\n" for time in trajectory.times.tolist())
        atomic_write(written_files(path, kind)[1], lambda target: target.write_text(stamps, encoding="utf-8"))
        rows = np.concatenate([rotation_matrices(quaternions), positions[:, :, None]], axis=2).reshape(-1, 12)
    else:
        raise UnusableInput(f"{path}: the format is not clear from the name; expected tum or kitti")
    text = "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist())
    return atomic_write(path, lambda target: target.write_text(text, encoding="utf-8"))


def written_files(path: Path, kind: str) -> list[Path]:
    """The files that `write_trajectory` writes: the path, and for KITTI poses the file of their times."""
    return [path, path.with_suffix(".times.txt")] if kind == "kitti" else [path]


def _numbers(path: Path, kind: str) -> np.ndarray:
    """The numbers of all rows; raises UnusableInput with the line of the first that is not `kind`."""
    wanted, separator, words = _FORMS[kind]
    file, _ = read_rows(path, Reading(separator=separator, header="none"))
    cells = file.frame.select(pl.all().str.strip_chars())
    numbers = cells.select(pl.all().cast(pl.Float64, strict=False)).to_numpy()[:, :wanted]
    count = cells.select(pl.sum_horizontal(pl.all() != "")).to_series().to_numpy()
    fitting = (count >= wanted) if kind == "euroc" else (count == wanted)
    usable = fitting & np.isfinite(numbers).all(axis=1)
    if usable.all():
        return numbers
    row = int(usable.argmin())
    line, texts = file.lines[row], cells.row(row)  # type: ignore[index]
    if not fitting[row]:
        other = " " if kind == "euroc" else ","
        marks = f"; the separator seems to be {other!r}" if any(other in text for text in texts) else ""
        raise UnusableInput(f"{path}: line {line} has {counted(int(count[row]), 'number')}; expected {words}{marks}")
    column = int(np.isfinite(numbers[row]).argmin())
    found = f"{path}: line {line}, column {column + 1}: {texts[column][:40]!r}"
    point = "; decimals have a point" * ("," in texts[column])
    raise UnusableInput(f"{found}; expected a finite number; a line has {words}{point}")
