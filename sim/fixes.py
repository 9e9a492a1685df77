"""What goes wrong with position fixes, one piece each, beside those of `sim.corruptions`: values are (n, T, 3), m.

Pieces that depend on where the tag was (`late`, `first_order_lag`, `mirrored`) belong before those that add noise.
"""

from __future__ import annotations

import numpy as np

from sim.corruptions import Corruption
from sim.keys import Keys, normals, stream, uniforms


def correlated_noise(covariance: np.ndarray) -> Corruption:
    """Independent rows of Gaussian noise whose axes hang together: `covariance` (3, 3), m².

    Raises ValueError for a matrix that isn't symmetric positive definite.
    """
    matrix = np.asarray(covariance, float)
    if matrix.shape != (3, 3) or not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix)[0] <= 0:
        raise ValueError(f"the covariance of fixes is 3 × 3, symmetric and positive definite, found {matrix.tolist()}")
    factor = np.linalg.cholesky(matrix)

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return values + normals(keys, values.shape[1:]).astype(values.dtype) @ factor.T, seen

    return corrupt


def delayed(seconds: float) -> Corruption:
    """Fixes of where the tag was `seconds` before; before the recording it stood still."""
    _not_negative("the latency of fixes", seconds)

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        then = times - seconds
        return np.stack([np.stack([np.interp(then, times, a) for a in one.T], axis=1) for one in values]), seen

    return corrupt


def first_order_lag(tau: float) -> Corruption:
    """Fixes smoothed by the device: a first-order lag of `tau` s, exact for straight motion between rows.

    A tag at constant speed shows where it was `tau` s before. Four DWM1001 anchors show such a lag, not a plain delay.
    """
    _not_negative("the time constant of a lag", tau)

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    """Heights that flip to their mirror image in the anchors' plane at height `plane`, m, for seconds at a time.

    A two-state Markov process in continuous time, stationary from the first row: mirrored for a `share` of the time,
    `mean_length_s` s at a stretch on average. Raises ValueError unless 0 ≤ share < 1 and the length is positive.
    """
    if not (0 <= share < 1 and mean_length_s > 0):
        raise ValueError(f"a share lies in 0..1 and a length is positive, found {share} and {mean_length_s} s")

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
        raise ValueError(f"{what} is not negative, found {seconds} s")
