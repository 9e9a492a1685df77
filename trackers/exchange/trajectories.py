"""Trajectories: lists of poses, the maps that move them, and their files in the formats TUM, KITTI and EuRoC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import span
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.rows import covariances
from trackwright.trackers.exchange.formats import FORMATS, beginning_of
from trackwright.trackers.exchange.mapping import Asked, Source, numbers_of
from trackwright.trackers.exchange.source_rows import Reading, read_rows
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.kinds import QUATERNION
from trackwright.trackers.recordings.tables import restarted_at, unwrapped_times
from trackwright.trackers.recordings.tracks_table import NO_ESTIMATE

AXES = ("x_m", "y_m", "z_m")
Kind = Literal["tum", "kitti", "euroc"]

_COLUMNS = {
    "tum": "8 numbers: time in s, x, y, z in m, quaternion x, y, z, w, separated by blanks",
    "kitti": "12 numbers: the upper three rows of the pose matrix, separated by blanks",
    "euroc": "at least 8 numbers: time in ns, x, y, z in m, quaternion w, x, y, z, separated by commas",
}
_EUROC_HEADER = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
)
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


def kind_of(path: Path | str) -> Kind:
    """The format of a trajectory file by its name, or else by its first line of numbers.

    Raises UnusableInput for a file that can't be read and for one of no known format.
    """
    path = Path(path)
    suffix = path.suffix.lower().removeprefix(".")
    begin = "" if suffix in get_args(Kind) else beginning_of(path)
    for kind in get_args(Kind):
        begins = FORMATS[kind].begins
        if kind == suffix or (begins is not None and begins.search(begin)):
            return kind  # type: ignore[no-any-return]
    raise UnusableInput(
        f"{path}: no trajectory format is recognised; expected lines of {'; or '.join(_COLUMNS.values())}; "
        "name the format, or bring a table into this form by `trackwright import`"
    )


def read_trajectory(path: Path | str, kind: Kind | None = None, times: Path | str | None = None) -> PoseTrajectory:
    """The poses in a TUM, KITTI or EuRoC file, sorted by time; lines that begin with # are comments.

    `kind`: the format, by default `kind_of` the file. `times`: of KITTI poses, a file with one time, s, per line;
    without it the rows are counted as seconds, with a notice. A file whose attitudes are all the identity has none.
    Raises UnusableInput with file and line.
    """
    path = Path(path)
    kind = kind or kind_of(path)
    if kind not in get_args(Kind):
        raise UnusableInput(f"kind = {kind!r}; expected one of {', '.join(get_args(Kind))}")
    numbers = _numbers(path, kind)
    notices = []
    if kind == "kitti":
        matrices = numbers.reshape(-1, 3, 4)
        stamps = np.arange(len(numbers), dtype=float) if times is None else _stamps(Path(times), len(numbers))
        if times is None:
            notices.append("KITTI poses have no times; the rows are counted as seconds; give their times in a file")
        _check_rotations(path, matrices[:, :, :3])
        positions, quaternions = matrices[:, :, 3], quaternions_of(matrices[:, :, :3])
    else:
        stamps, positions = numbers[:, 0], numbers[:, 1:4]
        quaternions = np.roll(numbers[:, 4:8], 1, axis=1) if kind == "tum" else numbers[:, 4:8]
        if kind == "euroc":
            stamps = stamps / 1e9
    stamps, wraps = unwrapped_times(stamps)
    notices += wraps
    refuse_lost_digits(path, stamps)
    if (np.diff(stamps) < 0).any():
        at = restarted_at(stamps)
        if at is not None:
            raise UnusableInput(
                f"{path}: pose {at + 1}: {stamps[at]:.3f} s after {stamps[:at].max():.3f} s: the clock went back; "
                "expected times that increase; make the poses before and after it two files"
            )
        back, most = int((np.diff(stamps) < 0).sum()), -float(np.diff(stamps).min())
        notices.append(f"rows earlier than the previous row: {back}, by {most:.6g} s at most; sorted")
        order = np.argsort(stamps, kind="stable")
        stamps, positions, quaternions = stamps[order], positions[order], quaternions[order]
    attitude = None if (quaternions == _IDENTITY).all() else quaternions
    if attitude is None:
        notices.append("every quaternion is the identity; read as positions without attitude")
    return PoseTrajectory(stamps, positions, attitude, path.name, tuple(notices))


def refuse_lost_digits(path: Path, stamps: np.ndarray) -> None:
    """Raises UnusableInput where most of the poses have the time, s, of another."""
    if 2 * (different := len(np.unique(stamps))) < len(stamps):
        found = "one time" if different == 1 else f"{different} times"
        raise UnusableInput(
            f"{path}: {len(stamps)} poses, {found}: the stamps have lost their digits; expected a time for each pose; "
            "write them with all digits"
        )


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The poses of a file as a table truth or fixes of each mapping; raises UnusableInput with file and line."""
    source = Source()
    for mapping in asked.mappings:
        if mapping.table not in ("truth", "fixes"):
            raise UnusableInput(f"{path}: poses are a table truth or fixes, not {mapping.table}; give --table truth")
        if mapping.columns:
            raise UnusableInput(
                f"{path}: {listed(mapping.columns)}: the columns of {name} are fixed; leave --columns out"
            )
        if mapping.tag is None:
            raise UnusableInput(f"{path}: {name} files do not name the tag; give it: --tag ID")
        poses = read_trajectory(path, name)  # type: ignore[arg-type]
        table = poses.to_polars(mapping.tag)
        source.add(
            mapping.table, table if mapping.table == "truth" else table.select("t_s", "tag", *AXES), poses.notices
        )
    return source


def write_trajectory(trajectory: PoseTrajectory, path: Path | str, kind: Kind | None = None) -> Path:
    """Writes the poses with all digits, and returns the path; the format is by default the ending of the name.

    The times of KITTI poses go to a second file, NAME.times.txt. An unknown height is written as 0, an unknown attitude
    as the identity: none of these formats can leave them out. Raises UnusableInput for an unknown format and if the
    file cannot be written.
    """
    path = Path(path)
    kind = kind or path.suffix.lower().removeprefix(".")  # type: ignore[assignment]
    if kind not in get_args(Kind):
        raise UnusableInput(f"{path}: the format is not clear from the name; expected {', '.join(get_args(Kind))}")
    positions = np.nan_to_num(trajectory.positions)
    given = trajectory.quaternions
    quaternions = np.tile(_IDENTITY, (len(trajectory), 1)) if given is None else given
    if kind == "tum":
        rows = np.column_stack([trajectory.times, positions, np.roll(quaternions, -1, axis=1)])
        text = _text(rows, " ")
    elif kind == "kitti":
        stamps = "".join(f"{time!r}\n" for time in trajectory.times.tolist())
        atomic_write(written_files(path, kind)[1], lambda target: target.write_text(stamps, encoding="utf-8"))
        poses = np.concatenate([rotation_matrices(quaternions), positions[:, :, None]], axis=2)
        text = _text(poses.reshape(-1, 12), " ")
    else:
        nanoseconds = [str(round(time * 1e9)) for time in trajectory.times.tolist()]
        lines = _text(np.column_stack([positions, quaternions]), ",").splitlines()
        text = _EUROC_HEADER + "".join(f"{t},{line}\n" for t, line in zip(nanoseconds, lines, strict=True))
    return atomic_write(path, lambda target: target.write_text(text, encoding="utf-8"))


def written_files(path: Path, kind: Kind) -> list[Path]:
    """The files that `write_trajectory` writes: the path, and of KITTI poses that of their times."""
    return [path, path.with_suffix(".times.txt")] if kind == "kitti" else [path]


def _text(rows: np.ndarray, separator: str) -> str:
    """The rows as lines of numbers with all their digits."""
    return "".join(separator.join(map(repr, row)) + "\n" for row in rows.tolist())


def _numbers(path: Path, kind: Kind) -> np.ndarray:
    """The numbers of all rows; raises UnusableInput with the line of the first that is not `kind`."""
    wanted = 12 if kind == "kitti" else 8
    file, _ = read_rows(path, Reading("," if kind == "euroc" else " ", header="none"))
    numbers = file.frame.select(pl.all().str.strip_chars().cast(pl.Float64, strict=False)).to_numpy()
    count = file.frame.select(pl.sum_horizontal(pl.all().str.strip_chars() != "")).to_series().to_numpy()
    fitting = (count >= wanted) if kind == "euroc" else (count == wanted)
    usable = fitting & np.isfinite(numbers[:, :wanted]).all(axis=1)
    if usable.all():
        return numbers[:, :wanted]
    row = int(usable.argmin())
    cells, where = file.frame.row(row), f"{path}: line {(file.lines or ())[row]}"
    if not fitting[row]:
        other = " " if kind == "euroc" else ","
        marks = f"; the separator seems to be {other!r}" if any(other in cell.strip() for cell in cells) else ""
        raise UnusableInput(f"{where} has {counted(int(count[row]), 'number')}; expected {_COLUMNS[kind]}{marks}")
    column = int(np.isfinite(numbers[row, :wanted]).argmin())
    point = "; decimals have a point" * ("," in cells[column])
    found = f"{where}, column {column + 1}: {cells[column][:40]!r}"
    raise UnusableInput(f"{found}; expected a finite number; a line has {_COLUMNS[kind]}{point}")


def _stamps(path: Path, poses: int) -> np.ndarray:
    file, _ = read_rows(path, Reading(header="none"))
    times = numbers_of(file, file.frame.columns[0])
    if len(times) != poses or times.has_nulls():
        raise UnusableInput(f"{path}: {len(times)} times for {poses} poses; expected as many, in s")
    return times.to_numpy()


def _check_rotations(path: Path, matrices: np.ndarray) -> None:
    error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = (error > 1e-3) | (np.linalg.det(matrices) < 0)
    if wrong.any():
        row = int(wrong.argmax())
        raise UnusableInput(f"{path}: pose {row + 1}: its first three columns are no rotation; expected KITTI poses")
