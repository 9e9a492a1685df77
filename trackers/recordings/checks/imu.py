"""Mistakes in an IMU: signs, axes, scale, mounting and clock.

Without truth: gravity, a constant vector of the world, turns in body axes by du/dt = -ω × u, whatever the heading, so
that the specific force tests the signs and axes of the turn rates. With the true attitude: turn rates and gravity in
body axes are known, and sizes of turn rates, which no axes change, tell scale and delay. With true heights alone,
sizes of the specific force tell the delay, since they follow the vertical acceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.core.wording import significant
from trackwright.trackers.recordings.checks import CheckResult, Level
from trackwright.trackers.recordings.checks.changes import SignedAxes, signed_axes
from trackwright.trackers.recordings.kinds import QUATERNION, layout

MOST_TAGS = 12
"""Tags whose IMU is checked."""

WINDOW_S = 1.0
"""Time over which gravity turns, s; specific force is averaged over half of it."""

LEAST_WINDOWS, LEAST_TURN = 20, 0.05
"""Windows, and their root mean square turn in rad, from which gravity tells of the axes."""

FIT, BETTER = 0.5, 0.4
"""Least correlation with other axes, and least gain of it, from which the given ones are wrong."""

SIMPLER = 0.02
"""Loss of correlation, or share of an error, for which simpler axes are preferred."""

TILTED = np.cos(np.radians(60.0))
"""Cosine of the angle between mean specific force and z beyond which an IMU lies on its side or upside down."""

LONGEST_DELAY_S, LEAST_DELAY_S, STEP_S = 3.0, 0.1, 0.02
FINE_DELAY_S, CERTAIN, BLOCK_S = 0.02, 5.0, 5.0
"""Least delay against a true attitude that is told, s, in standard errors too, which are of blocks of time, s."""

LATENCY_S = 1.0
"""Delays up to here are no mistake that stops a command."""

SAME_TURN, SAME_LIFT = 0.7, 0.85
"""Least correlations of sizes of turn rates and of vertical accelerations from which the delay of an IMU is known."""

BETTER_TURN, BETTER_LIFT = 0.05, 0.1
"""Least gains of these correlations from which an IMU comes late."""

REACH_S, LEAST_LIFT = 0.3, 0.1
"""Time before and after over which vertical accelerations are averaged, s, and their least standard deviation, m/s²."""

WORSE = 2.0
"""Ratio of errors from which other axes than the given ones are those of the IMU."""

READ_AS = (
    ("its quaternions as they are", (0, 1, 2, 3), np.ones(4)),
    ("its quaternions read as x, y, z, w", (3, 0, 1, 2), np.ones(4)),
    ("its quaternions read as z, w, x, y", (1, 2, 3, 0), np.ones(4)),
    ("its quaternions inverted", (0, 1, 2, 3), np.array([1.0, -1.0, -1.0, -1.0])),
)
"""How the quaternions of a truth may be meant, in words: the order and the signs of w, x, y, z."""

SAME_SCALE, RATES_IN = 0.2, {"rpm": 30 / np.pi, "degrees per second": 180 / np.pi}
"""Share by which sizes of turn rates may differ from the true ones, and what a rad/s is in other units."""

SMALL_TURN = np.radians(20.0)
"""Angle of a mounting, rad, up to which it is no mistake."""

MOST_ROWS = 30_000
"""Rows of an IMU that are looked at, the first ones."""

GAP_S = 0.25
"""Time between two rows, s, above which no window lies across them."""

RATE_S = 0.1
"""Half the time over which the rate of a true attitude is taken, s."""


def check_imu(tables: Mapping[str, pl.DataFrame]) -> list[CheckResult]:
    """Signs, axes, mounting and clock of the IMU of the first tags; an attitude of the sensor's own excuses it."""
    table, results = tables["imu"], list[CheckResult]()
    if set(QUATERNION) <= set(table.columns):
        return []
    for tag in table["tag"].unique(maintain_order=True).head(MOST_TAGS):
        rows, found = imu_rows(table, tag), None
        if rows is None:
            continue
        if "truth" in tables:
            truth = tables["truth"].filter(pl.col("tag") == tag)
            found = _against_attitude(rows, truth)
            found = _against_heights(rows, truth) if found is None else found
        found = found or [*_by_gravity(rows), *_mounting(rows)]
        results += [replace(result, message=f"tag {tag}: {result.message}") for result in found]
    return results


def _by_gravity(rows: ImuRows) -> Iterator[CheckResult]:
    """An error where gravity turns in body axes otherwise than the turn rates have it, and as others would."""
    t = spaced(rows.times, WINDOW_S / 4)
    half, quarter = WINDOW_S / 2, WINDOW_S / 4
    before, middle, after = (
        between(rows.times, rows.pushed, at - quarter, at + quarter) / half for at in (t - half, t, t + half)
    )
    turned = between(rows.times, rows.turned, t - half, t + half)
    change = after - before
    # Longer turns are no longer small, and knocks are no gravity.
    known = np.isfinite(change).all(axis=1) & np.isfinite(turned).all(axis=1)
    known &= (np.linalg.norm(turned, axis=1) < 2.0) & (np.linalg.norm(change, axis=1) < 5.0)
    change, middle, turned = change[known], middle[known], turned[known]
    if len(turned) < LEAST_WINDOWS or np.sqrt(np.mean(turned**2)) < LEAST_TURN:
        return
    given = _correlation(change, -np.cross(turned, middle))
    if given > 1.0 - BETTER:
        return
    tried = signed_axes("the turn rates")
    fits = [(_correlation(change, -np.cross(turned @ axes.matrix.T, middle)), axes) for axes in tried]
    best, axes = max(fits, key=lambda fit: fit[0] - SIMPLER * fit[1].changes)
    if best >= FIT and best - given >= BETTER:
        also = ", or two axes of both sensors swapped" if np.array_equal(axes.matrix, -np.eye(3)) else ""
        message = f"turn rates fit the turn of gravity in the acceleration only with {axes.words}{also} (correlation "
        message += f"{best:.2f}, {given:.2f} as they are); correct the axes of the gyro or of the accelerometer"
        yield CheckResult("error", "imu", message)


def _mounting(rows: ImuRows) -> Iterator[CheckResult]:
    """A warning where the mean specific force does not point along z, as that of a level IMU does."""
    mean = rows.pushed[-1] / (rows.times[-1] - rows.times[0])
    size = np.linalg.norm(mean)
    if size >= 1.0 and mean[2] <= TILTED * size:
        how = "upside down" if -mean[2] > TILTED * size else "on its side"
        x, y, z = (f"{c + 0.0:.1f}" for c in np.round(mean, 1))
        message = f"mean acceleration is ({x}, {y}, {z}) m/s²: the IMU is {how}, expected z up; turn its axes"
        yield CheckResult("warning", "imu", message)


def _against_attitude(rows: ImuRows, truth: pl.DataFrame) -> list[CheckResult] | None:
    """The mistakes that the true attitude shows; None where it tells nothing of the clock."""
    attitude = true_attitude(truth)
    if attitude is None:
        return None
    times, rates = attitude.rates()
    if len(times) < LEAST_WINDOWS or np.sqrt(np.mean(rates**2)) < LEAST_TURN:
        return None
    sizes = np.linalg.norm(rates, axis=1)
    delay, fit = best_delay(lambda t: np.linalg.norm(_measured_rates(rows, t), axis=1), times, sizes, BETTER_TURN)
    if fit < SAME_TURN:
        return None
    late = [_late(delay, "attitude")] if abs(delay) >= LEAST_DELAY_S else []
    wrong = _scale(np.linalg.norm(_measured_rates(rows, times + delay), axis=1), sizes)
    if late or wrong:
        return late + wrong
    later = 0.0
    for _ in range(5):
        step, error = _fine_delay(rows, times + later, sizes)
        later += step
        # A parabola beyond its points only leads nearer.
        if abs(step) <= LEAST_DELAY_S:
            break
    late = [_late(later, "attitude")] if abs(later) > max(FINE_DELAY_S, CERTAIN * error) else []
    wrong = _other_quaternions(rows, attitude)
    return late + (wrong or [x for one in _vectors(rows, attitude, times, rates) for x in _axes(*one)])


def _against_heights(rows: ImuRows, truth: pl.DataFrame) -> list[CheckResult]:
    known = truth.select("t_s", "z_m").drop_nulls().unique("t_s", keep="first").sort("t_s").to_numpy()
    if len(known) < LEAST_WINDOWS:
        return []
    at = spaced(known[:, 0], REACH_S / 3)
    true = bent(known[:, 0], known[:, 1:], at, REACH_S)[:, 0]
    at, true = at[np.isfinite(true)], true[np.isfinite(true)]
    if len(at) < LEAST_WINDOWS or np.std(true) < LEAST_LIFT:
        return []
    delay, fit = best_delay(lambda t: bent(rows.times, rows.lifted, t, REACH_S)[:, 0], at, true, BETTER_LIFT)
    # Smoothed heights are a tenth of a second off.
    return [_late(delay, "heights")] if fit >= SAME_LIFT and abs(delay) >= 2 * LEAST_DELAY_S else []


def _scale(measured: np.ndarray, true: np.ndarray) -> list[CheckResult]:
    """An error where sizes of turn rates are a multiple of the true ones, whichever of both has the noise."""
    known = np.isfinite(measured)
    factor = float(np.std(measured[known]) / np.std(true[known]))
    fit = _correlation(measured[known], true[known], centred=True)
    if (1.0 - SAME_SCALE) * fit <= factor <= (1.0 + SAME_SCALE) / max(fit, SAME_SCALE):
        return []
    near = (unit for unit, size in RATES_IN.items() if abs(factor - size) <= SAME_SCALE * size)
    meant = f"looks like {next(near, 'another full scale of the gyro')}, expected rad/s; convert the gyro's columns"
    message = f"turn rates are {significant(factor, 2)} times those of the truth's attitude: {meant}"
    return [CheckResult("error", "imu", message)]


def _late(delay: float, what: str) -> CheckResult:
    level: Level = "error" if abs(delay) > LATENCY_S else "warning"
    return CheckResult(level, "imu", late_in_words(delay, f"the truth's {what}", 2))


def late_in_words(delay: float, against: str, digits: int) -> str:
    """That an IMU comes so many seconds late, and what to do."""
    when = f"{abs(delay):.{digits}f} s {'late' if delay > 0 else 'early'}"
    return f"comes {when} against {against}: their clocks differ; shift one table"


def _measured_rates(rows: ImuRows, times: np.ndarray) -> np.ndarray:
    return between(rows.times, rows.turned, times - 0.1, times + 0.1) / 0.2


def best_delay(
    measured: Callable[[np.ndarray], np.ndarray], times: np.ndarray, true: np.ndarray, gain: float
) -> tuple[float, float]:
    """Seconds by which an IMU comes late, and the correlation of what it measures; 0 unless that gains so much."""
    part = slice(None, None, -(-len(times) // 2000))
    times, true = times[part], np.clip(true[part], *np.quantile(true, (0.02, 0.98)))

    def fit(delay: float) -> float:
        x = measured(times + delay)
        known = np.isfinite(x)
        enough = known.sum() > max(len(x) / 2, LEAST_WINDOWS)
        return _correlation(x[known], true[known], centred=True) if enough else -1.0

    at_once = fit(0.0)
    if at_once >= 1.0 - gain:
        return 0.0, at_once
    fits = {round(float(d), 3): fit(d) for d in np.arange(-LONGEST_DELAY_S, LONGEST_DELAY_S + STEP_S / 2, STEP_S)}
    best = max(fits, key=lambda delay: fits[delay])
    return best if fits[best] - at_once > gain else 0.0, fits[best]


def _fine_delay(rows: ImuRows, times: np.ndarray, sizes: np.ndarray) -> tuple[float, float]:
    """Seconds by which an IMU comes late against turn rates of these sizes, and their error, by leaving out blocks."""
    delays = np.arange(-LEAST_DELAY_S, LEAST_DELAY_S + STEP_S, STEP_S / 2)
    part = slice(None, None, -(-len(times) // 2000))
    times, sizes = times[part], sizes[part]
    squares = [(np.linalg.norm(_measured_rates(rows, times + d), axis=1) - sizes) ** 2 for d in delays]
    known, block = np.isfinite(squares).all(axis=0), np.unique(np.floor(times / BLOCK_S), return_inverse=True)[1]
    sums = np.stack([np.bincount(block[known], one[known], minlength=1) for one in squares])

    def least(total: np.ndarray) -> float:
        best = int(np.clip(np.argmin(total), 1, len(total) - 2))
        return float(delays[best] + STEP_S / 2 * lowest(*total[best - 1 : best + 2]))

    without = [least(sums.sum(axis=1) - one) for one in sums.T]
    return least(sums.sum(axis=1)), float(np.std(without) * np.sqrt(len(without)))


def lowest(before: np.ndarray, least: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Where a parabola through values at -1, 0 and 1 is lowest."""
    return 0.5 * (before - after) / np.maximum(before - 2 * least + after, 1e-9)


def _vectors(
    rows: ImuRows, attitude: Attitude, times: np.ndarray, rates: np.ndarray
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """What the IMU measures and what truth implies of it (n, 3), by name."""
    measured = _measured_rates(rows, times)
    known = np.isfinite(measured).all(axis=1)
    yield "turn rates", measured[known], rates[known]
    at = spaced(times, 0.5)
    force = between(rows.times, rows.pushed, at - 0.5, at + 0.5)
    known = np.isfinite(force).all(axis=1)
    if known.sum() >= LEAST_WINDOWS:
        yield "accelerations", force[known], 9.81 * attitude.up(at)[known]


def _axes(name: str, measured: np.ndarray, true: np.ndarray) -> Iterator[CheckResult]:
    """Other axes of the measured vectors than the true ones; an error where they make a mirrored frame."""
    given = _error(measured, true)
    error, axes = _best_axes(measured, true, f"the {name}")
    left, _, right = np.linalg.svd(measured.T @ true)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    angle = float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    turned = _error(measured, true @ turn.T)
    if given < WORSE * min(error, turned):
        return
    if error < WORSE * turned:
        message = f"{name} fit the truth's attitude only with {axes.words}; correct the axes"
        yield CheckResult("error" if np.linalg.det(axes.matrix) < 0 else "warning", "imu", message)
    elif angle > SMALL_TURN and name == "turn rates":
        message = f"axes are turned by {np.degrees(angle):.0f}° against the body axes of the truth's attitude"
        yield CheckResult("warning", "imu", message)


def _other_quaternions(rows: ImuRows, attitude: Attitude) -> list[CheckResult]:
    """An error where turn rates fit the attitude once its quaternions are read otherwise, and with no other axes."""
    errors = {}
    for change, order, signs in READ_AS:
        other = attitude._replace(quaternions=attitude.quaternions[:, order] * signs)
        times, rates = other.rates()
        measured = _measured_rates(rows, times)
        known = np.isfinite(measured).all(axis=1)
        errors[change] = _best_axes(measured[known], rates[known], "")[0]
    best = min(errors, key=lambda change: errors[change])
    if best == READ_AS[0][0] or errors[READ_AS[0][0]] < WORSE * errors[best]:
        return []
    message = f"turn rates fit the truth's attitude only with {best}; correct the columns qw, qx, qy, qz of the truth"
    return [CheckResult("error", "truth", message)]


def _best_axes(measured: np.ndarray, true: np.ndarray, of: str) -> tuple[float, SignedAxes]:
    """The axes with which the true vectors are nearest to the measured ones, and the error, larger for each change."""
    axes = list(signed_axes(of))
    errors = [_error(measured, true @ candidate.matrix.T) * (1.0 + SIMPLER * candidate.changes) for candidate in axes]
    best = int(np.argmin(errors))
    return errors[best], axes[best]


def _error(measured: np.ndarray, true: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(measured - true, axis=1)))


def _correlation(x: np.ndarray, y: np.ndarray, centred: bool = False) -> float:
    """The correlation of all numbers, about zero unless `centred`; 0 where one of both is constant."""
    if centred:
        x, y = x - x.mean(), y - y.mean()
    scale = float(np.sqrt(np.sum(x**2) * np.sum(y**2)))
    return float(np.sum(x * y)) / scale if scale > 0 else 0.0


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

    def up(self, times: np.ndarray) -> Float[np.ndarray, "n 3"]:
        """The world's z in body axes (n, 3), of the rows before `times`."""
        row = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 1)
        return np.asarray(rotation_matrices(self.quaternions[row])[:, 2, :])


def true_attitude(truth: pl.DataFrame) -> Attitude | None:
    """The attitude in the truth of one tag; None without quaternions."""
    if "qw" not in truth.columns:
        return None
    rows = truth.select("t_s", *QUATERNION).drop_nulls().unique("t_s", keep="first").sort("t_s").head(MOST_ROWS)
    q = rows.select(QUATERNION).to_numpy()
    return Attitude(rows["t_s"].to_numpy(), q / np.linalg.norm(q, axis=1, keepdims=True)) if len(rows) > 10 else None
