"""Noise levels in closed form from differences of readings that are places: fixes of a locating system.

    d(τ) = z(t + τ) − 2 z(t) + z(t − τ)        E d² = 6 R + ⅔ q τ³        E (z(t + τ) − z(t))² = 2 R + r τ

for straight motion disturbed by white acceleration of density q (a triangle of weights, whose square integrates to
⅔ τ³), for a random walk of density r, and readings with noise R: short lags show the noise, long ones the motion
(Mehra 1970 has the same of innovations). Mean squares are those of normal numbers with the differences' median size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trackers.core.recording import Batch
from trackers.parts.fixes import FIXES

LAGS = 1, 2, 4, 8, 16, 32
"""Rows between the readings of a difference."""

LONGEST = 4.0
"""Seconds that a lag may last: over longer ones nobody moves straight."""

LEAST = 10
"""Differences that make a median."""

MEDIAN_SIZE = 0.6744897501960817
"""The median size of a standard normal number."""


@dataclass(frozen=True)
class PlaceLevels:
    """Of places read: noise across and up, m; acceleration across, m/s² per √Hz; the height's walk, m per √s.

    NaN for what isn't known.
    """

    across: float
    up: float
    acceleration: float
    walk: float

    def level(self, name: str, unit: str) -> float | None:
        """What is known of a noise level with this name and unit; None for nothing."""
        path, last = set(name.split(".")[:-1]), name.split(".")[-1]
        vertical = last in ("sigma_vertical", "sigma_z")
        found = float("nan")
        if "motion" in path and unit == "m/s^2/sqrt(Hz)" and not vertical:
            found = self.acceleration
        elif "motion" in path and unit == "m/sqrt(s)" and vertical:
            found = self.walk
        elif "sensors" in path and FIXES in path and unit in ("m", "m^2"):
            found = self.up if vertical else self.across
        return found if np.isfinite(found) and found > 0 else None


def levels_of_places(batch: Batch) -> PlaceLevels | None:
    """The levels that a batch's fixes show; None where it holds none, or too few."""
    if FIXES not in batch.readings:
        return None
    reading = batch.readings[FIXES]
    times = np.cumsum(np.asarray(batch.dt, float), axis=0)
    seen = np.asarray(reading.seen) & np.asarray(batch.valid)[:, None]
    values = np.asarray(reading.values, float)
    axes = [_both(times, values[:, k], seen[:, k], second=k < 2) for k in range(min(3, values.shape[1]))]
    planar = [a for a in axes[:2] if a is not None]
    if not planar:
        return None
    (across, acceleration), up = np.sqrt(np.mean(planar, axis=0)), axes[2] if len(axes) > 2 else None
    height, walk = np.sqrt(up) if up is not None else (np.nan, np.nan)
    return PlaceLevels(float(across), float(height), float(acceleration), float(walk))


def _both(times: np.ndarray, values: np.ndarray, seen: np.ndarray, second: bool) -> tuple[float, float] | None:
    """Noise R and density q of an axis (T, B) by second differences, or R and r by first ones; None for too few."""
    noise, motion, sizes = [], [], []
    for lag in LAGS:
        found = [_differences(t, z, s, lag, second) for t, z, s in zip(times.T, values.T, seen.T, strict=True)]
        spans, differences = (np.concatenate(x) for x in zip(*found, strict=True))
        if len(spans) < LEAST or np.median(spans) > LONGEST:
            break
        span = float(np.median(spans))
        noise.append(6.0 if second else 2.0)
        motion.append(2.0 / 3.0 * span**3 if second else span)
        sizes.append(float(np.median(np.abs(differences)) / MEDIAN_SIZE) ** 2)
    if len(sizes) < 2 or min(sizes) <= 0:
        return None
    return _not_negative(np.array([noise, motion]).T / np.array(sizes)[:, None])


def _differences(
    times: np.ndarray, values: np.ndarray, seen: np.ndarray, lag: int, second: bool
) -> tuple[np.ndarray, np.ndarray]:
    """How long each difference over `lag` readings spans, s, and how large it is; only those of even steps."""
    t, z = times[seen], values[seen]
    if len(t) <= 2 * lag:
        return np.zeros(0), np.zeros(0)
    if not second:
        spans = t[lag:] - t[:-lag]
        return spans[spans > 0], (z[lag:] - z[:-lag])[spans > 0]
    before, after = t[lag:-lag] - t[: -2 * lag], t[2 * lag :] - t[lag:-lag]
    even = (before > 0) & (np.abs(after - before) <= 0.2 * before)
    return before[even], (z[2 * lag :] - 2 * z[lag:-lag] + z[: -2 * lag])[even]


def _not_negative(rows: np.ndarray) -> tuple[float, float]:
    """The two numbers ≥ 0 whose combinations by the rows (n, 2) are nearest to 1 each."""
    both = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0]
    if np.all(both >= 0):
        return float(both[0]), float(both[1])
    alone = [float(max(column.sum(), 0.0) / (column @ column)) for column in rows.T]
    misfit = [float(np.sum((alone[k] * rows[:, k] - 1.0) ** 2)) for k in range(2)]
    return (alone[0], 0.0) if misfit[0] <= misfit[1] else (0.0, alone[1])
