"""Noise levels in closed form from differences of position fixes.

    d(τ) = z(t + τ) − 2 z(t) + z(t − τ)        E d² = 6 R + ⅔ q τ³        E (z(t + τ) − z(t))² = 2 R + r τ

for straight motion with white acceleration of density q (triangular weights, whose square integrates to ⅔ τ³), for a
random walk of density r, and fixes with noise R: short lags show the noise, long ones the motion (Mehra 1970 does the
same with innovations). Mean squares are estimated from the median absolute difference of normal numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.tunable import Covariance, Scale
from trackwright.trackers.parts.fixes import FIXES

LAGS = 1, 2, 4, 8, 16, 32
"""Fixes between those of a difference."""

MAX_LAG_S = 4.0
"""Longest lag, s: motion is not straight for longer."""

MIN_DIFFERENCES = 10
"""Fewest differences for a median."""

NORMAL_MEDIAN = 0.6744897501960817
"""Median absolute value of a standard normal number."""


@dataclass(frozen=True)
class FixNoiseLevels:
    """Noise of fixes, horizontal and vertical, m; horizontal acceleration, m/s² per √Hz; height random walk, m/√s.

    NaN for unknown ones.
    """

    horizontal: float
    vertical: float
    acceleration: float
    height_walk: float

    def of(self, node: Scale | Covariance) -> float | None:
        """The noise level of a tunable with this role, axis and unit; None if unknown.

        Of a covariance: its horizontal part.
        """
        is_vertical, found = node.axis == "vertical", float("nan")
        if node.axis is None:
            return None
        if node.role == "process noise" and node.unit == "m/s^2/sqrt(Hz)" and not is_vertical:
            found = self.acceleration
        elif node.role == "process noise" and node.unit == "m/sqrt(s)" and is_vertical:
            found = self.height_walk
        elif node.role == "measurement noise" and node.unit in ("m", "m^2"):
            found = self.vertical if is_vertical else self.horizontal
        return found if np.isfinite(found) and found > 0 else None


def noise_levels_of_fixes(batch: Batch) -> FixNoiseLevels | None:
    """The noise levels estimated from a batch's fixes; None without fixes, or with too few."""
    if FIXES not in batch.readings:
        return None
    reading = batch.readings[FIXES]
    times = np.cumsum(np.asarray(batch.dt, float), axis=0)
    seen = np.asarray(reading.seen) & np.asarray(batch.valid)[:, None]
    values = np.asarray(reading.values, float)
    axes = [_noise_and_motion(times, values[:, k], seen[:, k], second=k < 2) for k in range(min(3, values.shape[1]))]
    planar = [a for a in axes[:2] if a is not None]
    if not planar:
        return None
    horizontal, acceleration = np.sqrt(np.mean(planar, axis=0))
    height = axes[2] if len(axes) > 2 else None
    vertical, height_walk = np.sqrt(height) if height is not None else (np.nan, np.nan)
    return FixNoiseLevels(float(horizontal), float(vertical), float(acceleration), float(height_walk))


def _noise_and_motion(
    times: Float[np.ndarray, "T B"], values: Float[np.ndarray, "T B"], seen: Bool[np.ndarray, "T B"], second: bool
) -> tuple[float, float] | None:
    """R and q of an axis (T, B) from second differences, or R and r from first ones; None for too few."""
    noise, motion, mean_squares = [], [], []
    for lag in LAGS:
        found = [_differences(t, z, s, lag, second) for t, z, s in zip(times.T, values.T, seen.T, strict=True)]
        spans, differences = (np.concatenate(x) for x in zip(*found, strict=True))
        if len(spans) < MIN_DIFFERENCES or np.median(spans) > MAX_LAG_S:
            break
        span = float(np.median(spans))
        noise.append(6.0 if second else 2.0)
        motion.append(2.0 / 3.0 * span**3 if second else span)
        mean_squares.append(float(np.median(np.abs(differences)) / NORMAL_MEDIAN) ** 2)
    if len(mean_squares) < 2 or min(mean_squares) <= 0:
        return None
    return _not_negative(np.array([noise, motion]).T / np.array(mean_squares)[:, None])


def _differences(
    times: Float[np.ndarray, " T"],
    values: Float[np.ndarray, " T"],
    seen: Bool[np.ndarray, " T"],
    lag: int,
    second: bool,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The lags, s, and values of all differences over `lag` fixes with equal time steps."""
    t, z = times[seen], values[seen]
    if len(t) <= 2 * lag:
        return np.zeros(0), np.zeros(0)
    if not second:
        spans = t[lag:] - t[:-lag]
        return spans[spans > 0], (z[lag:] - z[:-lag])[spans > 0]
    before, after = t[lag:-lag] - t[: -2 * lag], t[2 * lag :] - t[lag:-lag]
    even = (before > 0) & (np.abs(after - before) <= 0.2 * before)
    return before[even], (z[2 * lag :] - 2 * z[lag:-lag] + z[: -2 * lag])[even]


def _not_negative(rows: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    """The non-negative least-squares solution (2,) of rows (n, 2) · x = 1."""
    solution = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0]
    if np.all(solution >= 0):
        return float(solution[0]), float(solution[1])
    alone = [float(max(column.sum(), 0.0) / (column @ column)) for column in rows.T]
    residual = [float(np.sum((alone[k] * rows[:, k] - 1.0) ** 2)) for k in range(2)]
    return (alone[0], 0.0) if residual[0] <= residual[1] else (0.0, alone[1])
