"""Trajectory files of other programs: TUM, KITTI and EuRoC, read and written."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.exchange.poses import PoseTrajectory, quaternions_of
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.input_file import file_bytes
from trackwright.trackers.recordings.tables import restarted_at

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


def kind_of(path: Path | str) -> Kind:
    """The format of a trajectory file by its name, or else by the length of its first line of numbers.

    Raises UnusableInput for a file that can't be read and for one of no known format.
    """
    path = Path(path)
    suffix = path.suffix.lower().removeprefix(".")
    if suffix in get_args(Kind):
        return suffix  # type: ignore[return-value]
    for _, line in _lines(path):
        cells = [cell for cell in (line.split(",") if "," in line else line.split()) if cell.strip()]
        # EuRoC counts whole nanoseconds.
        if "," in line and len(cells) >= 8 and "." not in cells[0]:
            return "euroc"
        if "," not in line and len(cells) in (8, 12):
            return "tum" if len(cells) == 8 else "kitti"
        break
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
    if (np.diff(stamps) < 0).any():
        at = restarted_at(stamps)
        if at is not None:
            raise UnusableInput(
                f"{path}: pose {at + 1}: {stamps[at]:.3f} s after {stamps[:at].max():.3f} s: the clock went back; "
                "expected times that increase; make the poses before and after it two files"
            )
        notices.append(f"rows earlier than the previous row: {int((np.diff(stamps) < 0).sum())}; sorted")
        order = np.argsort(stamps, kind="stable")
        stamps, positions, quaternions = stamps[order], positions[order], quaternions[order]
    if (quaternions == _IDENTITY).all():
        notices.append("every quaternion is the identity; read as positions without attitude")
        return PoseTrajectory(stamps, positions, None, path.name, tuple(notices))
    return PoseTrajectory(stamps, positions, quaternions, path.name, tuple(notices))


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
        atomic_write(path.with_suffix(".times.txt"), lambda target: target.write_text(stamps, encoding="utf-8"))
        poses = np.concatenate([rotation_matrices(quaternions), positions[:, :, None]], axis=2)
        text = _text(poses.reshape(-1, 12), " ")
    else:
        nanoseconds = [str(round(time * 1e9)) for time in trajectory.times.tolist()]
        lines = _text(np.column_stack([positions, quaternions]), ",").splitlines()
        text = _EUROC_HEADER + "".join(f"{t},{line}\n" for t, line in zip(nanoseconds, lines, strict=True))
    return atomic_write(path, lambda target: target.write_text(text, encoding="utf-8"))


def _text(rows: np.ndarray, separator: str) -> str:
    """The rows as lines of numbers with all their digits."""
    return "".join(separator.join(map(repr, row)) + "\n" for row in rows.tolist())


def _lines(path: Path) -> list[tuple[int, str]]:
    """The lines that are neither empty nor comments, with their numbers."""
    try:
        text = file_bytes(path).decode("utf-8-sig")
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}); check the file and its permissions") from error
    except UnicodeDecodeError as error:
        raise UnusableInput(f"{path}: is not UTF-8 text at byte {error.start}; expected a text file") from error
    stripped = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    return [(number, line) for number, line in stripped if line and not line.startswith("#")]


def _numbers(path: Path, kind: Kind) -> np.ndarray:
    """The numbers of all rows; raises UnusableInput with the line of the first that is not `kind`."""
    lines, separator = _lines(path), "," if kind == "euroc" else None
    if not lines:
        raise UnusableInput(f"{path}: holds no poses; expected lines of {_COLUMNS[kind]}")
    wanted = 12 if kind == "kitti" else 8
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = np.loadtxt([line for _, line in lines], delimiter=separator, ndmin=2)
        enough = found.shape[1] >= wanted if kind == "euroc" else found.shape[1] == wanted
        if enough and np.isfinite(found[:, :wanted]).all():
            return found[:, :wanted]
    except (ValueError, UserWarning):
        pass  # the loop below finds the line
    for number, line in lines:
        cells = line.split(separator)
        if len(cells) < wanted or (kind != "euroc" and len(cells) > wanted):
            raise UnusableInput(
                f"{path}: line {number} has {len(cells)} {'number' if len(cells) == 1 else 'numbers'}; expected "
                f"{_COLUMNS[kind]}{_other_separator(line, kind)}"
            )
        for column, cell in enumerate(cells[:wanted], 1):
            if not _is_finite(cell):
                raise UnusableInput(
                    f"{path}: line {number}, column {column}: {cell.strip()[:40]!r}; expected a finite number; "
                    f"a line has {_COLUMNS[kind]}" + ("; decimals have a point" if "," in cell else "")
                )
    raise UnusableInput(f"{path}: lines of different lengths; expected {_COLUMNS[kind]}")


def _other_separator(line: str, kind: Kind) -> str:
    """The fix, where the cells of a line are separated as those of another format."""
    if kind == "euroc":
        return "; it has blanks: put commas in their place" if "," not in line else ""
    return "; it has commas: put blanks in their place" if "," in line else ""


def _is_finite(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def _stamps(path: Path, poses: int) -> np.ndarray:
    lines = _lines(path)
    for number, line in lines:
        if not _is_finite(line):
            raise UnusableInput(f"{path}: line {number}: {line[:40]!r}; expected one time in s")
    if len(lines) != poses:
        raise UnusableInput(f"{path}: {len(lines)} times for {poses} poses; expected as many")
    return np.array([float(line) for _, line in lines])


def _check_rotations(path: Path, matrices: np.ndarray) -> None:
    error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = (error > 1e-3) | (np.linalg.det(matrices) < 0)
    if wrong.any():
        row = int(wrong.argmax())
        raise UnusableInput(f"{path}: pose {row + 1}: its first three columns are no rotation; expected KITTI poses")
