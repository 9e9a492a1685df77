"""Gradients without randomness against their oracles: Kalman filter, grid on a line, hidden Markov chain."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.verify import chain_enumeration, dense_kalman, halt, halt_grid
from experiments.verify.findings import Finding
from experiments.verify.gradients import gradients
from trackers.baselines.fixes import fix_tracker
from trackers.core.polyline import Polyline
from trackers.core.recording import Readings, Recording, stack
from trackers.core.tracker import Tracker
from trackers.core.tunable import Real, Scale, replaced
from trackers.line.grid import GridFilter
from trackers.line.motion import OnFloor
from trackers.mhk.chain import predicted, updated
from trackers.parts.fixes import FIXES

SINGLE = 1e-4
"""By how much of itself a derivative in single precision may be off, and of 1 where it is smaller."""

GRID = 5e-3
"""The same for the grid: it shares probability between cells, an error of the square of their size."""

NUMBERS = {"sigma_a": 1.0, "sigma_fix": 0.3, "sigma_position": 1.0, "sigma_velocity": 1.0, "latency": 0.1}
"""At which the Kalman filter's gradient is taken: m/s² per √Hz, m, m, m/s, s."""

NAMES = {
    "motion.sigma_a": "sigma_a",
    "sensors.fixes.sigma_horizontal": "sigma_fix",
    "start.sigma_position": "sigma_position",
    "start.sigma_velocity": "sigma_velocity",
    "sensors.fixes.latency": "latency",
}
"""The tracker's tunables by the oracle's numbers."""


def kalman_findings() -> list[Finding]:
    """Straight motion from fixes, late ones with gaps: every tunable against the density of all fixes at once."""
    times, values, seen = dense_kalman.fixes()
    missing = np.zeros((len(times), 1))
    readings = Readings(np.hstack([values, missing]), np.hstack([seen, missing > 0]), np.zeros((len(times), 3)))
    batch = stack([Recording(times, {FIXES: readings}, {"height": np.zeros(len(times))})])
    tracker = fix_tracker(dof=None, planar=True)
    new: dict[str, Any] = {
        name: Real(NUMBERS[mine], "s", typical=1.0) if mine == "latency" else Scale(NUMBERS[mine])
        for name, mine in NAMES.items()
    }
    found = gradients(replaced(tracker, new), batch, list(NAMES))
    oracle = dense_kalman.slopes(NUMBERS)
    value = dense_kalman.log_likelihood(NUMBERS)
    findings = [_near("fixes", "log L", "Kalman filter", value, found.values[0], SINGLE, found.seconds)]
    for (name, mine), slope in zip(NAMES.items(), found.slopes[:, 0], strict=True):
        findings.append(_near("fixes", f"d/d {name}", "Kalman filter", oracle[mine], slope, SINGLE, found.seconds))
    return findings


def grid_tracker() -> Tracker:
    """The tracker of the halt on a grid whose cells a tag crosses in whole numbers, so that travel is exact."""
    speeds, fastest = 81, 2.0
    cells = round(12.0 / (fastest / (speeds - 1) * halt.DT)) + 1
    report = OnFloor(Polyline([[0.0, 0.0], [12.0, 0.0]]), Scale(0.01, "m"))
    return halt.halt_tracker(GridFilter(report, cells, speeds, fastest))


def grid_findings() -> list[Finding]:
    """The grid filter on a line with a halt against quadrature."""
    found = gradients(grid_tracker(), halt.halt_batch(1), halt.TUNED)
    findings = [_near("halt", "log L", "grid filter", halt_grid.log_likelihood(), found.values[0], GRID, found.seconds)]
    for name, exact, slope in zip(halt.TUNED, halt_grid.slopes(), found.slopes[:, 0], strict=True):
        findings.append(_near("halt", f"d/d {name}", "grid filter", exact, slope, GRID, found.seconds))
    return findings


def chain_findings() -> list[Finding]:
    """The hidden Markov chain's forward algorithm against every sequence of states."""
    shares, levels = jnp.asarray(chain_enumeration.SHARES), jnp.asarray(chain_enumeration.LEVELS)
    seen, intervals = jnp.asarray(chain_enumeration.readings()), jnp.asarray(chain_enumeration.INTERVALS)

    def log_likelihood(raw: Any) -> Any:
        rate, sigma = jnp.exp(raw[0]), jnp.exp(raw[1])
        weights, value = shares, 0.0
        for k in range(len(seen)):
            weights = predicted(weights, shares, jnp.exp(-rate * intervals[k - 1])) if k else weights
            weights, log = updated(weights, -0.5 * ((seen[k] - levels) / sigma) ** 2 - jnp.log(sigma))
            value = value + log
        return value

    raw = jnp.log(jnp.asarray([chain_enumeration.RATE, chain_enumeration.SIGMA]))
    found = jax.jit(jax.jacfwd(log_likelihood))(raw)
    exact = chain_enumeration.slopes()
    names = ("rate", "sigma")
    return [
        _near("chain", f"d/d {name}", "forward algorithm", e, float(s), SINGLE)
        for name, e, s in zip(names, exact, found, strict=True)
    ]


def _near(
    world: str, figure: str, estimator: str, oracle: float, found: Any, part: float, seconds: float = math.nan
) -> Finding:
    allowed = part * max(1.0, abs(oracle))
    return Finding(world, figure, estimator, oracle, float(found), allowed, seconds=seconds)
