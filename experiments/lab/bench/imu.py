"""The speed of UWB + IMU filters, beside a textbook version and dynamax: `python -m experiments.lab.bench.imu`.

The paper's eight planar states, with an IMU sample and a range to one anchor in every row, and the compile time of the
fifteen-state filter. Each filter runs in its own process, with XLA's default flags and with those of the command line.
dynamax (extra: peers) and the textbook version filter a slice of the rows.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.timing import clocked, write_json
from experiments.lab.subprocesses import in_new_process_or_failed

TRAJECTORIES, ROWS, SLICE = 1024, 2000, (64, 200)
COMPILED = (512, 100)
"""Trajectories and rows of the fifteen-state filter, of which only the compile time matters: one full chunk."""
ONE = (1, 100)
"""The same for one trajectory, whose covariances are matrices."""

STEP_S, SIGMA_R = 0.01, 0.1
ANCHORS = np.array([[0.0, 0.0, 2.0], [10.0, 0.0, 2.0], [10.0, 10.0, 2.0], [0.0, 10.0, 2.0]])
TUNED = ("motion.noise.sigma_accel", "sensors.*.sigma_r")
ROUNDS = 3
LIMIT_S = 400.0
PARTS = (
    "default",
    "command-line",
    "fifteen, default",
    "fifteen, command-line",
    "fifteen of one, command-line",
    "dynamax",
)


def main(*, out: Path = Path("out/bench-imu.json")) -> int:
    """Measure all parts, print the results and write them as JSON; a part that fails is listed with its reason.

    Args:
        out: the JSON file to write.
    """
    results = {name: in_new_process_or_failed("experiments.lab.bench.imu", "part", (name,), LIMIT_S) for name in PARTS}
    write_json(out, results)
    for title, found in results.items():
        print(f"\n{title}, load {os.getloadavg()[0]:.1f}")
        for name, value in found.items():
            print(f"  {name:<44}{value:>10.3f}" if isinstance(value, float) else f"  {name:<44}{value}")
    ours, peer = results["command-line"].get("ours, M rows/s"), results["dynamax"].get("dynamax, M rows/s")
    if ours and peer:
        print(f"\nours with the command line's flags is {ours / peer:.0f} × faster than dynamax")
    print(f"Written: {out}")
    return 0


def part(name: str) -> dict[str, Any]:
    """The results of one of `PARTS`."""
    if not name.endswith("default"):
        set_flags()
    return _dynamax() if name == "dynamax" else _ours(name.partition(",")[0])


def _world(trajectories: int, rows: int) -> dict[str, np.ndarray]:
    """Bodies on circles of 3 m at 1 rad/s: float32 arrays (T, components, B)."""
    rng = np.random.default_rng(0)
    angle = (np.arange(rows) * STEP_S)[:, None] + rng.uniform(0, 2 * np.pi, trajectories)
    position = 5.0 + 3.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    accel = rng.normal(size=(rows, 3, trajectories)) * 0.5 + np.array([-3.0, 0.0, 9.81])[:, None]
    gyro = rng.normal(size=(rows, 3, trajectories)) * 0.05 + np.array([0.0, 0.0, 1.0])[:, None]
    anchors = np.broadcast_to(ANCHORS[np.arange(rows) % 4][:, :, None], (rows, 3, trajectories))
    ranges = np.sqrt(((position - anchors[:, :2]) ** 2).sum(axis=1, keepdims=True) + 1.0)
    velocity = 3.0 * np.stack([-np.sin(angle[0]), np.cos(angle[0])])
    start = np.concatenate([position[0], velocity, np.zeros((2, trajectories)), angle[:1], np.zeros((1, trajectories))])
    made = {"accel": accel, "gyro": gyro, "anchors": anchors, "position": position, "start": start}
    made["ranges"] = ranges + SIGMA_R * rng.normal(size=ranges.shape)
    return {name: np.ascontiguousarray(x, np.float32) for name, x in made.items()}


SPREAD = np.array([0.5, 0.5, 0.3, 0.3, 0.2, 0.2, 0.2, 0.02])
NOISE = (0.05, 0.005, 0.005, 0.0005)


def _ours(which: str) -> dict[str, Any]:
    """Our filter and its gradient, with fifteen states or with eight; with eight also the textbook's."""
    import jax
    import jax.numpy as jnp

    from trackers.core.algebra import Vector, diagonal
    from trackers.core.chunks import CHUNK, as_dtype, chunks, run_chunks
    from trackers.core.filter import Gaussian
    from trackers.core.recording import Batch
    from trackers.core.sensor import Reading
    from trackers.core.start import AbstractStart
    from trackers.core.state import Heading, Rotation
    from trackers.core.track_loss import TrackLossPolicy
    from trackers.core.tracker import Tracker, filter_batch
    from trackers.parts.ranges import RangeSensor
    from trackers.uwb_imu.strapdown import ImuNoise, Inertial, PlanarInertial, PlanarStrapdown, Strapdown
    from tuning.objectives import NegativeLogLikelihood
    from tuning.parameters import flatten, select_parameters
    from tuning.problem import Problem

    class Given(AbstractStart):
        """Start at the first row from the position, velocity and yaw in its inputs."""

        planar: bool

        def can_start(self, row: Any) -> Any:
            return row.valid

        def candidate(self, sensors: Any, row: Any) -> Any:
            return row.inputs["start"]

        def belief(self, candidate: Any, row: Any) -> Gaussian:
            x, zero = [candidate[k] for k in range(8)], candidate[0] * 0.0
            if self.planar:
                state: Any = PlanarInertial(Vector(*x[:2]), Vector(*x[2:4]), Vector(*x[4:6]), Heading(x[6]), x[7])
                return Gaussian(state, diagonal(list(SPREAD**2), zero))
            half, still = x[6] * 0.5, Vector(zero, zero, zero)
            attitude = Rotation(jnp.cos(half), zero, zero, jnp.sin(half))
            state = Inertial(Vector(*x[:2], zero + 1.0), Vector(*x[2:4], zero), attitude, still, still)
            return Gaussian(state, diagonal(list(np.repeat([0.5, 0.3, 0.1, 0.2, 0.02], 3) ** 2), zero))

    def batch_of(world: dict[str, np.ndarray]) -> Batch:
        rows, _, trajectories = world["ranges"].shape
        dt = np.full((rows, trajectories), STEP_S, np.float32)
        dt[0] = 0.0
        flat = np.zeros((rows, 1, trajectories), np.float32)
        inputs = {name: world[name] for name in ("accel", "gyro", "anchors")}
        inputs |= {"imu": np.ones((rows, 2, trajectories), np.float32), "anchor": flat, "height": flat[:, 0] + 1.0}
        inputs["start"] = np.broadcast_to(world["start"], (rows, 8, trajectories))
        reading = Reading(world["ranges"], np.ones(flat.shape, bool), np.zeros((rows, 0, trajectories), np.float32))
        return Batch(
            dt, np.ones(dt.shape, bool), {"ranges": reading}, inputs, {}, np.zeros((2, trajectories), np.uint32)
        )

    def tracker(planar: bool) -> Tracker:
        motion = (PlanarStrapdown if planar else Strapdown)(ImuNoise(*NOISE))
        never = TrackLossPolicy(nis_limit=np.inf, max_gap=np.inf)
        return Tracker(motion, {"ranges": RangeSensor(1, 0, SIGMA_R, 1.0, 1e6, 0.0)}, Given(planar), track_loss=never)

    def measured(name: str, planar: bool, size: tuple[int, int]) -> dict[str, float]:
        world = _world(*size)
        batch, one = batch_of(world), tracker(planar)
        model = as_dtype(one, batch.dt.dtype)
        result, forward = _timed(lambda: run_chunks(filter_batch, [(model, part) for part in chunks(batch, CHUNK)]))
        parameters = select_parameters(one, TUNED)
        problem, vector = Problem(one, [batch], NegativeLogLikelihood(), parameters, CHUNK), flatten(parameters)
        _, gradient = _timed(lambda: problem.evaluate(vector)[:2])
        last = np.concatenate(
            [np.stack([np.asarray(x)[-1] for x in part.mean.position[:2]]) for part in result], axis=1
        )
        rows = size[0] * size[1]
        return {
            f"{name}, compile processor s": forward[0],
            f"{name}, run s": forward[1],
            f"{name}, M rows/s": rows / forward[1] / 1e6,
            f"{name}, gradient of two: compile processor s": gradient[0],
            f"{name}, gradient of two: run s": gradient[1],
            f"{name}, last error m": float(np.sqrt(((last - world["position"][-1]) ** 2).sum(axis=0).mean())),
        }

    if which.startswith("fifteen"):
        return measured("fifteen states", False, ONE if which.endswith("one") else COMPILED)
    found = measured("ours", True, (TRAJECTORIES, ROWS))
    world = _world(*SLICE)
    rows = [jnp.moveaxis(jnp.asarray(world[name]), -1, 0) for name in ("accel", "gyro", "anchors", "ranges")]
    begins = jnp.asarray(world["start"].T)
    run = jax.jit(jax.vmap(_textbook))
    last, seconds = _timed(lambda: run(begins, *rows))
    error = float(np.sqrt(((np.asarray(last)[:, -1, :2] - world["position"][-1].T) ** 2).sum(axis=1).mean()))
    return found | {
        "textbook, compile processor s": seconds[0],
        "textbook, M rows/s": SLICE[0] * SLICE[1] / seconds[1] / 1e6,
        "textbook, last error m": error,
        "ours is faster than the textbook by": found["ours, M rows/s"] * seconds[1] / (SLICE[0] * SLICE[1] / 1e6),
    }


def _move(x: Any, u: Any) -> Any:
    """The paper's mechanisation over one step, flat: position, velocity, accelerometer bias, yaw, gyro bias."""
    import jax.numpy as jnp

    rate = u[5] - x[7]
    c, s = jnp.cos(x[6] + 0.5 * rate * STEP_S), jnp.sin(x[6] + 0.5 * rate * STEP_S)
    accel = jnp.stack([c * (u[0] - x[4]) - s * (u[1] - x[5]), s * (u[0] - x[4]) + c * (u[1] - x[5])])
    position, velocity = x[:2] + x[2:4] * STEP_S + 0.5 * accel * STEP_S**2, x[2:4] + accel * STEP_S
    return jnp.concatenate([position, velocity, x[4:6], jnp.stack([x[6] + rate * STEP_S, x[7]])])


def _range(x: Any, u: Any) -> Any:
    """The distance (1,) to the row's anchor, at a height of 1 m."""
    import jax.numpy as jnp

    return jnp.sqrt(jnp.sum((x[:2] - u[6:8]) ** 2) + (1.0 - u[8]) ** 2)[None]


def _process_noise() -> np.ndarray:
    accel, gyro, accel_walk, gyro_walk = NOISE
    Q = np.diag([accel**2 * STEP_S**3 / 3] * 2 + [accel**2 * STEP_S] * 2 + [accel_walk**2 * STEP_S] * 2
                + [gyro**2 * STEP_S, gyro_walk**2 * STEP_S])  # fmt: skip
    for k in range(2):
        Q[k, k + 2] = Q[k + 2, k] = accel**2 * STEP_S**2 / 2
    return Q.astype(np.float32)


def _textbook(start: Any, accel: Any, gyro: Any, anchors: Any, ranges: Any) -> Any:
    """Means (T, 8) of one trajectory, with dense matrices, `jacfwd` and the Joseph form."""
    import jax
    import jax.numpy as jnp

    Q, eye = jnp.asarray(_process_noise()), jnp.eye(8, dtype=jnp.float32)

    def step(carry: Any, row: Any) -> Any:
        (x, P), (u, z, first) = carry, row
        F = jax.jacfwd(_move)(x, u)
        x, P = jnp.where(first, x, _move(x, u)), jnp.where(first, P, F @ P @ F.T + Q)
        H = jax.jacfwd(_range)(x, u)
        K = P @ H.T / (H @ P @ H.T + SIGMA_R**2)
        x, rest = x + K @ (z - _range(x, u)), eye - K @ H
        P = rest @ P @ rest.T + SIGMA_R**2 * K @ K.T
        return (x, P), (x, P)

    rows = jnp.concatenate([accel, gyro, anchors], axis=1), ranges, jnp.arange(len(ranges)) == 0
    return jax.lax.scan(step, (start, jnp.diag(jnp.asarray(SPREAD**2, jnp.float32))), rows)[1][0]


def _dynamax() -> dict[str, Any]:
    """dynamax's `extended_kalman_filter` under `vmap`, on the slice; it updates before it predicts."""
    import jax
    import jax.numpy as jnp
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

    def one(start: Any, accel: Any, gyro: Any, anchors: Any, ranges: Any) -> Any:
        # The IMU sample that leads to a row moves the state of the row before.
        moves = jnp.concatenate([jnp.roll(jnp.concatenate([accel, gyro], axis=1), -1, axis=0), anchors], axis=1)
        parameters = ParamsNLGSSM(
            initial_mean=start,
            initial_covariance=jnp.diag(jnp.asarray(SPREAD**2, jnp.float32)),
            dynamics_function=_move,
            dynamics_covariance=jnp.asarray(_process_noise()),
            emission_function=_range,
            emission_covariance=jnp.eye(1, dtype=jnp.float32) * SIGMA_R**2,
        )
        posterior = extended_kalman_filter(parameters, ranges, inputs=moves)
        return posterior.filtered_means, posterior.filtered_covariances

    world = _world(*SLICE)
    rows = [jnp.moveaxis(jnp.asarray(world[name]), -1, 0) for name in ("accel", "gyro", "anchors", "ranges")]
    run, begins = jax.jit(jax.vmap(one)), jnp.asarray(world["start"].T)
    last, seconds = _timed(lambda: run(begins, *rows))
    error = np.sqrt(((np.asarray(last[0])[:, -1, :2] - world["position"][-1].T) ** 2).sum(axis=1).mean())
    speed = SLICE[0] * SLICE[1] / seconds[1] / 1e6
    return {
        "dynamax, compile processor s": seconds[0],
        "dynamax, M rows/s": speed,
        "dynamax, last error m": float(error),
    }


def _timed(run: Callable[[], Any]) -> tuple[Any, tuple[float, float]]:
    """Result of `run`, extra processor seconds of its first call (it compiles), median seconds of the others."""
    import jax

    seconds, processor = [], []
    result = None
    for _ in range(ROUNDS + 1):
        # Free the previous estimates, which take gigabytes, before the next run.
        result = None
        (wall, used), result = clocked(lambda: jax.block_until_ready(run()))
        seconds.append(wall)
        processor.append(used)
    return result, (processor[0] - float(np.median(processor[1:])), float(np.median(seconds[1:])))


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.imu")
