"""Particle gradients over many keys against the oracles: between walls, and where a speed is cut off at zero."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from experiments.verify import corridor, corridor_grid, halt, halt_grid
from experiments.verify.estimators import Naive, Reparameterised
from experiments.verify.findings import ERRORS, Finding, random
from experiments.verify.gradients import Gradients, gradients, marginal_gradients
from sim.corridor import corridor_fixes
from trackers.core.particle.filter import ParticleFilter

KEYS, PARTICLES = 400, 2000
"""How often an estimate is made, each time with other random numbers, and from how many particles."""

PAIRS, PAIRS_KEYS = 200, 200
"""The same of the marginal score, whose cost is the particles' number squared; of fewer particles more keys."""

SIZES = (125, 500, 2000)
"""Numbers of particles over which bias and spread are followed, with keys that make all of them equally dear."""

ORDER = 0.08
"""By how much the power of N of the spread may differ from −½: at 125 particles it is not there yet (0.02)."""


def corridor_findings(rows: int) -> list[Finding]:
    """The score form between walls, with so many fixes."""
    world, exact = f"corridor {rows}", corridor_grid.log_likelihood(corridor_fixes(rows))
    found = _in_corridor(rows, corridor.Boxed, PARTICLES, KEYS)
    return [
        _likelihood(world, exact, found),
        *_slopes(world, "score form", corridor_grid.slopes(corridor_fixes(rows)), found),
    ]


def corridor_pairs_findings() -> list[Finding]:
    """The marginal score between walls: itself, and the limit of many particles over a hundred rows.

    Its spread is so small that the bias of some hundred particles shows over many rows, and that it falls as 1/N.
    """

    def run(rows: int, n: int, keys: int) -> Gradients:
        tracker = corridor.corridor_tracker(corridor.corridor_filter(n))
        return marginal_gradients(tracker, corridor.corridor_batch(rows, keys), corridor.TUNED)

    name, sizes = "marginal score", (PAIRS // 4, PAIRS // 2, PAIRS)
    found = [run(100, n, PAIRS_KEYS * PAIRS // n) for n in sizes]
    exact = corridor_grid.slopes(corridor_fixes(100))
    biases = [f.slopes[1].mean() - exact[1] for f in found]
    return [
        *_slopes("corridor 25", name, corridor_grid.slopes(corridor_fixes(25)), run(25, PAIRS, PAIRS_KEYS)),
        *_limits("corridor 100", name, exact, sizes, found),
        _power("corridor 100", name, sizes, np.array(biases), np.array([_error(f.slopes[1]) for f in found])),
    ]


def corridor_wrong_findings() -> list[Finding]:
    """Two usual derivatives, which don't see that particles die at walls."""
    exact = corridor_grid.slopes(corridor_fixes(25))[:1]
    naive = _in_corridor(25, corridor.BoxedNaive, PARTICLES, KEYS)
    moves = _in_corridor(25, corridor.BoxedReparameterised, PARTICLES, KEYS)
    return [
        *_slopes("corridor 25", "naive", exact, naive, wrong=True),
        *_slopes("corridor 25", "reparameterised", exact, moves, wrong=True),
    ]


def halt_findings() -> list[Finding]:
    """The score form at a halt: speed, fixes and start."""
    found = _at_halt(ParticleFilter, PARTICLES, KEYS)
    return [
        _likelihood("halt", halt_grid.log_likelihood(), found),
        *_slopes("halt", "score form", halt_grid.slopes(), found),
    ]


def halt_wrong_findings() -> list[Finding]:
    """The same two at the halt: a cut at zero is continuous, so that moves may be differentiated, ancestors not."""
    exact = halt_grid.slopes()
    return [
        *_slopes("halt", "naive", exact[:1], _at_halt(Naive, PARTICLES, KEYS), wrong=True),
        *_slopes("halt", "reparameterised", exact[:1], _at_halt(Reparameterised, PARTICLES, KEYS)),
    ]


def corridor_order_findings() -> list[Finding]:
    """How bias and spread fall with the number of particles, between walls."""
    exact, value = corridor_grid.slopes(corridor_fixes(25)), corridor_grid.log_likelihood(corridor_fixes(25))
    return _orders("corridor 25", exact, value, lambda n, keys: _in_corridor(25, corridor.Boxed, n, keys))


def halt_order_findings() -> list[Finding]:
    """The same at a halt."""
    exact, value = halt_grid.slopes(), halt_grid.log_likelihood()
    return _orders("halt", exact, value, lambda n, keys: _at_halt(ParticleFilter, n, keys))


def _orders(world: str, exact: tuple[float, ...], value: float, run: Callable[[int, int], Gradients]) -> list[Finding]:
    """What bias infinitely many particles would leave, and with which power of N bias and spread fall.

    The derivative of the likelihood itself is unbiased for any N, E(L̂s) = L·slope. So the bias of s, the derivative of
    its logarithm, is −cov(L̂/L, s), which is known many times better than the mean of s.
    """
    found = [run(n, KEYS * PARTICLES // n) for n in SIZES]
    spreads = np.array([f.slopes[0].std(ddof=1) for f in found])
    power = float(np.polyfit(np.log(SIZES), np.log(spreads), 1)[0])
    products = [-(np.exp(f.values - value) - 1.0) * (f.slopes[1] - f.slopes[1].mean()) for f in found]
    biases, errors = (np.array(x) for x in zip(*((p.mean(), _error(p)) for p in products), strict=True))
    return [
        *_limits(world, "score form", exact, SIZES, found),
        Finding(world, "power of N of the spread, moves", "score form", -0.5, power, ORDER),
        _power(world, "score form", SIZES, biases, errors),
    ]


def _limits(
    world: str, estimator: str, exact: tuple[float, ...], sizes: tuple[int, ...], found: list[Gradients]
) -> list[Finding]:
    """Which bias infinitely many particles would leave, by bias = a + c/N: by the noise of moves and of fixes."""
    findings = []
    for k, name in enumerate(("moves", "fixes")):
        estimates = [f.slopes[k] for f in found]
        biases = np.array([e.mean() for e in estimates]) - exact[k]
        (left, _), (error, _) = _line(1.0 / np.array(sizes), biases, np.array([_error(e) for e in estimates]))
        findings.append(Finding(world, f"bias at 1/N = 0, {name}", estimator, 0.0, left, ERRORS * error, error))
    return findings


def _power(world: str, estimator: str, sizes: tuple[int, ...], biases: np.ndarray, errors: np.ndarray) -> Finding:
    """With which power of N the bias by the noise of fixes falls, which has most of it."""
    (_, power), (_, error) = _line(np.log(sizes), np.log(np.abs(biases)), errors / np.abs(biases))
    return Finding(world, "power of N of the bias, fixes", estimator, -1.0, power, ERRORS * error, error)


def _error(x: np.ndarray) -> float:
    """The standard error of a mean."""
    return float(x.std(ddof=1) / math.sqrt(len(x)))


def _line(x: np.ndarray, y: np.ndarray, errors: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Intercept and slope of the line through points with these errors, and the standard errors of both."""
    design = np.stack([np.ones(len(x)), x], axis=1) / errors[:, None]
    (intercept, slope), *_ = np.linalg.lstsq(design, y / errors)
    first, second = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    return (float(intercept), float(slope)), (float(first), float(second))


def _in_corridor(rows: int, kind: type[ParticleFilter], n: int, keys: int) -> Gradients:
    tracker = corridor.corridor_tracker(corridor.corridor_filter(n, kind))
    return gradients(tracker, corridor.corridor_batch(rows, keys), corridor.TUNED)


def _at_halt(kind: type[ParticleFilter], n: int, keys: int) -> Gradients:
    return gradients(halt.halt_tracker(kind(n)), halt.halt_batch(keys), halt.TUNED)


def _likelihood(world: str, exact: float, found: Gradients) -> Finding:
    """The mean of the likelihood itself, of which particles are an unbiased estimate."""
    return random(world, "L / exact L", "particles", 1.0, np.exp(found.values - exact), found.seconds)


def _slopes(
    world: str, estimator: str, exact: tuple[float, ...], found: Gradients, wrong: bool = False
) -> list[Finding]:
    names = corridor.TUNED if world.startswith("corridor") else halt.TUNED
    return [
        random(world, f"d/d {name}", estimator, oracle, slopes, found.seconds, wrong)
        for name, oracle, slopes in zip(names, exact, found.slopes, strict=False)
    ]
