"""Oracles: likelihoods and gradients by other methods than the library's, in double precision with NumPy alone.

Corridor and halt: quadrature. Kalman filter: the joint normal density of all fixes. Hidden Markov chain: enumeration
of all state sequences. All gradients are central differences of these likelihoods.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise, product
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

CORRIDOR_POINTS = (64, 24)
"""Quadrature points along and across the corridor."""

HALT_POINTS, HALT_DOMAIN = (192, 64), (12.0, 3.0)
"""Quadrature points and domain, m and m/s, along the line and over speeds; the tag stays far within the domain."""

QUADRATURE_STEP, EXACT_STEP = 1e-4, 1e-5
"""Steps of the central differences by log parameters; their truncation error is about 1e-8 of the derivative."""

LATENCY = "sensors.fixes.latency"

CHAIN_PROBABILITIES = np.array([0.45, 0.35, 0.2])
"""Probability of each state of the chain when its state is drawn."""

CHAIN_LEVELS = np.array([-1.0, 0.2, 1.5])
"""Mean measurement in each state."""

CHAIN_INTERVALS = np.array([0.3, 0.6, 0.2, 0.9, 0.4, 0.5])
"""Seconds before each row but the first."""

CHAIN_RATE, CHAIN_SIGMA = 0.8, 0.7
"""State draws per second, and the standard deviation of a measurement."""


class Axis(NamedTuple):
    """Quadrature along one axis of the corridor: points (n,), m, their weights (n,), first density (n,), move (n, n).

    `first`: predicted density before the first fix. `move`: transition density times the weights.
    """

    points: np.ndarray
    weights: np.ndarray
    first: np.ndarray
    move: np.ndarray


def corridor_log_likelihood(
    fixes: np.ndarray,
    sigma: float = SIGMA_MOVE,
    sigma_fix: float = SIGMA_FIX,
    points: tuple[int, int] = CORRIDOR_POINTS,
) -> float:
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
        lambda sigma, sigma_fix: corridor_log_likelihood(fixes, sigma, sigma_fix, points),
        (SIGMA_MOVE, SIGMA_FIX),
        QUADRATURE_STEP,
    )


def halt_log_likelihood(
    sigma_a: float = HALT_SIGMA_A,
    sigma_p: float = HALT_SIGMA_FIX,
    spread: float = HALT_SPREAD,
    points: tuple[int, int] = HALT_POINTS,
) -> float:
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
        QUADRATURE_STEP,
    )


def kalman_fixes(seed: int = 5, rows: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (T,), s, fixes (T, 2), m, and their mask (T, 2), with irregular intervals and gaps."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.05, 0.4, rows))
    walk = np.cumsum(np.cumsum(0.15 * rng.standard_normal((rows, 2)), axis=0) * 0.2, axis=0)
    seen = rng.random((rows, 2)) > 0.15
    seen[0] = True
    return times, walk + 0.3 * rng.standard_normal((rows, 2)), seen


def kalman_log_likelihood(parameters: Mapping[str, float]) -> float:
    """log L of all fixes after the first, which starts the track, as the density of one normal vector.

    Motion with white acceleration noise has a closed-form covariance between any two rows; there is no recursion and
    no Jacobian. `parameters`: by the names of the tracker's tunables.
    """
    times, values, seen = kalman_fixes()
    value = 0.0
    for axis in (0, 1):
        rows = np.flatnonzero(seen[:, axis] & (np.arange(len(times)) > 0))
        t = times[rows] - times[0]
        factor = np.linalg.cholesky(_fix_covariance(t, parameters))
        whitened = np.linalg.solve(factor, values[rows, axis] - values[0, axis])
        value -= np.sum(np.log(np.diag(factor))) + 0.5 * whitened @ whitened + 0.5 * len(t) * math.log(2 * math.pi)
    return float(value)


def kalman_gradient(parameters: Mapping[str, float]) -> list[float]:
    """d log L by the logarithm of each parameter; by the latency itself."""
    gradient = []
    for name, at in parameters.items():
        ends = [at + s * EXACT_STEP if name == LATENCY else at * math.exp(s * EXACT_STEP) for s in (1, -1)]
        high, low = (kalman_log_likelihood({**parameters, name: x}) for x in ends)
        gradient.append((high - low) / (2 * EXACT_STEP))
    return gradient


def _fix_covariance(t: np.ndarray, parameters: Mapping[str, float]) -> np.ndarray:
    """Covariance (n, n) of fixes at times `t`, s, since the start: cov(p − v·latency) plus the fixes' noise."""
    early, late = np.minimum(t[:, None], t[None, :]), np.maximum(t[:, None], t[None, :])
    density = parameters["motion.sigma_a"] ** 2
    # From standstill: position with position, velocity (row) with position (column), velocity with velocity.
    positions = density * early**2 * (3 * late - early) / 6
    mixed = density * (t[None, :] * early - early**2 / 2)
    speeds = density * early
    velocity = parameters["start.sigma_velocity"] ** 2
    positions = positions + parameters["start.sigma_position"] ** 2 + velocity * t[:, None] * t[None, :]
    mixed = mixed + velocity * t[None, :]
    speeds = speeds + velocity
    latency = parameters[LATENCY]
    cov = positions - latency * (mixed + mixed.T) + latency**2 * speeds
    return cov + parameters["sensors.fixes.sigma_horizontal"] ** 2 * np.eye(len(t))


def chain_measurements() -> np.ndarray:
    """Measurements (T,) of the hidden Markov chain."""
    return np.random.default_rng(2).normal(0.3, 1.0, len(CHAIN_INTERVALS) + 1)


def chain_log_likelihood(rate: float, sigma: float) -> float:
    """log L of the chain's measurements: the sum over all sequences of states."""
    measured = chain_measurements()
    density = np.exp(-0.5 * ((measured[:, None] - CHAIN_LEVELS) / sigma) ** 2) / sigma
    kept = np.exp(-rate * CHAIN_INTERVALS)
    total = 0.0
    for path in product(range(len(CHAIN_PROBABILITIES)), repeat=len(measured)):
        p = CHAIN_PROBABILITIES[path[0]]
        for row, (i, j) in enumerate(pairwise(path)):
            p *= kept[row] * (i == j) + (1 - kept[row]) * CHAIN_PROBABILITIES[j]
        total += p * math.prod(density[row, state] for row, state in enumerate(path))
    return math.log(total)


def chain_gradient() -> tuple[float, ...]:
    """d log L by the logarithms of the rate and of the noise."""
    return _gradient(chain_log_likelihood, (CHAIN_RATE, CHAIN_SIGMA), EXACT_STEP)


def _gradient(log_likelihood: Callable[..., float], at: Sequence[float], step: float) -> tuple[float, ...]:
    """Central differences by the logarithm of each argument."""

    def end(k: int, sign: int) -> float:
        return log_likelihood(*(x * math.exp(sign * step * (j == k)) for j, x in enumerate(at)))

    return tuple((end(k, 1) - end(k, -1)) / (2 * step) for k in range(len(at)))


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
