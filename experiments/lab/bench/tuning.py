"""Computing time of a fit, beside scipy and dynamax."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from trackwright.experiments.cli.runtime import set_flags
from trackwright.experiments.lab.bench.beam import (
    ROWS,
    SIGMA_A,
    SIGMA_P,
    TRAJECTORIES,
    TUNED,
    World,
    simulate,
    trackers,
    with_dynamax,
)
from trackwright.experiments.lab.bench.timing import DEFAULTS, Bench, Row, Table, clocked, shown, turns
from trackwright.tuning.fitting import fit
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters, with_parameters
from trackwright.tuning.problem import Problem

LIMIT_S = 5.0
"""Limit of the time of a compiled fit."""

CORNERS = ((10.0, 10.0), (0.1, 0.1), (10.0, 0.1), (0.1, 10.0))
DYNAMAX_SLICE, DYNAMAX_STEPS = (16, 50), 20


def tuning(*, peers: bool = False, bench: Bench = DEFAULTS) -> int:
    """Computing time of a fit of σ_a and σ_p of the beam tracker, from starts wrong by a factor of ten.

    4,096 trajectories of 200 rows, after a fit that compiles. Beside it, in the same process, scipy's L-BFGS-B on
    finite differences of the same jitted objective, and a gradient of the likelihood of dynamax's filter, on a small
    slice because larger batches of its solves deadlock. 1 if a fit takes too long.

    Args:
        peers: also dynamax (extra: peers).
    """
    set_flags()
    size = (16, 20) if bench.small else (TRAJECTORIES, ROWS)
    world, corners = simulate(*size), CORNERS[:1] if bench.small else CORNERS
    versions: dict[str, Callable[[World], Callable[[Any], Row]]] = {
        "tuning.fit": with_fit,
        "scipy L-BFGS-B": with_scipy,
    }
    rows = shown(row for name, build in versions.items() for row in of_fits(name, build(world), corners))
    slowest = max(row["seconds"] for row in rows if row["version"] == "tuning.fit")
    tables = [Table(rows, "fits", f"The slowest of {len(corners)} fits took {slowest:.2f} s; limit {LIMIT_S:g} s.")]
    if peers:
        seconds, share = dynamax_gradient(world), world.angles[:, 0].size / np.prod(DYNAMAX_SLICE)
        tables.append(
            Table([{"of a slice, s": seconds, "of all, s": seconds * share}], "a gradient of dynamax's likelihood")
        )
    bench.publish("tuning", *tables)
    return int(slowest > LIMIT_S)


def of_fits(name: str, run: Callable[[Any], Row], corners: Any) -> Iterator[Row]:
    """Timed fits from every start, after one that compiles."""
    (first, _), _ = clocked(lambda: run(corners[0]))
    for corner in corners:
        (seconds, processor), found = clocked(partial(run, corner))
        times = {"first call s": first, "seconds": seconds, "processor s": processor}
        yield {"version": name, "wrong by": str(corner), **times, **found}


def wrong(corner: Any) -> Any:
    """The benchmark's tracker with both noise levels multiplied by these factors."""
    tracker = trackers()[1]
    parameters = select_parameters(tracker, TUNED)
    return with_parameters(tracker, parameters, flatten(parameters) + np.log(corner))


def with_fit(world: World) -> Callable[[Any], Row]:
    """Fits by `tuning.fit`."""

    def run(corner: Any) -> Row:
        found = fit(wrong(corner), world.batch, NegativeLogLikelihood(), TUNED)
        evaluations = found.filter_runs / world.angles.shape[2]
        values = {name: float(x) for name, x in found.values.items()}
        errors = {f"{name}, standard error": float(x) for name, x in found.standard_errors.items()}
        return {"evaluations": evaluations, "value": found.value, **values, **errors}

    return run


def with_scipy(world: World) -> Callable[[Any], Row]:
    """Fits by scipy's L-BFGS-B with finite differences; their step suits single precision."""
    tracker = trackers()[1]
    parameters = select_parameters(tracker, TUNED)
    problem = Problem(tracker, [world.batch], NegativeLogLikelihood(), parameters)

    def run(corner: Any) -> Row:
        start = flatten(parameters) + np.log(corner)
        found = minimize(lambda v: float(problem.values(v)[0]), start, method="L-BFGS-B", options={"eps": 1e-3})
        return {"evaluations": float(found.nfev), "value": float(found.fun)}

    return run


def dynamax_gradient(world: World) -> float:
    """Seconds of the gradient of the negative log-likelihood of dynamax's filter on a slice: median of warm calls."""
    part = world.part(*DYNAMAX_SLICE)

    def objective(v: Any) -> Any:
        levels: Any = jnp.exp(v)
        return -jnp.mean(with_dynamax(levels[0], levels[1])(*part)[2]) / part[0].shape[1]

    gradient, at = jax.jit(jax.value_and_grad(objective)), jnp.log(jnp.array([10 * SIGMA_A, 10 * SIGMA_P], jnp.float32))
    jax.block_until_ready(gradient(at))
    return float(np.median(turns([lambda: jax.block_until_ready(gradient(at))], DYNAMAX_STEPS)[:, 0, 0]))
