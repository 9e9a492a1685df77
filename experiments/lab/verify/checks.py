"""The checks of `verify`: gradients of filters, and particle gradients over many random keys, against their oracles."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.experiments.lab.verify import oracles
from trackwright.experiments.lab.verify.marginal_score import marginal_scores
from trackwright.experiments.lab.verify.worlds import (
    CORRIDOR_TUNABLES,
    HALT_DT,
    HALT_TUNABLES,
    Estimator,
    corridor_batch,
    corridor_fixes,
    corridor_tracker,
    halt_batch,
    halt_tracker,
    score_form,
)
from trackwright.experiments.lab.verify.wrong_estimators import NAIVE, REPARAMETERISED
from trackwright.experiments.text.tables import aligned
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.core.data.recording import Batch, Readings, Recording, stack
from trackwright.trackers.core.filters.particle.filter import AbstractParticleFilter, ParticleFilter
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.tunable import Real, Scale, replaced
from trackwright.trackers.core.run.chunks import has_large_state, pieces, placed, run_chunks
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.line.grid import GridFilter
from trackwright.trackers.line.motion import PathOutputMap
from trackwright.trackers.mhk.fusion import chain_predicted, chain_updated
from trackwright.trackers.parts.fixes import FIXES
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

MAX_STANDARD_ERRORS = 4.0
"""Allowed deviation of a mean, in standard errors: of a hundred correct means, one exceeds it in 160 runs."""


@dataclass(frozen=True)
class CheckResult:
    """An estimated quantity of a world beside the oracle's value.

    `mean` may deviate by `allowed`. `error`: its standard error; `spread`: standard deviation of one estimate; both
    NaN for deterministic estimators. `seconds`: per gradient. `biased`: the estimator is known to be wrong here, so
    that the deviation must exceed `allowed`.
    """

    world: str
    quantity: str
    estimator: str
    oracle: float
    mean: float
    allowed: float
    error: float = math.nan
    spread: float = math.nan
    seconds: float = math.nan
    biased: bool = False

    @property
    def passed(self) -> bool:
        """Whether the mean is finite, and deviates by no more than allowed, or by more if biased."""
        return (abs(self.mean - self.oracle) <= self.allowed) != self.biased and math.isfinite(self.mean)

    @property
    def outcome(self) -> str:
        """The result in words."""
        if self.biased:
            return "fails as expected" if self.passed else "PASSES UNEXPECTEDLY"
        return "pass" if self.passed else "FAIL"


def random_check(
    world: str,
    quantity: str,
    estimator: str,
    oracle: float,
    estimates: np.ndarray,
    seconds: float = math.nan,
    biased: bool = False,
) -> CheckResult:
    """The check of independent estimates (n,), whose mean may be `MAX_STANDARD_ERRORS` standard errors off."""
    spread = float(np.std(estimates, ddof=1))
    error = spread / math.sqrt(len(estimates))
    mean, allowed = float(np.mean(estimates)), MAX_STANDARD_ERRORS * error
    return CheckResult(world, quantity, estimator, oracle, mean, allowed, error, spread, seconds, biased)


HEADER = ("world", "quantity", "estimator", "oracle", "mean", "bias", "± error", "allowed", "spread", "ms", "result")


def table(results: Sequence[CheckResult]) -> str:
    """All results as text, one line each; `error` is the mean's standard error, `ms` the time of one gradient."""
    rows: list[tuple[str, ...]] = [HEADER]
    for r in results:
        numbers = [r.oracle, r.mean, r.mean - r.oracle, r.error, r.allowed, r.spread, 1e3 * r.seconds]
        shown = ["-" if math.isnan(x) else f"{x:.4g}" for x in numbers]
        rows.append((r.world, r.quantity, r.estimator, *shown, r.outcome))
    return f"{aligned(rows, range(3, 10))}\n{sum(r.passed for r in results)} of {len(results)} checks passed"


MAX_BATCH = 64
"""Trajectories of 2,000 particles per chunk, which fit the cache; more in proportion for fewer particles."""


class Gradients(NamedTuple):
    """log L (n,) of n trajectories, its gradient (p, n) by unconstrained parameters, and seconds per trajectory."""

    values: np.ndarray
    gradient: np.ndarray
    seconds: float


def gradients(tracker: AbstractTracker, batch: Batch, patterns: str | Sequence[str]) -> Gradients:
    """log L and its gradient as `tune` computes them, by the tunables that match the patterns.

    The time excludes compiling.
    """
    parameters = select_parameters(tracker, patterns)
    particles = tracker.filter if isinstance(tracker, Tracker) else None
    n_particles = particles.bootstrap.n_particles if isinstance(particles, AbstractParticleFilter) else 2000
    chunk = max(1, MAX_BATCH * 2000 // n_particles)
    problem = Problem(tracker, [batch], NegativeLogLikelihood(), parameters, chunk)
    vector = flatten(parameters)[None, :]
    parts = placed(pieces(batch, chunk, has_large_state(tracker)))
    run_chunks(problem.with_derivatives, [(problem.point(vector), next(parts))])
    started = time.perf_counter()
    evaluation = problem.evaluate(vector)
    seconds = (time.perf_counter() - started) / batch.size
    return Gradients(-evaluation.terms[0, 0, : batch.size], -evaluation.term_gradients[0, 0, :, : batch.size], seconds)


def marginal_gradients(tracker: Tracker, batch: Batch, patterns: str | Sequence[str]) -> Gradients:
    """The same by the marginal score; the time includes compiling."""
    started = time.perf_counter()
    values, scores = marginal_scores(tracker, batch, patterns)
    return Gradients(values, scores.T, (time.perf_counter() - started) / batch.size)


SINGLE_PRECISION = 1e-4
"""Allowed relative deviation in single precision; absolute for values below 1."""

GRID_CELLS = 5e-3
"""The same for the grid filter, whose discretisation error is quadratic in the cell size."""

PARAMETERS = {
    "motion.sigma_a": 1.0,
    "sensors.fixes.sigma_horizontal": 0.3,
    "start.sigma_position": 1.0,
    "start.sigma_velocity": 1.0,
    oracles.LATENCY: 0.1,
}
"""Tunables of the Kalman filter's check: m/s² per √Hz, m, m, m/s, s."""


def kalman_checks() -> list[CheckResult]:
    """The Kalman filter on late fixes with gaps, all tunables, against the joint density of the fixes."""
    times, values, seen = oracles.kalman_fixes()
    missing = np.zeros((len(times), 1))
    readings = Readings(np.hstack([values, missing]), np.hstack([seen, missing > 0]), np.zeros((len(times), 3)))
    batch = stack([Recording(times, {FIXES: readings}, {"height": np.zeros(len(times))})])
    new: dict[str, Any] = {
        name: Real(x, "s", typical=1.0) if name == oracles.LATENCY else Scale(x) for name, x in PARAMETERS.items()
    }
    result = gradients(replaced(fix_tracker(dof=None, planar=True), new), batch, list(PARAMETERS))
    exact = [oracles.kalman_log_likelihood(PARAMETERS), *oracles.kalman_gradient(PARAMETERS)]
    return _deterministic(
        "fixes", "Kalman filter", ["log L", *PARAMETERS], exact, _first(result), SINGLE_PRECISION, result.seconds
    )


def chain_checks() -> list[CheckResult]:
    """The forward algorithm of the hidden Markov chain against the enumeration of all state sequences."""
    shares, levels = jnp.asarray(oracles.CHAIN_PROBABILITIES), jnp.asarray(oracles.CHAIN_LEVELS)
    measured, intervals = jnp.asarray(oracles.chain_measurements()), jnp.asarray(oracles.CHAIN_INTERVALS)

    def log_likelihood(raw: Any) -> Any:
        rate, sigma = jnp.exp(raw[0]), jnp.exp(raw[1])
        weights, value = shares, 0.0
        for k in range(len(measured)):
            weights = chain_predicted(weights, shares, jnp.exp(-rate * intervals[k - 1])) if k else weights
            weights, log = chain_updated(weights, -0.5 * ((measured[k] - levels) / sigma) ** 2 - jnp.log(sigma))
            value = value + log
        return value

    raw = jnp.log(jnp.asarray([oracles.CHAIN_RATE, oracles.CHAIN_SIGMA]))
    slopes = jax.jit(jax.jacfwd(log_likelihood))(raw)
    return _deterministic(
        "chain", "forward algorithm", ["rate", "sigma"], oracles.chain_gradient(), slopes, SINGLE_PRECISION
    )


def grid_checks() -> list[CheckResult]:
    """The grid filter on a line with a halt against quadrature; a tag crosses whole cells, so that travel is exact."""
    speeds, fastest = 81, 2.0
    cells = round(12.0 / (fastest / (speeds - 1) * HALT_DT)) + 1
    report = PathOutputMap(Polyline([[0.0, 0.0], [12.0, 0.0]]), Scale(0.01, "m"))
    result = gradients(halt_tracker(GridFilter(report, cells, speeds, fastest)), halt_batch(1), HALT_TUNABLES)
    exact = [oracles.halt_log_likelihood(), *oracles.halt_gradient()]
    return _deterministic(
        "halt", "grid filter", ["log L", *HALT_TUNABLES], exact, _first(result), GRID_CELLS, result.seconds
    )


def _first(result: Gradients) -> list[float]:
    """log L and its gradient of the first trajectory."""
    return [result.values[0], *result.gradient[:, 0]]


def _deterministic(
    world: str,
    estimator: str,
    names: Sequence[str],
    exact: Sequence[float],
    estimates: Sequence[float],
    tolerance: float,
    seconds: float = math.nan,
) -> list[CheckResult]:
    """Estimates beside the oracle's: of log L, and of its derivatives by tunables."""
    return [
        CheckResult(
            world, name if name == "log L" else f"d/d {name}", estimator, oracle, float(estimate),
            tolerance * max(1.0, abs(oracle)), seconds=seconds,
        )
        for name, oracle, estimate in zip(names, exact, estimates, strict=True)
    ]  # fmt: skip


KEYS, PARTICLES = 400, 2000
"""Estimates with different random numbers, and particles of each."""

PAIRWISE_PARTICLES, PAIRWISE_KEYS = 200, 200
"""The same for the marginal score, whose cost is quadratic in the particles; more keys with fewer particles."""

SIZES = (125, 500, 2000)
"""Numbers of particles over which bias and spread are followed, with numbers of keys that make their costs equal."""

ORDER = 0.08
"""Allowed deviation of the spread's power of N from −½; the power at 125 particles is 0.02 off."""


class World(NamedTuple):
    """A world of particles: its tunables, log L and gradient by the oracle, and `run(estimator, particles, keys)`."""

    name: str
    tunables: Sequence[str]
    value: Callable[[], float]
    slopes: Callable[[], tuple[float, ...]]
    run: Callable[[Estimator, int, int], Gradients]


def corridor(rows: int) -> World:
    """The corridor, over so many fixes."""
    fixes = corridor_fixes(rows)
    return World(
        f"corridor {rows}",
        CORRIDOR_TUNABLES,
        partial(oracles.corridor_log_likelihood, fixes),
        partial(oracles.corridor_gradient, fixes),
        lambda e, n, keys: gradients(corridor_tracker(n, e), corridor_batch(rows, keys), CORRIDOR_TUNABLES),
    )


CORRIDOR_25, CORRIDOR_100 = corridor(25), corridor(100)
HALT = World(
    "halt",
    HALT_TUNABLES,
    oracles.halt_log_likelihood,
    oracles.halt_gradient,
    lambda e, n, keys: gradients(halt_tracker(e(ParticleFilter(n))), halt_batch(keys), HALT_TUNABLES),
)


def score_checks(world: World) -> list[CheckResult]:
    """The score form; and the likelihood itself, of which the particle filter's estimate is unbiased."""
    result = world.run(score_form, PARTICLES, KEYS)
    ratios = np.exp(result.values - world.value())
    return [
        random_check(world.name, "L / exact L", "particles", 1.0, ratios, result.seconds),
        *_gradients(world, "score form", result),
    ]


def marginal_checks() -> list[CheckResult]:
    """The marginal score between walls over 25 rows, and its limit of many particles over 100 rows.

    Its spread is small enough to show the bias of a few hundred particles over many rows, and the decay as 1/N.
    """

    def run(rows: int, n: int, keys: int) -> Gradients:
        return marginal_gradients(corridor_tracker(n), corridor_batch(rows, keys), CORRIDOR_TUNABLES)

    name, world = "marginal score", CORRIDOR_100
    sizes = (PAIRWISE_PARTICLES // 4, PAIRWISE_PARTICLES // 2, PAIRWISE_PARTICLES)
    runs = [run(100, n, PAIRWISE_KEYS * PAIRWISE_PARTICLES // n) for n in sizes]
    exact = world.slopes()
    biases = np.array([r.gradient[1].mean() - exact[1] for r in runs])
    errors = np.array([_standard_error(r.gradient[1]) for r in runs])
    return [
        *_gradients(CORRIDOR_25, name, run(25, PAIRWISE_PARTICLES, PAIRWISE_KEYS)),
        *_limits(world, name, sizes, runs),
        _power(world, name, sizes, biases, errors),
    ]


def wrong_checks(world: World, walls: bool) -> list[CheckResult]:
    """Two common derivatives, by the moves: both are biased by walls.

    A clamp at zero speed is continuous and does not bias the reparameterised one.
    """
    return [
        check
        for name, estimator, biased in (("naive", NAIVE, True), ("reparameterised", REPARAMETERISED, walls))
        for check in _gradients(world, name, world.run(estimator, PARTICLES, KEYS), biased)[:1]
    ]


def order_checks(world: World) -> list[CheckResult]:
    """Bias in the limit of many particles, and the powers of N of bias and spread.

    The derivative of the likelihood itself is unbiased for any N, E(L̂s) = L·slope. The bias of s, the derivative of
    its logarithm, is therefore −cov(L̂/L, s), an estimate far more precise than the mean of s.
    """
    runs = [world.run(score_form, n, KEYS * PARTICLES // n) for n in SIZES]
    spreads = np.array([r.gradient[0].std(ddof=1) for r in runs])
    power = float(np.polyfit(np.log(SIZES), np.log(spreads), 1)[0])
    value = world.value()
    products = [-(np.exp(r.values - value) - 1.0) * (r.gradient[1] - r.gradient[1].mean()) for r in runs]
    biases, errors = (np.array(x) for x in zip(*((p.mean(), _standard_error(p)) for p in products), strict=True))
    return [
        *_limits(world, "score form", SIZES, runs),
        CheckResult(world.name, "power of N of the spread, moves", "score form", -0.5, power, ORDER),
        _power(world, "score form", SIZES, biases, errors),
    ]


def _limits(world: World, estimator: str, sizes: tuple[int, ...], runs: list[Gradients]) -> list[CheckResult]:
    """Bias in the limit of many particles, from bias = a + c/N, by the noise of moves and of fixes."""
    results = []
    for k, (name, exact) in enumerate(zip(("moves", "fixes"), world.slopes(), strict=False)):
        estimates = [r.gradient[k] for r in runs]
        biases = np.array([e.mean() for e in estimates]) - exact
        errors = np.array([_standard_error(e) for e in estimates])
        (limit, _), (error, _) = _line(1.0 / np.array(sizes), biases, errors)
        allowed = MAX_STANDARD_ERRORS * error
        results.append(CheckResult(world.name, f"bias at 1/N = 0, {name}", estimator, 0.0, limit, allowed, error))
    return results


def _power(world: World, estimator: str, sizes: tuple[int, ...], biases: np.ndarray, errors: np.ndarray) -> CheckResult:
    """The power of N of the bias by the noise of fixes, the larger of the two."""
    (_, power), (_, error) = _line(np.log(sizes), np.log(np.abs(biases)), errors / np.abs(biases))
    allowed = MAX_STANDARD_ERRORS * error
    return CheckResult(world.name, "power of N of the bias, fixes", estimator, -1.0, power, allowed, error)


def _standard_error(x: np.ndarray) -> float:
    """The standard error of the mean."""
    return float(x.std(ddof=1) / math.sqrt(len(x)))


def _line(x: np.ndarray, y: np.ndarray, errors: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Intercept and slope of the weighted straight-line fit, and the standard errors of both."""
    design = np.stack([np.ones(len(x)), x], axis=1) / errors[:, None]
    (intercept, slope), *_ = np.linalg.lstsq(design, y / errors)
    first, second = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    return (float(intercept), float(slope)), (float(first), float(second))


def _gradients(world: World, estimator: str, result: Gradients, biased: bool = False) -> list[CheckResult]:
    return [
        random_check(world.name, f"d/d {name}", estimator, oracle, slopes, result.seconds, biased)
        for name, oracle, slopes in zip(world.tunables, world.slopes(), result.gradient, strict=True)
    ]


CHECKS: tuple[Callable[[], list[CheckResult]], ...] = (
    kalman_checks,
    chain_checks,
    grid_checks,
    partial(score_checks, CORRIDOR_25),
    partial(score_checks, CORRIDOR_100),
    marginal_checks,
    partial(score_checks, HALT),
    partial(order_checks, CORRIDOR_25),
    partial(order_checks, HALT),
    partial(wrong_checks, CORRIDOR_25, walls=True),
    partial(wrong_checks, HALT, walls=False),
)
"""Correct gradients against their oracles, and biased ones that must fail."""
