"""Computing time of a fit: `python -m experiments.lab.bench.tuning`, with `--peers` beside scipy and dynamax.

System A, 4,096 trajectories of 200 rows, σ_a and σ_p, from starts wrong by a factor of ten, until convergence. Beside
it, in the same process, scipy's L-BFGS-B on finite differences of the same jitted objective, and optax's Adam on the
likelihood of dynamax's filter, on a small slice because larger batches of its solves deadlock.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.timing import clocked, write_json

LIMIT_S = 5.0
"""Limit of the time of a compiled fit."""

CORNERS = ((10.0, 10.0), (0.1, 0.1), (10.0, 0.1), (0.1, 10.0))
DYNAMAX_SLICE, DYNAMAX_STEPS = (16, 50), 20


def main(*, peers: bool = False, out: Path = Path("out/bench-tuning.json")) -> int:
    """Measure fits, print the results and write them as JSON; 1 if a fit takes too long.

    Args:
        peers: also scipy and dynamax (extra: peers).
        out: the JSON file to write.
    """
    set_flags()
    from experiments.lab.bench.__main__ import machine

    command = ["python", "-m", "experiments.lab.bench.tuning", *sys.argv[1:]]
    results: dict[str, Any] = {"command": command, "machine": machine(), "ours": ours()}
    if peers:
        results |= {"scipy": with_scipy(), "dynamax": with_dynamax()}
    print(json.dumps(results, indent=2))
    write_json(out, results)
    slowest = max(run["seconds"] for run in results["ours"]["fits"])
    print(f"the slowest of {len(CORNERS)} fits took {slowest:.2f} s; limit {LIMIT_S:g} s")
    return int(slowest > LIMIT_S)


def wrong(corner: tuple[float, float]) -> Any:
    """The benchmark's tracker with both noise levels multiplied by these factors."""
    from experiments.lab.bench.measure import TUNED, trackers
    from tuning.parameters import flatten, select_parameters, with_parameters

    tracker = trackers()[1]
    parameters = select_parameters(tracker, TUNED)
    return with_parameters(tracker, parameters, flatten(parameters) + np.log(corner))


def ours() -> dict[str, Any]:
    """Timed fits from every start, after one fit for compiling."""
    from experiments.lab.bench.measure import ROWS, TRAJECTORIES, TUNED, simulate
    from tuning import NegativeLogLikelihood, fit

    batch = simulate(TRAJECTORIES, ROWS).batch

    def run(corner: tuple[float, float]) -> tuple[tuple[float, float], Any]:
        return clocked(lambda: fit(wrong(corner), batch, NegativeLogLikelihood(), TUNED))

    (first, _), _ = run(CORNERS[0])
    fits = []
    for corner in CORNERS:
        (seconds, _), result = run(corner)
        fits.append(
            {
                "wrong_by": corner,
                "seconds": seconds,
                "evaluations": result.filter_runs / TRAJECTORIES,
                "value": result.value,
                "values": {name: float(x) for name, x in result.values.items()},
                "standard_errors": {name: float(x) for name, x in result.standard_errors.items()},
            }
        )
    return {"first_s": first, "fits": fits}


def with_scipy() -> dict[str, Any]:
    """Timed fits by scipy's L-BFGS-B with finite differences; their step suits single precision."""
    from scipy.optimize import minimize

    from experiments.lab.bench.measure import ROWS, TRAJECTORIES, TUNED, simulate
    from tuning import NegativeLogLikelihood
    from tuning.parameters import flatten, select_parameters
    from tuning.problem import Problem

    tracker = wrong((1.0, 1.0))
    parameters = select_parameters(tracker, TUNED)
    problem = Problem(tracker, [simulate(TRAJECTORIES, ROWS).batch], NegativeLogLikelihood(), parameters)
    problem.values(flatten(parameters))
    fits = []
    for corner in CORNERS:
        began = time.perf_counter()
        start = flatten(parameters) + np.log(corner)
        found = minimize(lambda v: float(problem.values(v)[0]), start, method="L-BFGS-B", options={"eps": 1e-3})
        fits.append(
            {
                "wrong_by": corner,
                "seconds": time.perf_counter() - began,
                "evaluations": found.nfev,
                "value": float(found.fun),
            }
        )
    return {"fits": fits}


def with_dynamax() -> dict[str, Any]:
    """Adam on the negative log-likelihood of dynamax's filter: time per gradient on a slice, and scaled to all data."""
    import jax
    import jax.numpy as jnp
    import optax

    from experiments.lab.bench.measure import ROWS, SIGMA_A, SIGMA_P, TRAJECTORIES, simulate
    from experiments.lab.bench.peers import with_dynamax as build
    from experiments.lab.bench.textbook import all_pairs
    from trackers.aoa.layout import DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH

    part = simulate(TRAJECTORIES, ROWS).part(*DYNAMAX_SLICE)
    pairs = all_pairs(DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH)

    def objective(v: Any) -> Any:
        levels: Any = jnp.exp(v)
        return -jnp.mean(build(pairs, levels[0], levels[1])(*part)[2]) / DYNAMAX_SLICE[1]

    optimiser = optax.adam(0.15)

    @jax.jit
    def step(v: Any, state: Any) -> tuple[Any, Any, Any]:
        value, gradient = jax.value_and_grad(objective)(v)
        update, state = optimiser.update(gradient, state)
        return v + update, state, value

    vector = jnp.log(jnp.array([10 * SIGMA_A, 10 * SIGMA_P], jnp.float32))
    state = optimiser.init(vector)
    (first, _), _ = clocked(lambda: jax.block_until_ready(step(vector, state)))
    began, values = time.perf_counter(), []
    for _ in range(DYNAMAX_STEPS):
        vector, state, value = step(vector, state)
        values.append(float(value))
    seconds = (time.perf_counter() - began) / DYNAMAX_STEPS
    whole = TRAJECTORIES * ROWS / (DYNAMAX_SLICE[0] * DYNAMAX_SLICE[1])
    return {
        "slice": DYNAMAX_SLICE,
        "first_s": first,
        "seconds_per_gradient": seconds,
        "seconds_per_gradient_of_all": seconds * whole,
        "values": values,
    }


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.tuning")
