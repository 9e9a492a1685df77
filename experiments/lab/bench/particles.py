"""Speed of the particle filter on a line beside the textbook's: `python -m experiments.lab.bench.particles`.

Both filter the same fixes with the same motion and 1,000 particles, resample below an effective sample size of 500, and
take turns in one process. The textbook's resampling is a cumulative sum and a binary search per offspring; its
positions are interpolated between the knots. Ours also returns the covariance and the NIS of every row.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.cli.runtime import set_flags
from experiments.lab.bench.timing import clocked, turns

TRAJECTORIES, ROWS, PARTICLES = 256, 200, 1000
ROUNDS = 3
SIGMA_A, SIGMA_P = 0.1, 0.3
CHUNK = 64
"""Trajectories per chunk, whose particles fit the processor's cache."""

FLOOR = 4.0
"""Required speed-up over the textbook's."""


def main() -> int:
    """Measure and print a table; 1 if the speed-up is below the floor."""
    set_flags()
    from sim.line import THESIS_KNOTS

    fixes, times, truth = task()
    versions = {"ours": ours(fixes, times), "textbook": textbook(fixes, times, THESIS_KNOTS)}
    first, errors = {}, {}
    for name, run in versions.items():
        (first[name], _), estimated = clocked(run)
        errors[name] = rmse(estimated, truth)
    seconds = turns(list(versions.values()), ROUNDS)
    faster, faster_cpu = np.median(seconds[:, 1] / seconds[:, 0], axis=0).tolist()
    print(f"{TRAJECTORIES} trajectories x {ROWS} rows x {PARTICLES} particles, medians of {ROUNDS} turns")
    for k, name in enumerate(versions):
        median = float(np.median(seconds[:, k, 0]))
        rate = TRAJECTORIES * ROWS / median / 1e6
        print(
            f"{name:10s} {median:7.3f} s  {rate:6.3f} million trajectory-steps/s  first call {first[name]:5.1f} s"
            f"  RMSE {errors[name]:.3f} m"
        )
    print(f"ours is {faster:.1f} times as fast, {faster_cpu:.1f} times per processor second; floor {FLOOR:g}")
    return int(faster < FLOOR)


def task(trajectories: int = TRAJECTORIES) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fixes (n, T, 2), m, times (T,), s, and true positions (n, T, 2), m, of carts on the thesis's line."""
    from sim.line import simulate_line

    world = simulate_line("constant", trajectories, seed=20, rest_s=3.0, rate_hz=2.0 * ROWS / 120.0)
    return world.fixes[:, :ROWS], world.times[:ROWS], world.positions[:, :ROWS]


def rmse(estimated: np.ndarray, truth: np.ndarray) -> float:
    """RMSE, m, of positions (n, T, 2) without the first row, where the filters start in different ways."""
    return float(np.sqrt(np.mean(np.sum((estimated - truth)[:, 1:] ** 2, axis=-1))))


def ours(fixes: np.ndarray, times: np.ndarray, chunk: int = CHUNK) -> Callable[[], np.ndarray]:
    """A run of the tracker `line-pf` without halts; returns positions (n, T, 2), m."""
    from sim.line import THESIS_KNOTS
    from trackers.core.chunks import as_dtype, chunks, run_chunks
    from trackers.core.polyline import Polyline
    from trackers.core.recording import Readings, Recording, stack
    from trackers.core.tracker import filter_batch
    from trackers.line.fixes import FIXES, FloorFixes
    from trackers.line.motion import LineMotion
    from trackers.line.tracker import line_tracker

    tracker = line_tracker(LineMotion(Polyline(THESIS_KNOTS), SIGMA_A), {FIXES: FloorFixes(SIGMA_P)}, PARTICLES)
    seen = np.ones(fixes.shape[1:], bool)
    batch = stack([Recording(times, {FIXES: Readings(f, seen)}, name=f"trajectory {k}") for k, f in enumerate(fixes)])
    model = as_dtype(tracker, batch.dt.dtype)

    def run() -> np.ndarray:
        parts = run_chunks(filter_batch, [(model, part) for part in chunks(batch, chunk)])
        return np.concatenate([np.stack([np.asarray(x).T for x in p.mean.position], axis=-1) for p in parts])

    return run


def arclengths(knots: np.ndarray) -> np.ndarray:
    """Arclengths, m, of the knots (k, 2), m, of a path."""
    return np.concatenate([[0.0], np.cumsum(np.sqrt((np.diff(knots, axis=0) ** 2).sum(axis=1)))])


def position_on(knots: np.ndarray) -> Callable[[Any], Any]:
    """Positions (…, 2), m, by arclength, interpolated between the knots in single precision."""
    import jax.numpy as jnp

    marks, table = arclengths(knots).astype(np.float32), np.asarray(knots, np.float32)
    return lambda d: jnp.stack([jnp.interp(d, marks, table[:, k]) for k in (0, 1)], axis=-1)


def textbook(fixes: np.ndarray, times: np.ndarray, knots: np.ndarray) -> Callable[[], np.ndarray]:
    """A run of the filter as usually written: a scan over one trajectory, `vmap` over trajectories."""
    import jax
    import jax.numpy as jnp

    end, position = arclengths(knots).astype(np.float32)[-1], position_on(knots)
    dt = np.float32(times[1] - times[0])

    def step(carry: Any, row: Any) -> tuple[Any, Any]:
        key, d, speed, weights = carry
        key, noise, offset = jax.random.split(key, 3)
        cumulative = jnp.cumsum(weights)
        points = (jnp.arange(PARTICLES) + jax.random.uniform(offset)) / PARTICLES * cumulative[-1]
        ancestors = jnp.minimum(jnp.searchsorted(cumulative, points), PARTICLES - 1)
        resample = 1.0 / jnp.sum(weights**2) < 0.5 * PARTICLES
        d, speed = jnp.where(resample, d[ancestors], d), jnp.where(resample, speed[ancestors], speed)
        weights = jnp.where(resample, 1.0 / PARTICLES, weights)
        d = jnp.clip(d + dt * speed, 0.0, end)
        speed = jnp.maximum(speed + SIGMA_A * jnp.sqrt(dt) * jax.random.normal(noise, (PARTICLES,)), 0.0)
        square = jnp.sum((row - position(d)) ** 2, axis=-1) / SIGMA_P**2
        log_weights = jnp.log(weights) - 0.5 * square
        top = jnp.max(log_weights)
        weights = jnp.exp(log_weights - top)
        total = jnp.sum(weights)
        weights = weights / total
        log_evidence = top + jnp.log(total) - jnp.log(2 * jnp.pi * SIGMA_P**2)
        return (key, d, speed, weights), (position(jnp.sum(weights * d)), log_evidence)

    def one(key: Any, rows: Any) -> Any:
        key, start, pace = jax.random.split(key, 3)
        d = jnp.maximum(0.5 * jax.random.normal(start, (PARTICLES,)), 0.0)
        speed = jnp.maximum(0.1 * jax.random.normal(pace, (PARTICLES,)), 0.0)
        weights = jnp.full(PARTICLES, 1.0 / PARTICLES)
        positions, log_evidence = jax.lax.scan(step, (key, d, speed, weights), rows[1:])[1]
        return jnp.concatenate([position(jnp.mean(d))[None], positions]), jnp.sum(log_evidence)

    filtered = jax.jit(jax.vmap(one))
    keys, rows = jax.random.split(jax.random.key(0), len(fixes)), jnp.asarray(fixes, jnp.float32)
    return lambda: np.asarray(jax.block_until_ready(filtered(keys, rows))[0])


if __name__ == "__main__":
    sys.exit(main())
