"""Mistakes in an IMU: signs, axes, scale, mounting and clock.

Without truth: gravity, a constant vector of the world, turns in body axes by du/dt = -ω × u, whatever the heading, so
that the specific force tests the signs and axes of the turn rates. With the true attitude: turn rates and gravity in
body axes are known, and sizes of turn rates, which no axes change, tell scale and delay. With true heights alone,
sizes of the specific force tell the delay, since they follow the vertical acceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks import CheckResult, Level
from trackwright.trackers.recordings.checks.changes import SignedAxes, signed_axes
from trackwright.trackers.recordings.kinds import QUATERNION, layout

MOST_TAGS, MOST_ROWS = 12, 30_000
"""Tags whose IMU is checked, and rows of each, the first ones."""

WINDOW_S, RATE_S, REACH_S, GAP_S = 1.0, 0.1, 0.3, 0.25
"""Times, s: over which gravity turns; half of that of a turn rate; half of that of a vertical acceleration; and between
two rows from where on no window lies across them."""

LEAST_WINDOWS, LEAST_TURN, LEAST_LIFT = 20, 0.05, 0.1
"""Windows, root mean square turn, rad, and standard deviation of vertical accelerations, m/s², that tell something."""

FIT, BETTER, SIMPLER, WORSE = 0.5, 0.4, 0.02, 2.0
"""Of other axes: least correlation, least gain of it, the share by which simpler ones are preferred, and the ratio of
errors from which the given ones are wrong."""

TILTED, SMALL_TURN = np.cos(np.radians(60.0)), np.radians(20.0)
"""Cosine of the angle of the mean specific force to z beyond which an IMU lies on its side, and a turn that may be."""

LONGEST_DELAY_S, STEP_S, LATENCY_S, CERTAIN, BLOCKS = 3.0, 0.02, 1.0, 5.0, 10
"""Delays that are tried and their steps, and one up to which nothing stops, s; standard errors from which one is told,
and blocks of time, each of which is left out once for these."""

SAME_TURN, SAME_LIFT = 0.7, 0.85
"""Least correlations of sizes of turn rates and of vertical accelerations from which the delay is known."""

READ_AS = (
    ("its quaternions as they are", (0, 1, 2, 3), np.ones(4)),
    ("its quaternions read as x, y, z, w", (3, 0, 1, 2), np.ones(4)),
    ("its quaternions read as z, w, x, y", (1, 2, 3, 0), np.ones(4)),
    ("its quaternions inverted", (0, 1, 2, 3), np.array([1.0, -1.0, -1.0, -1.0])),
)
"""How the quaternions of a truth may be meant, in words: the order and the signs of w, x, y, z."""

SAME_SCALE, RATES_IN = 0.2, {"rpm": 30 / np.pi, "degrees per second": 180 / np.pi}
"""Share by which sizes of turn rates may differ from the true ones, and what a rad/s is in other units."""


def check_imu(tables: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """Signs, axes, mounting and clock of the IMU of the first tags; an attitude of the sensor's own excuses it."""
    table, results = tables["imu"], list[CheckResult]()
    if set(QUATERNION) <= set(table.columns):
        return []
    for tag in table["tag"].unique(maintain_order=True).head(MOST_TAGS):
        if (rows := imu_rows(table, tag)) is None:
            continue
        found = list[CheckResult]()
        if "truth" in tables:
            truth = tables["truth"].filter(pl.col("tag") == tag)
            known = _against_attitude(rows, truth)
            found = _against_heights(rows, truth) if known is None else known
        found = found or [*_by_gravity(rows), *_mounting(rows)]
        results += (CheckResult(one.level, one.where, f"tag {tag}: {one.message}") for one in found)
    return results


def _by_gravity(rows: ImuRows) -> Iterator[CheckResult]:
    """An error where gravity turns in body axes otherwise than the turn rates have it, and as others would."""
    t, half, quarter = spaced(rows.times, WINDOW_S / 4), WINDOW_S / 2, WINDOW_S / 4
    before, middle, after = (
        between(rows.times, rows.pushed, at - quarter, at + quarter) / half for at in (t - half, t, t + half)
    )
    turned, change = between(rows.times, rows.turned, t - half, t + half), after - before
    # Longer turns are no longer small, and knocks are no gravity; what is unknown is neither.
    known = (np.linalg.norm(turned, axis=1) < 2.0) & (np.linalg.norm(change, axis=1) < 5.0)
    change, middle, turned = change[known], middle[known], turned[known]
    if len(turned) < LEAST_WINDOWS or np.sqrt(np.mean(turned**2)) < LEAST_TURN:
        return

    def fit(axes: SignedAxes) -> float:
        x = -np.cross(turned @ axes.matrix.T, middle)
        return float(np.sum(change * x)) / max(float(np.sqrt(np.sum(change**2) * np.sum(x**2))), 1e-12)

    first, *others = signed_axes("the turn rates")
    axes = max(others, key=lambda x: fit(x) - SIMPLER * x.changes)
    given, best = fit(first), fit(axes)
    if best >= FIT and best - given >= BETTER:
        also = ", or two axes of both sensors swapped" if np.array_equal(axes.matrix, -np.eye(3)) else ""
        message = f"turn rates fit the turn of gravity in the acceleration only with {axes.words}{also} (correlation "
        message += f"{best:.2f}, {given:.2f} as they are); correct the axes of the gyro or of the accelerometer"
        yield CheckResult("error", "imu", message)


def _mounting(rows: ImuRows) -> Iterator[CheckResult]:
    """A warning where the mean specific force does not point along z, as a level IMU's does."""
    mean = rows.pushed[-1] / (rows.times[-1] - rows.times[0])
    size = np.linalg.norm(mean)
    if size >= 1.0 and mean[2] <= TILTED * size:
        how = "upside down" if -mean[2] > TILTED * size else "on its side"
        x, y, z = (f"{c + 0.0:.1f}" for c in np.round(mean, 1))
        message = f"mean acceleration is ({x}, {y}, {z}) m/s²: the IMU is {how}, expected z up; turn its axes"
        yield CheckResult("warning", "imu", message)


def _against_attitude(rows: ImuRows, truth: pl.DataFrame) -> list[CheckResult] | None:
    """The mistakes that the true attitude shows; None where it tells nothing of the clock."""
    if (attitude := true_attitude(truth)) is None:
        return None
    times, rates = attitude.rates()
    if len(times) < LEAST_WINDOWS or np.sqrt(np.mean(rates**2)) < LEAST_TURN:
        return None
    sizes = np.linalg.norm(rates, axis=1)
    delay = best_delay(lambda t: np.linalg.norm(_measured_rates(rows, t), axis=1), times, sizes)
    if delay.fit < SAME_TURN:
        return None
    wrong = _scale(np.linalg.norm(_measured_rates(rows, times + delay.late), axis=1), sizes)
    wrong = wrong or list(_axes(rows, attitude, delay.late))
    return [*delay.told("imu", "the truth's attitude", STEP_S, 2), *wrong]


def _against_heights(rows: ImuRows, truth: pl.DataFrame) -> list[CheckResult]:
    known = truth.select("t_s", "z_m").drop_nulls().unique("t_s", keep="first").sort("t_s").to_numpy()
    if len(known) < LEAST_WINDOWS:
        return []
    at = spaced(known[:, 0], REACH_S / 3)
    true = _bent(known[:, 0], known[:, 1:], at)
    at, true = at[np.isfinite(true)], true[np.isfinite(true)]
    if len(at) < LEAST_WINDOWS or np.std(true) < LEAST_LIFT:
        return []
    delay = best_delay(lambda t: _bent(rows.times, rows.lifted, t), at, true)
    # Smoothed heights are a tenth of a second off.
    return list(delay.told("imu", "the truth's heights", 0.2, 2)) if delay.fit >= SAME_LIFT else []


def _scale(measured: np.ndarray, true: np.ndarray) -> list[CheckResult]:
    """An error where sizes of turn rates are a multiple of the true ones, whichever of both has the noise."""
    known = np.isfinite(measured)
    factor = float(np.std(measured[known]) / np.std(true[known]))
    fit = float(np.corrcoef(measured[known], true[known])[0, 1])
    if (1.0 - SAME_SCALE) * fit <= factor <= (1.0 + SAME_SCALE) / max(fit, SAME_SCALE):
        return []
    near = (unit for unit, size in RATES_IN.items() if abs(factor - size) <= SAME_SCALE * size)
    meant = f"looks like {next(near, 'another full scale of the gyro')}, expected rad/s; convert the gyro's columns"
    message = f"turn rates are {significant(factor, 2)} times those of the truth's attitude: {meant}"
    return [CheckResult("error", "imu", message)]


def _measured_rates(rows: ImuRows, times: np.ndarray) -> np.ndarray:
    return between(rows.times, rows.turned, times - RATE_S, times + RATE_S) / (2 * RATE_S)


class Delay(NamedTuple):
    """Seconds by which a sensor comes `late`, their standard `error`, and the correlation `fit` with that delay."""

    late: float
    error: float
    fit: float

    def told(self, where: str, against: str, least: float, digits: int) -> Iterator[CheckResult]:
        """A warning of a delay from `least` s on that is certain; an error where it is long."""
        if abs(self.late) >= max(least, CERTAIN * self.error):
            level: Level = "error" if abs(self.late) > LATENCY_S else "warning"
            when = f"{abs(self.late):.{digits}f} s {'late' if self.late > 0 else 'early'}"
            message = f"comes {when} against {against}: their clocks differ; shift one table"
            yield CheckResult(level, where, message)


def best_delay(
    measured: Callable[[np.ndarray], np.ndarray], times: Float[np.ndarray, " n"], true: Float[np.ndarray, " n"]
) -> Delay:
    """The delay with which a measured series has the largest correlation with a true one."""
    part = slice(None, None, -(-len(times) // 2000))
    times, true = times[part], np.clip(true[part], *np.quantile(true[part], (0.02, 0.98)))
    delays = np.arange(-LONGEST_DELAY_S, LONGEST_DELAY_S + STEP_S / 2, STEP_S)
    block, sums = np.arange(len(times)) * BLOCKS // len(times), np.empty((BLOCKS, len(delays), 6))
    for k, delay in enumerate(delays):
        x = measured(times + delay)
        known = np.isfinite(x)
        x, y = np.where(known, x, 0.0), np.where(known, true, 0.0)
        sums[:, k] = np.stack([np.bincount(block, z, BLOCKS) for z in (known, x, y, x * x, x * y, y * y)], axis=1)

    def best(sums: np.ndarray) -> tuple[float, float]:
        n, x, y, xx, xy, yy = np.maximum(sums[:, :1], 1).T[0], *sums[:, 1:].T
        scale = np.sqrt(np.maximum((xx - x * x / n) * (yy - y * y / n), 0.0))
        enough = (n > max(0.4 * len(times), LEAST_WINDOWS)) & (scale > 0.0)
        fit = np.where(enough, (xy - x * y / n) / np.where(enough, scale, 1.0), -1.0)
        k = int(np.clip(np.argmax(fit), 1, len(fit) - 2))
        before, most, after = fit[k - 1 : k + 2]
        curved = max(2 * most - before - after, 1e-9)
        return float(delays[k] + STEP_S * np.clip((after - before) / curved / 2, -1.0, 1.0)), float(fit[k])

    total = sums.sum(axis=0)
    without = [best(total - one)[0] for one in sums]
    late, fit = best(total)
    return Delay(late, float(np.std(without)) * np.sqrt(BLOCKS), fit)


def _axes(rows: ImuRows, attitude: Attitude, late: float) -> Iterator[CheckResult]:
    """Other axes of the turn rates than the true ones, or quaternions read otherwise, with which both fit."""
    tried = dict[str, tuple[float, SignedAxes]]()
    for change, order, signs in reversed(READ_AS):
        other = attitude._replace(quaternions=attitude.quaternions[:, order] * signs)
        times, true = other.rates()
        measured = _measured_rates(rows, times + late)
        known = np.isfinite(measured).all(axis=1)
        measured, true = measured[known], true[known]
        tried[change] = _best_axes(measured, true, "the turn rates")
    best, (error, axes) = min(tried.items(), key=lambda one: one[1][0]), tried[READ_AS[0][0]]
    if error >= WORSE * best[1][0]:
        message = f"turn rates fit the truth's attitude only with {best[0]}; correct the columns qw, qx, qy, qz of the "
        yield CheckResult("error", "truth", f"{message}truth")
        return
    left, _, right = np.linalg.svd(measured.T @ true)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    angle = float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    turned = _error(measured, true @ turn.T)
    if _error(measured, true) < WORSE * min(error, turned):
        return
    if error < WORSE * turned:
        message = f"turn rates fit the truth's attitude only with {axes.words}; correct the axes of the gyro,"
        message += " and of the accelerometer where both share one chip"
        yield CheckResult("error" if np.linalg.det(axes.matrix) < 0 else "warning", "imu", message)
    elif angle > SMALL_TURN:
        message = f"axes are turned by {np.degrees(angle):.0f}° against the body axes of the truth's attitude"
        yield CheckResult("warning", "imu", message)


def _best_axes(measured: np.ndarray, true: np.ndarray, of: str) -> tuple[float, SignedAxes]:
    """The axes with which the true vectors are nearest to the measured ones, and the error, larger for each change."""
    fits = ((_error(measured, true @ x.matrix.T) * (1.0 + SIMPLER * x.changes), x) for x in signed_axes(of))
    return min(fits, key=lambda fit: fit[0])


def _error(measured: np.ndarray, true: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(measured - true, axis=1)))


def between(
    times: Float[np.ndarray, " N"], x: Float[np.ndarray, "N k"], start: Float[np.ndarray, " n"], end: np.ndarray
) -> Float[np.ndarray, "n k"]:
    """The changes of a series `x` from `start` to `end` (n,) s; NaN outside its times and across gaps."""
    changes = np.stack([np.interp(end, times, c) - np.interp(start, times, c) for c in x.T], axis=1)
    gaps = np.concatenate([[0], np.cumsum(np.diff(times) > GAP_S)])
    first, last = np.searchsorted(times, start, side="right") - 1, np.searchsorted(times, end)
    inside = (first >= 0) & (last < len(times))
    inside &= gaps[np.maximum(first, 0)] == gaps[np.minimum(last, len(gaps) - 1)]
    changes[~inside] = np.nan
    return changes


def _bent(
    times: Float[np.ndarray, " N"], x: Float[np.ndarray, "N 1"], at: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """The second derivative of a series, as its mean over `REACH_S` before and after `at` with triangular weights."""
    after, before = between(times, x, at, at + REACH_S), between(times, x, at - REACH_S, at)
    return np.asarray((after - before)[:, 0] / REACH_S**2)


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


def imu_rows(table: pl.DataFrame, tag: str) -> ImuRows | None:
    """The whole rows of a tag; None with fewer than ten."""
    columns = layout("imu", table.columns).values
    rows = table.filter(pl.col("tag") == tag).select("t_s", *columns).drop_nulls().unique("t_s", keep="first")
    rows = rows.sort("t_s").head(MOST_ROWS)
    if len(rows) < 10:
        return None
    t, x = rows["t_s"].to_numpy(), rows.select(columns).to_numpy()
    sums = integral(t, x)
    size = np.linalg.norm(x[:, :3], axis=1, keepdims=True)
    return ImuRows(t, sums[:, :3], sums[:, 3:], integral(t, integral(t, size - size.mean())))


def integral(t: Float[np.ndarray, " N"], x: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "N k"]:
    """The integral of a series over time, by trapezia, zero at first."""
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


def true_attitude(truth: pl.DataFrame) -> Attitude | None:
    """The attitude in the truth of one tag; None without quaternions."""
    if "qw" not in truth.columns:
        return None
    rows = truth.select("t_s", *QUATERNION).drop_nulls().unique("t_s", keep="first").sort("t_s").head(MOST_ROWS)
    q = rows.select(QUATERNION).to_numpy()
    return Attitude(rows["t_s"].to_numpy(), q / np.linalg.norm(q, axis=1, keepdims=True)) if len(rows) > 10 else None
