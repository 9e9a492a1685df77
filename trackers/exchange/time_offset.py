"""The time offset between two trajectories, estimated from their speeds and then from their positions."""

from __future__ import annotations

import math

import numpy as np

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange.alignment import Alignment, alignment
from trackwright.trackers.exchange.poses import PoseTrajectory

_GRID_S = 0.05
_WINDOW_S = 0.5
_SEARCHED_S = 0.5
_LEAST_CORRELATION = 0.5
_LEAST_OVERLAP = 0.5
_MOST_STEPS = 200_000
_FITTED = 5000
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


def estimate_offset(estimate: PoseTrajectory, truth: PoseTrajectory, align: Alignment = "none") -> float:
    """The time, s, to add to the times of an estimate so that it fits the truth best.

    First the lag at which the horizontal speeds over 0.5 s are most correlated, over all lags at which at least half of
    the shorter trajectory overlaps; then, within 0.5 s of it, the offset of the least root mean square distance
    between the aligned estimate and the interpolated truth. Raises UnusableInput where no correlation reaches 0.5, as
    without changes of speed.
    """
    coarse = _by_speed(estimate, truth)
    estimate = estimate.at_rows(np.unique(np.linspace(0, len(estimate) - 1, _FITTED).astype(int)))
    low, high = coarse - _SEARCHED_S, coarse + _SEARCHED_S
    # The distance has one minimum near the right offset, but small ripples where poses enter and leave the overlap.
    grid = np.linspace(low, high, 41)
    values = [_distance(estimate, truth, offset, align) for offset in grid]
    k = int(np.argmin(values))
    return _golden(estimate, truth, align, grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)])


def _by_speed(estimate: PoseTrajectory, truth: PoseTrajectory) -> float:
    spans = [t.times[-1] - t.times[0] for t in (estimate, truth)]
    if min(spans) < 4 * _WINDOW_S:
        raise UnusableInput(
            f"{estimate.name}: {min(spans):.3g} s are too short to estimate a time offset; expected at least "
            f"{4 * _WINDOW_S:g} s of both; give --time-offset in seconds"
        )
    if max(spans) / _GRID_S > _MOST_STEPS:
        raise UnusableInput(f"{estimate.name}: {max(spans):.0f} s are too long to estimate a time offset; give it")
    starts, speeds = zip(*(_speeds(t) for t in (estimate, truth)), strict=True)
    lags, correlations = _correlations(*speeds)
    if not len(lags) or not correlations.max() >= _LEAST_CORRELATION:
        found = f"{correlations.max():.2f}" if len(lags) else "undefined"
        raise UnusableInput(
            f"{estimate.name}: no time offset fits: the best correlation of its speed with the true speed is {found}, "
            f"expected at least {_LEAST_CORRELATION}; motion with changes of speed is needed; give --time-offset"
        )
    return float(starts[1] - starts[0] + lags[int(correlations.argmax())] * _GRID_S)


def _speeds(poses: PoseTrajectory) -> tuple[float, np.ndarray]:
    """Begin, s, and horizontal speeds (k,), m/s, every `_GRID_S`, over windows of `_WINDOW_S`."""
    times, rows = np.unique(poses.times, return_index=True)
    grid = np.arange(times[0], times[-1], _GRID_S)
    places = np.stack([np.interp(grid, times, poses.positions[rows, k]) for k in (0, 1)], axis=1)
    window = round(_WINDOW_S / _GRID_S)
    return float(grid[0]), np.linalg.norm(places[window:] - places[:-window], axis=1) / _WINDOW_S


def _correlations(own: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lags, in steps, at which enough overlaps, and the correlation of own[k] with true[k + lag] at each."""
    size = 1 << (len(own) + len(true) - 1).bit_length()

    def sums(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        # Element `lag` is the sum over k of a[k] b[k + lag]; negative lags stand at the end.
        return np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)

    # Without their means the sums below lose fewer digits.
    own, true = own - own.mean(), true - true.mean()
    ones = np.ones(len(own)), np.ones(len(true))
    count = np.round(sums(*ones))
    lags = np.concatenate([np.arange(size // 2), np.arange(-(size // 2), 0)])
    enough = count >= max(_LEAST_OVERLAP * min(len(own), len(true)), 2)
    n = np.where(enough, count, 1.0)
    mean_own, mean_true = sums(own, ones[1]) / n, sums(ones[0], true) / n
    covariance = sums(own, true) / n - mean_own * mean_true
    variance_own = sums(own**2, ones[1]) / n - mean_own**2
    variance_true = sums(ones[0], true**2) / n - mean_true**2
    product = variance_own * variance_true
    kept = enough & (variance_own > 1e-9) & (variance_true > 1e-9)
    return lags[kept], covariance[kept] / np.sqrt(product[kept])


def _distance(estimate: PoseTrajectory, truth: PoseTrajectory, offset: float, align: Alignment) -> float:
    """The root mean square distance, m, of the estimate at this offset, aligned; infinite with little overlap."""
    times = estimate.times + offset
    rows = np.flatnonzero((times >= truth.times[0]) & (times <= truth.times[-1]))
    if len(rows) < max(3, 0.25 * min(len(estimate), len(truth))):
        return math.inf
    known, first = np.unique(truth.times, return_index=True)
    places = np.stack([np.interp(times[rows], known, truth.positions[first, k]) for k in range(3)], axis=1)
    own, true = estimate.at_rows(rows), PoseTrajectory(times[rows], places, None, truth.name)
    # The first pose alone would follow the noise of one row.
    moved = alignment("none" if align == "origin" else align, own, true).points(own.positions)
    return float(np.sqrt(np.mean(np.nansum((moved - places) ** 2, axis=1))))


def _golden(estimate: PoseTrajectory, truth: PoseTrajectory, align: Alignment, low: float, high: float) -> float:
    """The offset of the least distance between `low` and `high`, to 0.1 ms, by golden sections."""
    a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_a, at_b = (_distance(estimate, truth, x, align) for x in (a, b))
    while high - low > 1e-4:
        if at_a <= at_b:
            high, b, at_b = b, a, at_a
            a = high - _GOLDEN * (high - low)
            at_a = _distance(estimate, truth, a, align)
        else:
            low, a, at_a = a, b, at_b
            b = low + _GOLDEN * (high - low)
            at_b = _distance(estimate, truth, b, align)
    return (low + high) / 2
