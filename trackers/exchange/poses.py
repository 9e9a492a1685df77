"""Trajectories as lists of poses, the common form of TUM, KITTI and EuRoC files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import span
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.kinds import QUATERNION
from trackwright.trackers.recordings.tracks_table import NO_ESTIMATE

AXES = ("x_m", "y_m", "z_m")


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
            largest = np.abs(self.quaternions).max(axis=1)
            usable = (largest > 0) & np.isfinite(largest)
            if not usable.all():
                row = int(np.argmin(usable))
                what = "a zero quaternion" if largest[row] == 0 else "a quaternion that is not finite"
                raise UnusableInput(f"{self.name}: pose {row + 1} has {what}, expected a unit quaternion")
            # Powers of two keep all digits, and the squares of any number finite.
            scaled = np.ldexp(self.quaternions, -np.frexp(largest)[1][:, None])
            object.__setattr__(self, "quaternions", scaled / np.linalg.norm(scaled, axis=1, keepdims=True))

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


def trajectory_of_table(table: pl.DataFrame, name: str) -> PoseTrajectory:
    """The poses of a table with columns t_s, x_m, y_m and optionally z_m and qw, qx, qy, qz, of one tag.

    Rows without an estimate (by `status`, time or position) are left out; a row without attitude leaves all without.
    Raises UnusableInput if nothing remains.
    """
    columns = [float_column(table, column) for column in ("t_s", *AXES)]
    usable = np.isfinite(columns[0]) & np.isfinite(columns[1]) & np.isfinite(columns[2])
    if "status" in table.columns:
        usable &= ~table["status"].is_in(NO_ESTIMATE).fill_null(False).to_numpy()
    quaternions = np.stack([float_column(table, column) for column in QUATERNION], axis=1)[usable]
    order = np.argsort(columns[0][usable], kind="stable")
    return PoseTrajectory(
        times=columns[0][usable][order],
        positions=np.stack(columns[1:], axis=1)[usable][order],
        quaternions=quaternions[order] if np.isfinite(quaternions).all() and len(quaternions) else None,
        name=name,
    )


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
