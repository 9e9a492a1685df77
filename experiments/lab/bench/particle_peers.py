"""The particle filter on a line beside `particles` and cuthbert: `python -m experiments.lab.bench.particle_peers`.

All filter fixes of the same carts with the motion, particles, resampling and start of the textbook version in
`experiments/lab/bench/particles.py`. Each library runs in its own process and takes turns with ours: `particles` one
trajectory after the other on NumPy, cuthbert under `vmap`, with the flags of the command line. Both are extra
dependencies (`pip install trackwright[peers]`).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.__main__ import machine
from experiments.lab.bench.particles import PARTICLES, SIGMA_A, SIGMA_P, arclengths, ours, position_on, rmse, task
from experiments.lab.bench.timing import clocked, turns, write_json
from experiments.lab.subprocesses import in_new_process_or_failed

SLICES = {"particles": 4, "cuthbert": 32}
"""Trajectories for the peers, which are dozens of times slower; cuthbert stores every particle of every row."""

ROUNDS = 5
LIMIT_S = 300.0
FLOOR = 25.0
"""Required speed-up over the peers."""


def main(*, out: Path = Path("out/bench-particles.json")) -> int:
    """Measure beside both libraries, print the results and write them as JSON; 1 if the speed-up is too small.

    Args:
        out: the JSON file to write.
    """
    began, host = datetime.now(UTC), machine()
    module = "experiments.lab.bench.particle_peers"
    peers = {peer: in_new_process_or_failed(module, "beside", (peer,), LIMIT_S) for peer in SLICES}
    results = {
        "date": began.isoformat(timespec="seconds"),
        "command": ["python", "-m", "experiments.lab.bench.particle_peers"],
        "machine": host,
        "particles": PARTICLES,
        "peers": peers,
        "took_s": (datetime.now(UTC) - began).total_seconds(),
    }
    write_json(out, results)
    slowest = np.inf
    for peer, found in peers.items():
        if "failed" in found:
            print(f"{peer}: left out: {found['failed']}")
            continue
        for name, v in found["versions"].items():
            print(
                f"{name:10s} {v['trajectories']:4d} x {v['rows']}  {v['run_s']:7.3f} s  "
                f"{v['million_steps_per_s']:8.5f} million trajectory-steps/s  first call {v['first_s']:5.1f} s  "
                f"RMSE {v['rmse_m']:.3f} m"
            )
        faster = found["ours_is_faster_by"]
        slowest = min(slowest, faster)
        print(
            f"ours is {faster:.0f} times as fast, {found['ours_is_faster_by_per_cpu_second']:.0f} per processor second"
        )
    print(f"floor {FLOOR:g}. Written: {out}")
    return int(slowest < FLOOR)


def beside(peer: str) -> dict[str, Any]:
    """Ours and a peer's filter, taking turns in this process: medians over rounds, ratios within rounds."""
    set_flags()
    from sim.line import THESIS_KNOTS

    fixes, times, truth = task()
    few = SLICES[peer]
    build = {"particles": with_particles, "cuthbert": with_cuthbert}[peer]
    versions = {
        "ours": (len(fixes), ours(fixes, times)),
        peer: (few, build(fixes[:few], float(times[1] - times[0]), np.asarray(THESIS_KNOTS, float))),
    }
    found: dict[str, Any] = {}
    for name, (size, run) in versions.items():
        (first, _), estimated = clocked(run)
        found[name] = {
            "trajectories": size,
            "rows": fixes.shape[1],
            "first_s": first,
            "rmse_m": rmse(estimated, truth[:size]),
        }
    seconds = turns([run for _, run in versions.values()], ROUNDS)
    rates = np.array([size * fixes.shape[1] for size, _ in versions.values()])[:, None] / seconds
    for k, name in enumerate(versions):
        found[name]["run_s"] = float(np.median(seconds[:, k, 0]))
        found[name]["cpu_s"] = float(np.median(seconds[:, k, 1]))
        found[name]["million_steps_per_s"] = float(np.median(rates[:, k, 0])) / 1e6
    faster = np.median(rates[:, 0] / rates[:, 1], axis=0)
    return {
        "versions": found,
        "ours_is_faster_by": float(faster[0]),
        "ours_is_faster_by_per_cpu_second": float(faster[1]),
        "packages": {name: version(name) for name in ("jax", "jaxlib", "numpy", peer)},
        "xla_flags": os.environ["XLA_FLAGS"],
    }


def with_particles(fixes: np.ndarray, dt: float, knots: np.ndarray) -> Callable[[], np.ndarray]:
    """A run of `particles.SMC` on a NumPy model, collecting moments; returns positions (n, T, 2), m."""
    import particles
    from particles.collectors import Moments

    random = np.random.default_rng(0)
    marks = arclengths(knots)

    class Line(particles.FeynmanKac):
        """Motion along the line and fixes (T, 2), m, of one cart; states (N, 2): arclength, m, and speed, m/s."""

        def __init__(self, fixes: np.ndarray):
            super().__init__(len(fixes))
            self.fixes = fixes

        def M0(self, N: int) -> np.ndarray:
            return np.maximum(random.standard_normal((N, 2)) * [0.5, 0.1], 0.0)

        def M(self, t: int, xp: np.ndarray) -> np.ndarray:
            x = np.empty_like(xp)
            x[:, 0] = np.clip(xp[:, 0] + dt * xp[:, 1], 0.0, marks[-1])
            x[:, 1] = np.maximum(xp[:, 1] + SIGMA_A * dt**0.5 * random.standard_normal(len(xp)), 0.0)
            return x

        def logG(self, t: int, xp: np.ndarray, x: np.ndarray) -> np.ndarray:
            if t == 0:
                return np.zeros(len(x))
            east = np.interp(x[:, 0], marks, knots[:, 0]) - self.fixes[t, 0]
            north = np.interp(x[:, 0], marks, knots[:, 1]) - self.fixes[t, 1]
            return (east * east + north * north) * (-0.5 / SIGMA_P**2) - np.log(2 * np.pi * SIGMA_P**2)

    def run() -> np.ndarray:
        along = np.empty(fixes.shape[:2])
        for trajectory, rows in enumerate(fixes):
            smc = particles.SMC(fk=Line(rows), N=PARTICLES, resampling="systematic", ESSrmin=0.5, collect=[Moments()])
            smc.run()
            along[trajectory] = [moments["mean"][0] for moments in smc.summaries.moments]
        return np.stack([np.interp(along, marks, knots[:, k]) for k in (0, 1)], axis=-1)

    return run


def with_cuthbert(fixes: np.ndarray, dt: float, knots: np.ndarray) -> Callable[[], np.ndarray]:
    """A run of cuthbert's particle filter under `jit` and `vmap`; returns positions (n, T, 2), m."""
    import cuthbert
    import jax
    import jax.numpy as jnp
    from cuthbert.smc.particle_filter import build_filter
    from cuthbertlib.resampling.adaptive import ess_decorator
    from cuthbertlib.resampling.systematic import resampling

    end, position = arclengths(knots).astype(np.float32)[-1], position_on(knots)

    def start(key: Any) -> Any:
        return jnp.maximum(jax.random.normal(key, (2,)) * jnp.array([0.5, 0.1]), 0.0)

    def step(key: Any, state: Any, fix: Any) -> Any:
        speed = jnp.maximum(state[1] + SIGMA_A * dt**0.5 * jax.random.normal(key), 0.0)
        return jnp.stack([jnp.clip(state[0] + dt * state[1], 0.0, end), speed])

    def density(before: Any, state: Any, fix: Any) -> Any:
        return -0.5 * jnp.sum((fix - position(state[0])) ** 2) / SIGMA_P**2 - jnp.log(2 * jnp.pi * SIGMA_P**2)

    smc = build_filter(start, step, density, PARTICLES, ess_decorator(resampling, 0.5))

    def one(key: Any, rows: Any) -> Any:
        first, rest = jax.random.split(key)
        states = cuthbert.filter(smc, rows[1:], smc.init_prepare(key=first), key=rest)
        weights = jax.nn.softmax(states.log_weights, axis=-1)
        return position(jnp.sum(weights * states.particles[..., 0], axis=-1))

    filtered = jax.jit(jax.vmap(one))
    keys, rows = jax.random.split(jax.random.key(0), len(fixes)), jnp.asarray(fixes, jnp.float32)
    return lambda: np.asarray(jax.block_until_ready(filtered(keys, rows)))


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.particle_peers")
