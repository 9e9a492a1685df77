"""Speed of MH-K's hidden Markov chain of 7,129 accelerations: `python -m experiments.lab.bench.chain`.

MH-K as printed and with a chain that has memory, beside the same filter without a chain; and one step of the chain
beside the textbook's forward algorithm with a transition matrix of 7,129² entries.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.cli.runtime import set_flags
from experiments.lab.bench.timing import turns

TRAJECTORIES, ROWS, ROUNDS = 256, 200, 3


def main() -> int:
    """Measure and print a table."""
    set_flags()
    import equinox as eqx

    from sim.agv import simulate_agv
    from trackers.core.ekf import ExtendedKalman
    from trackers.mhk.tracker import mhk_tracker

    world = simulate_agv(TRAJECTORIES, rows=ROWS)
    mhk = mhk_tracker()
    versions = {
        "MH-K as printed": filtered(world, mhk),
        "MH-K, lasting chain": filtered(world, mhk_tracker(rate=1.0)),
        "MH-K without chain": filtered(world, eqx.tree_at(lambda t: t.fusion.filter, mhk, ExtendedKalman())),
    }
    print(f"{TRAJECTORIES} trajectories x {ROWS} rows, medians of {ROUNDS} turns")
    for name, run in versions.items():
        first, median = timed(run)
        rate = TRAJECTORIES * ROWS / median / 1e6
        print(f"{name:20s} {median:7.3f} s  {rate:6.3f} million trajectory-steps/s  first call {first:5.1f} s")
    steps = chain_steps()
    medians = {name: timed(run)[1] for name, run in steps.items()}
    for name, median in medians.items():
        print(f"one step, {name:10s} {median * 1e3:7.3f} ms for {TRAJECTORIES} trajectories")
    print(f"a step of rank one is {medians['N x N'] / medians['rank one']:.0f} times as fast")
    return 0


def timed(run: Callable[[], Any]) -> tuple[float, float]:
    """Seconds of the first call, compiling included, and the median of the others."""
    first, *others = turns([run], ROUNDS + 1)[:, 0, 0].tolist()
    return first, float(np.median(others))


def filtered(world: Any, tracker: Any) -> Callable[[], Any]:
    """A run of the tracker over the world's fixes."""
    from trackers.core.recording import Readings, Recording, stack
    from trackers.parts.fixes import FIXES

    readings = [{FIXES: Readings(f, s)} for f, s in zip(world.fixes, world.seen, strict=True)]
    inputs = {"height": np.zeros(len(world.times))}
    batch = stack([Recording(world.times, r, inputs, name=str(k)) for k, r in enumerate(readings)])
    return lambda: tracker.run(batch)


def chain_steps() -> dict[str, Callable[[], Any]]:
    """One step of the chain for all trajectories: ours in O(N), and by the full transition matrix."""
    import jax
    import jax.numpy as jnp

    from trackers.mhk.accelerations import AccelerationSphere
    from trackers.mhk.chain import predicted, updated

    stationary = jnp.asarray(AccelerationSphere().blocks().probabilities, jnp.float32)
    kappa = jnp.float32(0.9)
    matrix = kappa * jnp.eye(len(stationary), dtype=jnp.float32) + (1 - kappa) * stationary[None]
    weights = jnp.tile(stationary, (TRAJECTORIES, 1))
    log_likelihoods = jnp.asarray(np.random.default_rng(0).normal(size=weights.shape), jnp.float32)
    ours = jax.jit(jax.vmap(lambda w, x: updated(predicted(w, stationary, kappa), x)[0]))
    dense = jax.jit(lambda w, x: jax.vmap(lambda a, b: updated(a, b)[0])(w @ matrix, x))
    return {
        "rank one": lambda: ours(weights, log_likelihoods).block_until_ready(),
        "N x N": lambda: dense(weights, log_likelihoods).block_until_ready(),
    }


if __name__ == "__main__":
    sys.exit(main())
