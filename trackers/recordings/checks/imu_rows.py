"""Means and turns of an IMU over windows, and the turn rates and gravity that a true attitude implies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.recordings.kinds import QUATERNION, layout

MOST_ROWS = 30_000
"""Rows of an IMU that are looked at, the first ones."""

GAP_S = 0.25
"""Time between two rows, s, above which no window lies across them."""

RATE_S = 0.1
"""Half the time over which the rate of a true attitude is taken, s."""


def between(
    times: Float[np.ndarray, " N"], x: Float[np.ndarray, "N k"], start: Float[np.ndarray, " n"], end: np.ndarray
) -> Float[np.ndarray, "n k"]:
    """The changes of a series `x` from `start` to `end` (n,) s; NaN outside its times and across gaps."""
    found = np.stack([np.interp(end, times, c) - np.interp(start, times, c) for c in x.T], axis=1)
    gaps = np.concatenate([[0], np.cumsum(np.diff(times) > GAP_S)])
    first, last = np.searchsorted(times, start, side="right") - 1, np.searchsorted(times, end)
    inside = (first >= 0) & (last < len(times))
    inside &= gaps[np.maximum(first, 0)] == gaps[np.minimum(last, len(gaps) - 1)]
    found[~inside] = np.nan
    return found


def bent(
    times: Float[np.ndarray, " N"], x: Float[np.ndarray, "N k"], at: Float[np.ndarray, " n"], reach: float
) -> Float[np.ndarray, "n k"]:
    """The second derivative of a series, as its mean over `reach` s before and after `at` with triangular weights."""
    return (between(times, x, at, at + reach) - between(times, x, at - reach, at)) / reach**2


def spaced(times: Float[np.ndarray, " N"], step: float) -> Float[np.ndarray, " n"]:
    """Times, s, that are a multiple of `step` apart, near those given: no more than these, however long the gaps."""
    return np.unique(np.floor(times / step)) * step


class ImuRows(NamedTuple):
    """`times` (N,) s, and integrals over time: of specific force (N, 3) m/s and of the turn rate (N, 3) rad.

    `lifted` (N, 1) m: the second integral of the size of the specific force, less its mean: nearly the height.
    """

    times: Float[np.ndarray, " N"]
    pushed: Float[np.ndarray, "N 3"]
    turned: Float[np.ndarray, "N 3"]
    lifted: Float[np.ndarray, "N 1"]

    def between(self, which: Float[np.ndarray, "N k"], start: np.ndarray, end: np.ndarray) -> Float[np.ndarray, "n k"]:
        """As `between`, of one of the integrals."""
        return between(self.times, which, start, end)


def imu_rows(table: pl.DataFrame, tag: str) -> ImuRows | None:
    """The whole rows of a tag; None with fewer than ten."""
    columns = layout("imu", table.columns).values
    rows = table.filter(pl.col("tag") == tag).select("t_s", *columns).drop_nulls().unique("t_s", keep="first")
    rows = rows.sort("t_s").head(MOST_ROWS)
    if len(rows) < 10:
        return None
    t, x = rows["t_s"].to_numpy(), rows.select(columns).to_numpy()
    sums = _integral(t, x)
    size = np.linalg.norm(x[:, :3], axis=1, keepdims=True)
    return ImuRows(t, sums[:, :3], sums[:, 3:], _integral(t, _integral(t, size - size.mean())))


def _integral(t: Float[np.ndarray, " N"], x: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "N k"]:
    areas = (x[1:] + x[:-1]) / 2 * np.diff(t)[:, None]
    return np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(areas, axis=0)])


class Attitude(NamedTuple):
    """The true attitude of a tag: `times` (N,) s, `quaternions` (N, 4) w, x, y, z, from body to world."""

    times: Float[np.ndarray, " N"]
    quaternions: Float[np.ndarray, "N 4"]

    def rates(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Turn rates (n, 3), rad/s in body axes, and the times (n,), s, about which they are taken."""
        after = np.minimum(np.searchsorted(self.times, self.times + 2 * RATE_S * 0.999), len(self.times) - 1)
        span = self.times[after] - self.times
        known = (span > 0) & (span < GAP_S)
        a, b = self.quaternions[known], self.quaternions[after[known]]
        scalar = np.einsum("ni,ni->n", a, b)
        vector = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
        size = np.linalg.norm(vector, axis=1)
        turn = 2.0 * np.arctan2(size, np.abs(scalar)) * np.where(scalar < 0, -1.0, 1.0) / np.maximum(size, 1e-12)
        return (self.times + span / 2)[known], turn[:, None] * vector / span[known, None]

    def up(self, times: np.ndarray) -> Float[np.ndarray, "n 3"]:
        """The world's z in body axes (n, 3), of the rows before `times`."""
        row = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 1)
        return np.asarray(rotation_matrices(self.quaternions[row])[:, 2, :])


def true_attitude(truth: pl.DataFrame) -> Attitude | None:
    """The attitude in the truth of one tag; None without quaternions."""
    if "qw" not in truth.columns:
        return None
    own = truth.select("t_s", *QUATERNION).drop_nulls().unique("t_s", keep="first").sort("t_s").head(MOST_ROWS)
    q = own.select(QUATERNION).to_numpy()
    return Attitude(own["t_s"].to_numpy(), q / np.linalg.norm(q, axis=1, keepdims=True)) if len(own) > 10 else None
