"""Oracles: likelihoods and gradients by other methods than the library's, in double precision with NumPy alone.

Densities by quadrature; gradients are central differences of these likelihoods.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from tests.oracles.particle_worlds import (
    CORRIDOR,
    HALT_ARCLENGTH,
    HALT_DT,
    HALT_SIGMA_A,
    HALT_SIGMA_FIX,
    HALT_SPEED,
    HALT_SPREAD,
    SIGMA_FIX,
    SIGMA_MOVE,
    START,
    halt_fixes,
)

CORRIDOR_POINTS = (64, 24)  # quadrature points along and across the corridor

HALT_POINTS, HALT_DOMAIN = (192, 64), (12.0, 3.0)
"""Quadrature points and domain, m and m/s, along the line and over speeds; the tag stays far within the domain."""

STEP = 1e-4
"""Step of the central differences by log parameters; their truncation error is about 1e-8 of the derivative."""


class Axis(NamedTuple):
    """Quadrature along one axis of the corridor: points (n,), m, their weights (n,), first density (n,), move (n, n).

    `first`: predicted density before the first fix. `move`: transition density times the weights.
    """

    points: np.ndarray
    weights: np.ndarray
    first: np.ndarray
    move: np.ndarray


def corridor_log_likelihood(
    fixes: np.ndarray, sigma: float = SIGMA_MOVE, sigma_fix: float = SIGMA_FIX,
    points: tuple[int, int] = CORRIDOR_POINTS,
) -> float:  # fmt: skip
    """log L of fixes (T, 2), m, of a random walk with moves of `sigma` m per axis that dies outside the corridor.

    The density obeys p'(x') = g(x') ∫ N(x'; x, σ²) p(x) dx over the rectangle. Every integrand is smooth inside, and
    the first integral, over a uniform density, is a difference of error functions; Gauss-Legendre quadrature therefore
    converges exponentially with the number of points.
    """
    along, across = (_axis(k, sigma, points[k]) for k in (0, 1))
    density, value = np.empty(0), 0.0
    for row, (x, y) in enumerate(fixes):
        predicted = along.move @ density @ across.move.T if row else np.outer(along.first, across.first)
        weighted = predicted * np.outer(_normal(along.points - x, sigma_fix), _normal(across.points - y, sigma_fix))
        likelihood = along.weights @ weighted @ across.weights
        density, value = weighted / likelihood, value + math.log(likelihood)
    return value


def corridor_gradient(fixes: np.ndarray, points: tuple[int, int] = CORRIDOR_POINTS) -> tuple[float, ...]:
    """d log L / d log σ of the moves and of the fixes."""
    return _gradient(
        lambda sigma, sigma_fix: corridor_log_likelihood(fixes, sigma, sigma_fix, points), (SIGMA_MOVE, SIGMA_FIX)
    )


def halt_log_likelihood(
    sigma_a: float = HALT_SIGMA_A, sigma_p: float = HALT_SIGMA_FIX, spread: float = HALT_SPREAD,
    points: tuple[int, int] = HALT_POINTS,
) -> float:  # fmt: skip
    """log L of the halt's fixes; standard deviations of speed, m/s per √s, of a fix, m, and of the prior.

    With the speed clamped at zero the density has two parts: p(d, v) while moving and p₀(d) at rest, singular in
    speed. Integrals over speed are Gauss-Legendre sums. Travel is a shift by v·dt, exact in the Fourier coefficients
    of a density that is smooth in d. The likelihood converges exponentially with the number of points.
    """
    length, fastest = HALT_DOMAIN
    positions = np.arange(points[0]) * length / points[0]
    frequencies = 2 * np.pi * np.fft.rfftfreq(points[0], length / points[0])
    nodes, weights = np.polynomial.legendre.leggauss(points[1])
    speeds, weights = (nodes + 1) / 2 * fastest, weights / 2 * fastest
    sigma = sigma_a * math.sqrt(HALT_DT)
    change, start = _normal(speeds[:, None] - speeds, sigma) * weights, _normal(speeds, sigma)
    stop = np.array([0.5 * math.erfc(v / sigma / math.sqrt(2)) for v in speeds]) * weights
    travel = np.exp(-1j * frequencies[:, None] * speeds * HALT_DT)
    moving = np.outer(_normal(positions - HALT_ARCLENGTH, spread), _normal(speeds - HALT_SPEED, spread))
    resting = 0.0 * positions
    value = 0.0
    for x, y in halt_fixes():
        moving = np.fft.irfft(np.fft.rfft(moving, axis=0) * travel, n=len(positions), axis=0)
        moving, resting = moving @ change.T + np.outer(resting, start), moving @ stop + 0.5 * resting
        density = _normal(positions - x, sigma_p) * _normal(y, sigma_p)
        moving, resting = moving * density[:, None], resting * density
        likelihood = np.sum(moving @ weights + resting) * length / len(positions)
        moving, resting, value = moving / likelihood, resting / likelihood, value + math.log(likelihood)
    return value


def halt_gradient(points: tuple[int, int] = HALT_POINTS) -> tuple[float, ...]:
    """d log L / d log σ of the speed, the fixes and the prior."""
    return _gradient(
        lambda sigma_a, sigma_p, spread: halt_log_likelihood(sigma_a, sigma_p, spread, points),
        (HALT_SIGMA_A, HALT_SIGMA_FIX, HALT_SPREAD),
    )


def _gradient(log_likelihood: Callable[..., float], at: Sequence[float]) -> tuple[float, ...]:
    """Central differences by the logarithm of each argument."""

    def end(k: int, sign: int) -> float:
        return log_likelihood(*(x * math.exp(sign * STEP * (j == k)) for j, x in enumerate(at)))

    return tuple((end(k, 1) - end(k, -1)) / (2 * STEP) for k in range(len(at)))


def _axis(k: int, sigma: float, count: int) -> Axis:
    (low, high), (start, stop) = CORRIDOR[:, k], START[:, k]
    nodes, weights = np.polynomial.legendre.leggauss(count)
    points, weights = low + (high - low) * (nodes + 1) / 2, weights * (high - low) / 2
    first = (_cdf((points - start) / sigma) - _cdf((points - stop) / sigma)) / (stop - start)
    return Axis(points, weights, first, _normal(points[:, None] - points[None, :], sigma) * weights[None, :])


def _normal(x: np.ndarray | float, sigma: float) -> np.ndarray:
    return np.exp(-0.5 * (np.asarray(x) / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))


def _cdf(x: np.ndarray) -> np.ndarray:
    return np.array([0.5 * math.erfc(-v / math.sqrt(2)) for v in x])
