"""The oracle of particles at rest: the likelihood of a halt on a straight line by quadrature, NumPy alone.

Where the speed is cut off at zero a density has two parts, p(d, v) on the move and p₀(d) at rest, without width in
speed. Integrals over speed are Gauss-Legendre sums; travel is a shift by v·dt along the line, exact in the Fourier
coefficients of a density that is smooth in d: so the likelihood converges exponentially with the number of points.
"""

from __future__ import annotations

import math

import numpy as np

from experiments.verify.halt import DT, PLACE, SIGMA_A, SIGMA_FIX, SPEED, SPREAD, halt_fixes

LENGTH, FASTEST = 12.0, 3.0
"""The domain, m and m/s: far beyond what the tag does."""

POINTS = (192, 64)
"""Along the line and over speeds."""

STEP = 1e-4
"""Of the central differences by log σ, whose own error is some 1e-8 of the derivative."""


def log_likelihood(
    sigma_a: float = SIGMA_A, sigma_p: float = SIGMA_FIX, spread: float = SPREAD, points: tuple[int, int] = POINTS
) -> float:
    """log L of the halt's fixes under these standard deviations: of speed m/s per √s, of a fix and the start m."""
    places = np.arange(points[0]) * LENGTH / points[0]
    frequencies = 2 * np.pi * np.fft.rfftfreq(points[0], LENGTH / points[0])
    nodes, weights = np.polynomial.legendre.leggauss(points[1])
    speeds, weights = (nodes + 1) / 2 * FASTEST, weights / 2 * FASTEST
    sigma = sigma_a * math.sqrt(DT)
    change, start = _normal(speeds[:, None] - speeds, sigma) * weights, _normal(speeds, sigma)
    stop = np.array([0.5 * math.erfc(v / sigma / math.sqrt(2)) for v in speeds]) * weights
    travel = np.exp(-1j * frequencies[:, None] * speeds * DT)
    moving, resting = np.outer(_normal(places - PLACE, spread), _normal(speeds - SPEED, spread)), 0.0 * places
    value = 0.0
    for x, y in halt_fixes():
        moving = np.fft.irfft(np.fft.rfft(moving, axis=0) * travel, n=len(places), axis=0)
        moving, resting = moving @ change.T + np.outer(resting, start), moving @ stop + 0.5 * resting
        reading = _normal(places - x, sigma_p) * _normal(y, sigma_p)
        moving, resting = moving * reading[:, None], resting * reading
        likelihood = np.sum(moving @ weights + resting) * LENGTH / len(places)
        moving, resting, value = moving / likelihood, resting / likelihood, value + math.log(likelihood)
    return value


def slopes(points: tuple[int, int] = POINTS) -> tuple[float, float, float]:
    """d log L / d log σ of the speed, the fixes and the start, by central differences."""
    at = (SIGMA_A, SIGMA_FIX, SPREAD)

    def slope(k: int) -> float:
        ends = []
        for sign in (1, -1):
            sigma_a, sigma_p, spread = (s * math.exp(sign * STEP * (j == k)) for j, s in enumerate(at))
            ends.append(log_likelihood(sigma_a, sigma_p, spread, points))
        return (ends[0] - ends[1]) / (2 * STEP)

    return slope(0), slope(1), slope(2)


def _normal(x: np.ndarray | float, sigma: float) -> np.ndarray:
    return np.exp(-0.5 * (np.asarray(x) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
