"""Particle gradients over many random keys against their oracles: between walls, and at a halt."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from trackwright.experiments.lab.verify import oracles
from trackwright.experiments.lab.verify.check_result import MAX_STANDARD_ERRORS, CheckResult, random_check
from trackwright.experiments.lab.verify.corridor import corridor_fixes
from trackwright.experiments.lab.verify.gradients import Gradients, gradients, marginal_gradients
from trackwright.experiments.lab.verify.worlds import (
    CORRIDOR_TUNABLES,
    HALT_TUNABLES,
    Estimator,
    corridor_batch,
    corridor_tracker,
    halt_batch,
    halt_tracker,
    score_form,
)
from trackwright.experiments.lab.verify.wrong_estimators import Naive, Reparameterised
from trackwright.trackers.core.filters.particle.filter import ParticleFilter

KEYS, PARTICLES = 400, 2000
"""Estimates with different random numbers, and particles of each."""

PAIRWISE_PARTICLES, PAIRWISE_KEYS = 200, 200
"""The same for the marginal score, whose cost is quadratic in the particles; more keys with fewer particles."""

SIZES = (125, 500, 2000)
"""Numbers of particles over which bias and spread are followed, with numbers of keys that make their costs equal."""

ORDER = 0.08
"""Allowed deviation of the spread's power of N from −½; the power at 125 particles is 0.02 off."""

CORRIDOR, CORRIDOR_ROWS = "corridor 25", 25


def corridor_checks(rows: int) -> list[CheckResult]:
    """The score form between walls, over `rows` fixes."""
    world, fixes = f"corridor {rows}", corridor_fixes(rows)
    found = _in_corridor(rows, score_form, PARTICLES, KEYS)
    return [
        _likelihood(world, oracles.corridor_log_likelihood(fixes), found),
        *_gradients(world, "score form", oracles.corridor_gradient(fixes), found),
    ]


def corridor_marginal_checks() -> list[CheckResult]:
    """The marginal score between walls over 25 rows, and its limit of many particles over 100 rows.

    Its spread is small enough to show the bias of a few hundred particles over many rows, and the decay as 1/N.
    """

    def run(rows: int, n: int, keys: int) -> Gradients:
        return marginal_gradients(corridor_tracker(n), corridor_batch(rows, keys), CORRIDOR_TUNABLES)

    name, world = "marginal score", "corridor 100"
    sizes = (PAIRWISE_PARTICLES // 4, PAIRWISE_PARTICLES // 2, PAIRWISE_PARTICLES)
    found = [run(100, n, PAIRWISE_KEYS * PAIRWISE_PARTICLES // n) for n in sizes]
    exact, few = (oracles.corridor_gradient(corridor_fixes(rows)) for rows in (100, CORRIDOR_ROWS))
    biases = np.array([f.gradient[1].mean() - exact[1] for f in found])
    errors = np.array([_standard_error(f.gradient[1]) for f in found])
    return [
        *_gradients(CORRIDOR, name, few, run(CORRIDOR_ROWS, PAIRWISE_PARTICLES, PAIRWISE_KEYS)),
        *_limits(world, name, exact, sizes, found),
        _power(world, name, sizes, biases, errors),
    ]


def corridor_wrong_checks() -> list[CheckResult]:
    """Two common derivatives, both biased by the walls."""
    exact = oracles.corridor_gradient(corridor_fixes(CORRIDOR_ROWS))[:1]
    naive = _in_corridor(CORRIDOR_ROWS, Naive, PARTICLES, KEYS)
    pathwise = _in_corridor(CORRIDOR_ROWS, Reparameterised, PARTICLES, KEYS)
    return [
        *_gradients(CORRIDOR, "naive", exact, naive, biased=True),
        *_gradients(CORRIDOR, "reparameterised", exact, pathwise, biased=True),
    ]


def halt_checks() -> list[CheckResult]:
    """The score form at a halt: speed, fixes and prior."""
    found = _at_halt(score_form, PARTICLES, KEYS)
    return [
        _likelihood("halt", oracles.halt_log_likelihood(), found),
        *_gradients("halt", "score form", oracles.halt_gradient(), found),
    ]


def halt_wrong_checks() -> list[CheckResult]:
    """The same two at the halt; the clamp at zero speed is continuous and does not bias the reparameterised one."""
    exact = oracles.halt_gradient()[:1]
    return [
        *_gradients("halt", "naive", exact, _at_halt(Naive, PARTICLES, KEYS), biased=True),
        *_gradients("halt", "reparameterised", exact, _at_halt(Reparameterised, PARTICLES, KEYS)),
    ]


def corridor_order_checks() -> list[CheckResult]:
    """Decay of bias and spread with the number of particles, between walls."""
    fixes = corridor_fixes(CORRIDOR_ROWS)
    exact, value = oracles.corridor_gradient(fixes), oracles.corridor_log_likelihood(fixes)
    return _orders(CORRIDOR, exact, value, partial(_in_corridor, CORRIDOR_ROWS, score_form))


def halt_order_checks() -> list[CheckResult]:
    """The same at a halt."""
    return _orders("halt", oracles.halt_gradient(), oracles.halt_log_likelihood(), partial(_at_halt, score_form))


def _orders(
    world: str, exact: tuple[float, ...], value: float, run: Callable[[int, int], Gradients]
) -> list[CheckResult]:
    """Bias in the limit of many particles, and the powers of N of bias and spread.

    The derivative of the likelihood itself is unbiased for any N, E(L̂s) = L·slope. The bias of s, the derivative of
    its logarithm, is therefore −cov(L̂/L, s), an estimate far more precise than the mean of s.
    """
    found = [run(n, KEYS * PARTICLES // n) for n in SIZES]
    spreads = np.array([f.gradient[0].std(ddof=1) for f in found])
    power = float(np.polyfit(np.log(SIZES), np.log(spreads), 1)[0])
    products = [-(np.exp(f.values - value) - 1.0) * (f.gradient[1] - f.gradient[1].mean()) for f in found]
    biases, errors = (np.array(x) for x in zip(*((p.mean(), _standard_error(p)) for p in products), strict=True))
    return [
        *_limits(world, "score form", exact, SIZES, found),
        CheckResult(world, "power of N of the spread, moves", "score form", -0.5, power, ORDER),
        _power(world, "score form", SIZES, biases, errors),
    ]


def _limits(
    world: str, estimator: str, exact: tuple[float, ...], sizes: tuple[int, ...], found: list[Gradients]
) -> list[CheckResult]:
    """Bias in the limit of many particles, from bias = a + c/N, by the noise of moves and of fixes."""
    results = []
    for k, name in enumerate(("moves", "fixes")):
        estimates = [f.gradient[k] for f in found]
        biases = np.array([e.mean() for e in estimates]) - exact[k]
        errors = np.array([_standard_error(e) for e in estimates])
        (limit, _), (error, _) = _line(1.0 / np.array(sizes), biases, errors)
        allowed = MAX_STANDARD_ERRORS * error
        results.append(CheckResult(world, f"bias at 1/N = 0, {name}", estimator, 0.0, limit, allowed, error))
    return results


def _power(world: str, estimator: str, sizes: tuple[int, ...], biases: np.ndarray, errors: np.ndarray) -> CheckResult:
    """The power of N of the bias by the noise of fixes, the larger of the two."""
    (_, power), (_, error) = _line(np.log(sizes), np.log(np.abs(biases)), errors / np.abs(biases))
    allowed = MAX_STANDARD_ERRORS * error
    return CheckResult(world, "power of N of the bias, fixes", estimator, -1.0, power, allowed, error)


def _standard_error(x: np.ndarray) -> float:
    """The standard error of the mean."""
    return float(x.std(ddof=1) / math.sqrt(len(x)))


def _line(x: np.ndarray, y: np.ndarray, errors: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Intercept and slope of the weighted straight-line fit, and the standard errors of both."""
    design = np.stack([np.ones(len(x)), x], axis=1) / errors[:, None]
    (intercept, slope), *_ = np.linalg.lstsq(design, y / errors)
    first, second = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    return (float(intercept), float(slope)), (float(first), float(second))


def _in_corridor(rows: int, estimator: Estimator, n: int, keys: int) -> Gradients:
    return gradients(corridor_tracker(n, estimator), corridor_batch(rows, keys), CORRIDOR_TUNABLES)


def _at_halt(estimator: Estimator, n: int, keys: int) -> Gradients:
    return gradients(halt_tracker(estimator(ParticleFilter(n))), halt_batch(keys), HALT_TUNABLES)


def _likelihood(world: str, exact: float, found: Gradients) -> CheckResult:
    """The likelihood itself, of which the particle filter's estimate is unbiased."""
    return random_check(world, "L / exact L", "particles", 1.0, np.exp(found.values - exact), found.seconds)


def _gradients(
    world: str, estimator: str, exact: tuple[float, ...], found: Gradients, biased: bool = False
) -> list[CheckResult]:
    names = CORRIDOR_TUNABLES if world.startswith("corridor") else HALT_TUNABLES
    return [
        random_check(world, f"d/d {name}", estimator, oracle, slopes, found.seconds, biased)
        for name, oracle, slopes in zip(names, exact, found.gradient, strict=False)
    ]
