"""The oracle of the Kalman filter: all fixes of a tag at once, as one normal vector; double precision, NumPy alone.

No recursion, no Jacobian: of straight motion with white acceleration noise the covariance between any two rows is
written down, the fixes' noise is added, and the density of the whole vector is that of its Cholesky factor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

STEP = 1e-5
"""Of the central differences by a number's logarithm (by seconds for a latency)."""


def fixes(seed: int = 5, rows: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (T,) s, fixes (T, 2) m and which were seen (T, 2), at irregular times and with gaps."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.05, 0.4, rows))
    walk = np.cumsum(np.cumsum(0.15 * rng.standard_normal((rows, 2)), axis=0) * 0.2, axis=0)
    seen = rng.random((rows, 2)) > 0.15
    seen[0] = True
    return times, walk + 0.3 * rng.standard_normal((rows, 2)), seen


def log_likelihood(numbers: Mapping[str, float]) -> float:
    """log L of all fixes but the first, from which the track begins.

    `numbers`: `sigma_a` m/s² per √Hz, `sigma_fix` m, `sigma_position` m, `sigma_velocity` m/s, `latency` s.
    """
    times, values, seen = fixes()
    value = 0.0
    for axis in (0, 1):
        rows = np.flatnonzero(seen[:, axis] & (np.arange(len(times)) > 0))
        t = times[rows] - times[0]
        cov = _seen(t, numbers)
        apart = values[rows, axis] - values[0, axis]
        factor = np.linalg.cholesky(cov)
        whitened = np.linalg.solve(factor, apart)
        value -= np.sum(np.log(np.diag(factor))) + 0.5 * whitened @ whitened + 0.5 * len(t) * math.log(2 * math.pi)
    return float(value)


def slopes(numbers: Mapping[str, float]) -> dict[str, float]:
    """d log L by the logarithm of each number, of the latency by itself."""
    found = {}
    for name, at in numbers.items():
        ends = [at + s * STEP if name == "latency" else at * math.exp(s * STEP) for s in (1, -1)]
        high, low = (log_likelihood({**numbers, name: x}) for x in ends)
        found[name] = (high - low) / (2 * STEP)
    return found


def _seen(t: np.ndarray, numbers: Mapping[str, float]) -> np.ndarray:
    """The covariance (n, n) of fixes at times `t` since the start: cov(p − v·latency) and their noise."""
    early, late = np.minimum(t[:, None], t[None, :]), np.maximum(t[:, None], t[None, :])
    density = numbers["sigma_a"] ** 2
    # From a standing start: place with place, velocity (row) with place (column), velocity with velocity.
    places = density * early**2 * (3 * late - early) / 6
    mixed = density * (t[None, :] * early - early**2 / 2)
    speeds = density * early
    velocity = numbers["sigma_velocity"] ** 2
    places = places + numbers["sigma_position"] ** 2 + velocity * t[:, None] * t[None, :]
    mixed = mixed + velocity * t[None, :]
    speeds = speeds + velocity
    latency = numbers["latency"]
    cov = places - latency * (mixed + mixed.T) + latency**2 * speeds
    return cov + numbers["sigma_fix"] ** 2 * np.eye(len(t))
