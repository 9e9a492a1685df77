"""Deterministic gradients against their oracles: Kalman filter, hidden Markov chain and grid filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.experiments.lab.verify import oracles
from trackwright.experiments.lab.verify.check_result import CheckResult
from trackwright.experiments.lab.verify.gradients import Gradients, gradients
from trackwright.experiments.lab.verify.worlds import HALT_DT, HALT_TUNABLES, halt_batch, halt_tracker
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.tunable import Real, Scale, replaced
from trackwright.trackers.line.grid import GridFilter
from trackwright.trackers.line.motion import PathOutputMap
from trackwright.trackers.mhk.fusion import chain_predicted, chain_updated
from trackwright.trackers.parts.fixes import FIXES

SINGLE_PRECISION = 1e-4
"""Allowed relative deviation in single precision; absolute for values below 1."""

GRID_CELLS = 5e-3
"""The same for the grid filter, whose discretisation error is quadratic in the cell size."""

PARAMETERS = {"sigma_a": 1.0, "sigma_fix": 0.3, "sigma_position": 1.0, "sigma_velocity": 1.0, "latency": 0.1}
"""Parameters of the Kalman filter's check: m/s² per √Hz, m, m, m/s, s."""

ORACLE_NAMES = {
    "motion.sigma_a": "sigma_a",
    "sensors.fixes.sigma_horizontal": "sigma_fix",
    "start.sigma_position": "sigma_position",
    "start.sigma_velocity": "sigma_velocity",
    "sensors.fixes.latency": "latency",
}
"""The oracle's parameter of each of the tracker's tunables."""


def kalman_checks() -> list[CheckResult]:
    """The Kalman filter on late fixes with gaps, all tunables, against the joint density of the fixes."""
    times, values, seen = oracles.kalman_fixes()
    missing = np.zeros((len(times), 1))
    readings = Readings(np.hstack([values, missing]), np.hstack([seen, missing > 0]), np.zeros((len(times), 3)))
    batch = stack([Recording(times, {FIXES: readings}, {"height": np.zeros(len(times))})])
    new: dict[str, Any] = {
        name: Real(PARAMETERS[own], "s", typical=1.0) if own == "latency" else Scale(PARAMETERS[own])
        for name, own in ORACLE_NAMES.items()
    }
    found = gradients(replaced(fix_tracker(dof=None, planar=True), new), batch, list(ORACLE_NAMES))
    gradient = oracles.kalman_gradient(PARAMETERS)
    exact = [gradient[own] for own in ORACLE_NAMES.values()]
    value = oracles.kalman_log_likelihood(PARAMETERS)
    return _deterministic("fixes", "Kalman filter", list(ORACLE_NAMES), value, exact, found, SINGLE_PRECISION)


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
    found = jax.jit(jax.jacfwd(log_likelihood))(raw)
    return [
        _near("chain", f"d/d {name}", "forward algorithm", exact, float(slope), SINGLE_PRECISION)
        for name, exact, slope in zip(("rate", "sigma"), oracles.chain_gradient(), found, strict=True)
    ]


def grid_checks() -> list[CheckResult]:
    """The grid filter on a line with a halt against quadrature; a tag crosses whole cells, so that travel is exact."""
    speeds, fastest = 81, 2.0
    cells = round(12.0 / (fastest / (speeds - 1) * HALT_DT)) + 1
    report = PathOutputMap(Polyline([[0.0, 0.0], [12.0, 0.0]]), Scale(0.01, "m"))
    found = gradients(halt_tracker(GridFilter(report, cells, speeds, fastest)), halt_batch(1), HALT_TUNABLES)
    value, exact = oracles.halt_log_likelihood(), oracles.halt_gradient()
    return _deterministic("halt", "grid filter", HALT_TUNABLES, value, exact, found, GRID_CELLS)


def _deterministic(
    world: str,
    estimator: str,
    names: Sequence[str],
    value: float,
    gradient: Sequence[float],
    found: Gradients,
    tolerance: float,
) -> list[CheckResult]:
    """log L and its gradient of the single trajectory in `found` beside the oracle's."""
    quantities = ["log L", *(f"d/d {name}" for name in names)]
    estimates = [found.values[0], *found.gradient[:, 0]]
    return [
        _near(world, quantity, estimator, oracle, float(estimate), tolerance, found.seconds)
        for quantity, oracle, estimate in zip(quantities, [value, *gradient], estimates, strict=True)
    ]


def _near(
    world: str,
    quantity: str,
    estimator: str,
    oracle: float,
    estimate: float,
    tolerance: float,
    seconds: float = math.nan,
) -> CheckResult:
    allowed = tolerance * max(1.0, abs(oracle))
    return CheckResult(world, quantity, estimator, oracle, estimate, allowed, seconds=seconds)
