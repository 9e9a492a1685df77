"""Corruptions of position fixes (n, T, 3), m, beside those of `sim.corruptions`.

Those that act on the true path (`delayed`, `first_order_lag`, `mirrored_heights`) belong before those that add noise.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from trackwright.sim.corruptions import Corruption, Seen, Times, Values
from trackwright.sim.keys import Keys, normals, stream, uniforms


def correlated_noise(covariance: Float[np.ndarray, "i j"]) -> Corruption:
    """White Gaussian noise with correlated axes: `covariance` (3, 3), m².

    Raises ValueError for a matrix that isn't symmetric positive definite.
    """
    matrix = np.asarray(covariance, float)
    if matrix.shape != (3, 3) or not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix)[0] <= 0:
        raise ValueError(f"covariance of fixes {matrix.tolist()}: expected 3 × 3, symmetric and positive definite")
    factor = np.linalg.cholesky(matrix)

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        return values + normals(keys, values.shape[1:]).astype(values.dtype) @ factor.T, seen

    return corrupt


def delayed(seconds: float) -> Corruption:
    """A pure delay of the fixes by `seconds`; before its first time the tag is taken to be at rest."""
    _not_negative("the latency of fixes", seconds)

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        then = times - seconds
        return np.stack([np.stack([np.interp(then, times, a) for a in one.T], axis=1) for one in values]), seen

    return corrupt


def first_order_lag(tau: float) -> Corruption:
    """Smoothing by the device: a first-order lag with time constant `tau`, s, exact for straight motion between rows.

    At constant speed it equals a delay by `tau`. Four DWM1001 anchors have such a lag, not a pure delay.
    """
    _not_negative("the time constant of a lag", tau)

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        if tau == 0:
            return values, seen
        shown = values.copy()
        steps = np.diff(times) / tau
        kept = np.exp(-steps)
        ramp = np.where(steps > 0, -np.expm1(-steps) / np.where(steps > 0, steps, 1.0), 1.0)
        for k in range(len(steps)):
            before, after = values[:, k], values[:, k + 1]
            shown[:, k + 1] = kept[k] * shown[:, k] + (ramp[k] - kept[k]) * before + (1 - ramp[k]) * after
        return shown, seen

    return corrupt


def mirrored_heights(plane: float, share: float, mean_length_s: float) -> Corruption:
    """Heights mirrored at the anchors' plane at height `plane`, m, for a `share` of the time.

    A two-state Markov process in continuous time, stationary from the first row; `mean_length_s` s at a stretch on
    average. Raises ValueError unless 0 ≤ share < 1 and the length is positive.
    """
    if not (0 <= share < 1 and mean_length_s > 0):
        raise ValueError(f"share = {share}, mean length {mean_length_s} s: expected 0 to below 1 and a positive length")

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        draws = uniforms(stream(keys, "mirror"), values.shape[1:2])
        flipped = draws < share
        kept = np.exp(-np.diff(times) / (mean_length_s * (1 - share)))
        for k in range(len(kept)):
            flipped[:, k + 1] = draws[:, k + 1] < share * (1 - kept[k]) + kept[k] * flipped[:, k]
        out = values.copy()
        out[..., 2] = np.where(flipped, 2 * plane - values[..., 2], values[..., 2])
        return out, seen

    return corrupt


def _not_negative(what: str, seconds: float) -> None:
    if not (seconds >= 0 and np.isfinite(seconds)):
        raise ValueError(f"{what} is {seconds} s: expected 0 or more, finite")
