"""The particle filter on a line beside a textbook version, `particles` and cuthbert, which take turns with ours.

All filter fixes of the same carts with the same motion and 1,000 particles, and resample below an effective sample size
of 500. The textbook's resampling is a cumulative sum and a binary search per offspring; its positions are interpolated
between the knots. `particles` filters one trajectory after the other on NumPy, cuthbert under `vmap` (extra: peers).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.experiments.lab.bench.beam import filtering
from trackwright.experiments.lab.bench.timing import Version, apart_each, compared
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table
from trackwright.sim.line import THESIS_KNOTS, simulate_line
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.line.fixes import FIXES, FloorFixes
from trackwright.trackers.line.motion import LineMotion
from trackwright.trackers.line.tracker import line_tracker

TRAJECTORIES, ROWS, PARTICLES, ROUNDS = 256, 200, 1000, 5
SLICES = {"textbook": TRAJECTORIES, "particles": 4, "cuthbert": 32}
"""Trajectories of each; peers are dozens of times slower, and cuthbert stores every particle of every row."""

FLOORS = {"textbook": 4.0, "particles": 25.0, "cuthbert": 25.0}
"""Required speed-up."""

SIGMA_A, SIGMA_P = 0.1, 0.3
CHUNK = 64
"""Trajectories per chunk, whose particles fit the processor's cache."""

LIMIT_S = 300.0
KNOTS = np.asarray(THESIS_KNOTS, float)
MARKS = np.concatenate([[0.0], np.cumsum(np.sqrt((np.diff(KNOTS, axis=0) ** 2).sum(axis=1)))])
"""Arclengths of the knots, m."""

Run = Callable[[], np.ndarray]
"""A run of a filter, which returns positions (n, T, 2), m."""


def particles(*, peers: bool = False, output: Output = DEFAULTS) -> int:
    """Speed of the particle filter on a line beside the textbook's and other libraries.

    Each takes turns with ours in a process of its own; ratios are taken within a round. 1 if a speed-up is too
    small, or a process fails.

    Args:
        peers: also `particles` and cuthbert (extra: peers).
    """
    rows = apart_each("bench.particles:beside", FLOORS if peers else ("textbook",), output.small, LIMIT_S)
    output.publish("bench particles", Table(rows, note=f"Errors: RMSE, m. Floors of the speed-up: {FLOORS}."))
    slow = [row["version"] for row in rows if row.get("ours × faster", 0.0) < FLOORS.get(row["version"], 0.0)]
    return int(bool(slow) and not output.small)


def beside(other: str, small: bool) -> Row:
    """Medians of ours and another version."""
    fixes, times, truth = task(8 if small else TRAJECTORIES, 20 if small else ROWS)
    few = fixes[: SLICES[other]]
    runs = {"ours": (fixes, ours(fixes, times)), other: (few, VERSIONS[other](few, times, PARTICLES))}
    versions = {
        name: Version(part.shape[0], part.shape[1], run, lambda means: rmse(means, truth[: len(means)]))
        for name, (part, run) in runs.items()
    }
    return {"rows": compared(versions, 1 if small else ROUNDS)}


def version(name: str, count: int) -> tuple[Run, int]:
    """A run of one version with so many particles, and its number of rows."""
    fixes, times, _ = task()
    fixes = fixes[: SLICES.get(name)]
    run = ours(fixes, times, particles=count) if name == "ours" else VERSIONS[name](fixes, times, count)
    return run, fixes[..., 0].size


def task(trajectories: int = TRAJECTORIES, rows: int = ROWS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fixes (n, T, 2), m, times (T,), s, and true positions (n, T, 2), m, of carts on the thesis's line."""
    world = simulate_line("constant", trajectories, seed=20, rest_s=3.0, rate_hz=2.0 * ROWS / 120.0)
    return world.fixes[:, :rows], world.times[:rows], world.positions[:, :rows]


def rmse(estimated: np.ndarray, truth: np.ndarray) -> float:
    """RMSE, m, of positions (n, T, 2) without the first row, where the filters start in different ways."""
    return float(np.sqrt(np.mean(np.sum((estimated - truth)[:, 1:] ** 2, axis=-1))))


def ours(fixes: np.ndarray, times: np.ndarray, chunk: int = CHUNK, particles: int = PARTICLES) -> Run:
    """The tracker `line-pf` without halts; it also computes the covariance and the NIS of every row."""
    tracker = line_tracker(LineMotion(Polyline(THESIS_KNOTS), SIGMA_A), {FIXES: FloorFixes(SIGMA_P, None)}, particles)
    seen = np.ones(fixes.shape[1:], bool)
    batch = stack([Recording(times, {FIXES: Readings(f, seen)}, name=f"trajectory {k}") for k, f in enumerate(fixes)])
    run = filtering(tracker, batch, chunk)
    return lambda: np.concatenate([np.stack([np.asarray(x).T for x in p.mean.position], axis=-1) for p in run()])


def position_at(arclength: Any) -> Any:
    """Positions (…, 2), m, on the line, interpolated between the knots in single precision."""
    marks, knots = MARKS.astype(np.float32), KNOTS.astype(np.float32)
    return jnp.stack([jnp.interp(arclength, marks, knots[:, k]) for k in (0, 1)], axis=-1)


def textbook(fixes: np.ndarray, times: np.ndarray, count: int) -> Run:
    """The filter as usually written: a scan over one trajectory, `vmap` over trajectories."""
    end, dt = MARKS.astype(np.float32)[-1], np.float32(times[1] - times[0])

    def step(carry: Any, row: Any) -> tuple[Any, Any]:
        key, d, speed, weights = carry
        key, noise, offset = jax.random.split(key, 3)
        cumulative = jnp.cumsum(weights)
        points = (jnp.arange(count) + jax.random.uniform(offset)) / count * cumulative[-1]
        ancestors = jnp.minimum(jnp.searchsorted(cumulative, points), count - 1)
        resample = 1.0 / jnp.sum(weights**2) < 0.5 * count
        d, speed = jnp.where(resample, d[ancestors], d), jnp.where(resample, speed[ancestors], speed)
        weights = jnp.where(resample, 1.0 / count, weights)
        d = jnp.clip(d + dt * speed, 0.0, end)
        speed = jnp.maximum(speed + SIGMA_A * jnp.sqrt(dt) * jax.random.normal(noise, (count,)), 0.0)
        square = jnp.sum((row - position_at(d)) ** 2, axis=-1) / SIGMA_P**2
        log_weights = jnp.log(weights) - 0.5 * square
        top = jnp.max(log_weights)
        weights = jnp.exp(log_weights - top)
        total = jnp.sum(weights)
        weights = weights / total
        log_evidence = top + jnp.log(total) - jnp.log(2 * jnp.pi * SIGMA_P**2)
        return (key, d, speed, weights), (position_at(jnp.sum(weights * d)), log_evidence)

    def one(key: Any, rows: Any) -> Any:
        key, start, pace = jax.random.split(key, 3)
        d = jnp.maximum(0.5 * jax.random.normal(start, (count,)), 0.0)
        speed = jnp.maximum(0.1 * jax.random.normal(pace, (count,)), 0.0)
        weights = jnp.full(count, 1.0 / count)
        positions, log_evidence = jax.lax.scan(step, (key, d, speed, weights), rows[1:])[1]
        return jnp.concatenate([position_at(jnp.mean(d))[None], positions]), jnp.sum(log_evidence)

    filtered = jax.jit(jax.vmap(one))
    keys, rows = jax.random.split(jax.random.key(0), len(fixes)), jnp.asarray(fixes, jnp.float32)
    return lambda: np.asarray(jax.block_until_ready(filtered(keys, rows))[0])


def with_particles(fixes: np.ndarray, times: np.ndarray, count: int) -> Run:
    """`particles.SMC` on a NumPy model, collecting moments."""
    import particles
    from particles.collectors import Moments

    random, dt = np.random.default_rng(0), float(times[1] - times[0])

    class Line(particles.FeynmanKac):
        """Motion along the line and fixes (T, 2), m, of one cart; states (N, 2): arclength, m, and speed, m/s."""

        def __init__(self, fixes: np.ndarray):
            super().__init__(len(fixes))
            self.fixes = fixes

        def M0(self, N: int) -> np.ndarray:
            return np.maximum(random.standard_normal((N, 2)) * [0.5, 0.1], 0.0)

        def M(self, t: int, xp: np.ndarray) -> np.ndarray:
            x = np.empty_like(xp)
            x[:, 0] = np.clip(xp[:, 0] + dt * xp[:, 1], 0.0, MARKS[-1])
            x[:, 1] = np.maximum(xp[:, 1] + SIGMA_A * dt**0.5 * random.standard_normal(len(xp)), 0.0)
            return x

        def logG(self, t: int, xp: np.ndarray, x: np.ndarray) -> np.ndarray:
            if t == 0:
                return np.zeros(len(x))
            east = np.interp(x[:, 0], MARKS, KNOTS[:, 0]) - self.fixes[t, 0]
            north = np.interp(x[:, 0], MARKS, KNOTS[:, 1]) - self.fixes[t, 1]
            return (east * east + north * north) * (-0.5 / SIGMA_P**2) - np.log(2 * np.pi * SIGMA_P**2)

    def run() -> np.ndarray:
        along = np.empty(fixes.shape[:2])
        for trajectory, rows in enumerate(fixes):
            smc = particles.SMC(fk=Line(rows), N=count, resampling="systematic", ESSrmin=0.5, collect=[Moments()])
            smc.run()
            along[trajectory] = [moments["mean"][0] for moments in smc.summaries.moments]
        return np.stack([np.interp(along, MARKS, KNOTS[:, k]) for k in (0, 1)], axis=-1)

    return run


def with_cuthbert(fixes: np.ndarray, times: np.ndarray, count: int) -> Run:
    """cuthbert's particle filter under `jit` and `vmap`."""
    import cuthbert
    from cuthbert.smc.particle_filter import build_filter
    from cuthbertlib.resampling.adaptive import ess_decorator
    from cuthbertlib.resampling.systematic import resampling

    end, dt = MARKS.astype(np.float32)[-1], float(times[1] - times[0])

    def start(key: Any) -> Any:
        return jnp.maximum(jax.random.normal(key, (2,)) * jnp.array([0.5, 0.1]), 0.0)

    def step(key: Any, state: Any, fix: Any) -> Any:
        speed = jnp.maximum(state[1] + SIGMA_A * dt**0.5 * jax.random.normal(key), 0.0)
        return jnp.stack([jnp.clip(state[0] + dt * state[1], 0.0, end), speed])

    def density(before: Any, state: Any, fix: Any) -> Any:
        return -0.5 * jnp.sum((fix - position_at(state[0])) ** 2) / SIGMA_P**2 - jnp.log(2 * jnp.pi * SIGMA_P**2)

    smc = build_filter(start, step, density, count, ess_decorator(resampling, 0.5))

    def one(key: Any, rows: Any) -> Any:
        first, rest = jax.random.split(key)
        states = cuthbert.filter(smc, rows[1:], smc.init_prepare(key=first), key=rest)
        weights = jax.nn.softmax(states.log_weights, axis=-1)
        return position_at(jnp.sum(weights * states.particles[..., 0], axis=-1))

    filtered = jax.jit(jax.vmap(one))
    keys, rows = jax.random.split(jax.random.key(0), len(fixes)), jnp.asarray(fixes, jnp.float32)
    return lambda: np.asarray(jax.block_until_ready(filtered(keys, rows)))


VERSIONS: dict[str, Callable[[np.ndarray, np.ndarray, int], Run]] = {
    "textbook": textbook,
    "particles": with_particles,
    "cuthbert": with_cuthbert,
}
