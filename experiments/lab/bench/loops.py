"""The models of trackers of the catalogue for the textbook filter in NumPy, `benchmark.adapters.plain`.

Motions and sensors have Jacobians derived by hand, in double precision, and the noise of readings is Student's t where
the tracker's is: the estimates are those of the trackers up to rounding. No log-likelihood, track loss or mixture is
computed. With an IMU it is the error-state filter of Solà (2017), chapter 5.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from trackwright.experiments.lab.benchmark.adapters.plain import Channel, Model
from trackwright.trackers.aoa.fusion import BEARINGS, BearingSensor
from trackwright.trackers.core.data.recording import Recording
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.motion import GroundMotion
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import BiasedStart, DriftingBiases
from trackwright.trackers.parts.fixes import FIXES, FixSensor
from trackwright.trackers.parts.ranges import RANGES, RangeSensor
from trackwright.trackers.uwb_imu.strapdown import Inertial, Strapdown
from trackwright.trackers.uwb_imu.yaw_mixture import YawMixtureFilter


def model_of(tracker: Any, recording: Recording, planar: bool) -> Model | None:
    """The model of a tracker for the rows of a recording; None where no loop is written for it."""
    if not (isinstance(tracker, Tracker) and isinstance(tracker.filter, ExtendedKalman | YawMixtureFilter)):
        return None
    sensor, motion = next(iter(tracker.sensors.values())), tracker.motion
    if isinstance(motion, Strapdown) and isinstance(sensor, RangeSensor):
        return inertial(motion, sensor, recording)
    if isinstance(motion, DriftingBiases) and isinstance(sensor, RangeSensor):
        d, start = 2 if planar else 3, tracker.start
        shares = isinstance(start, BiasedStart) and start.sigma_shared is not None
        channels = range_channels(sensor, recording, d, 2 * d, motion.biases)
        return Model(damped(motion, d, int(shares)), channels, np.add, float(sensor.dof.value))
    if isinstance(motion, GroundMotion) and isinstance(sensor, FixSensor):
        dof = 0.0 if sensor.dof is None else float(sensor.dof.value)
        return Model(ground(motion, planar), fix_channels(sensor, recording, planar), np.add, dof)
    if isinstance(motion, DriftingBiases) and isinstance(sensor, BearingSensor):
        channels = bearing_channels(sensor, recording, planar)
        return Model(damped(motion, 2 if planar else 3), channels, np.add, float(sensor.dof.value))
    return None


def state_after(row: int, tracker: Any, estimates: Any) -> tuple[Any, np.ndarray]:
    """State and covariance of a filter after a row of one trajectory, where a loop begins.

    What a latency that is not known adds to a reported covariance, std²(v vᵀ + cov v), is none of the filter's.
    """
    mean = jax.tree_util.tree_map(lambda x: x[row], estimates.mean)
    P = np.asarray(estimates.covariance[row], float)
    sensor = next(iter(tracker.sensors.values()))
    if isinstance(sensor, FixSensor):
        v, std, d = np.array([float(x) for x in mean.velocity]), float(sensor.latency_std.value), len(mean.position)
        of_velocity = P[d : d + len(v), d : d + len(v)]
        P[: len(v), : len(v)] -= std**2 * (np.outer(v, v) + of_velocity)
    return vector(mean), P


def vector(state: Any) -> Any:
    """A tracker's mean as the state of a loop: a vector, or an inertial state with its quaternion apart."""
    if isinstance(state, Inertial):
        q = np.array([float(getattr(state.attitude, name)) for name in "wxyz"])
        parts = [*state.position, *state.velocity, 0.0, 0.0, 0.0, *state.accel_bias, *state.gyro_bias, *state.bias]
        return np.array([float(x) for x in parts]), q
    return np.array([float(x) for field in state for x in field])


def ground(motion: GroundMotion, planar: bool) -> Any:
    """Constant velocity in x and y, and a random walk of the height; x, y, (z), vx, vy."""
    power, drift = float(motion.sigma_a.value) ** 2, float(motion.sigma_z.value) ** 2
    p = 2 if planar else 3
    F, Q = np.eye(p + 2), np.zeros((p + 2, p + 2))

    def moved(x: np.ndarray, P: np.ndarray, row: int, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        for k in (0, 1):
            F[k, p + k] = dt
            Q[k, k], Q[p + k, p + k] = power * dt**3 / 3, power * dt
            Q[k, p + k] = Q[p + k, k] = power * dt**2 / 2
        if not planar:
            Q[2, 2] = drift * dt
        return F @ x, F, Q

    return moved


def damped(motion: DriftingBiases, d: int, shared: int = 0) -> Any:
    """Gauss–Markov velocities and biases; positions, velocities, biases, and constant ones of all channels."""
    sigmas = [float(motion.sigma_a.value)] * 2 + [float(motion.sigma_z.value)] * (d - 2)
    memory, constant = float(motion.memory.value), float(motion.time_constant.value)
    length, n = float(motion.length.value), 2 * d + motion.biases + shared
    sigmas_bias = np.resize(np.asarray(motion.sigma_bias.value, float), motion.biases)
    biases = np.arange(2 * d, n - shared)
    F, Q = np.eye(n), np.zeros((n, n))

    def moved(x: np.ndarray, P: np.ndarray, row: int, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        square, spread = float(x[d : 2 * d] @ x[d : 2 * d]), float(np.trace(P[d : 2 * d, d : 2 * d]))
        speed = max(square - spread, 0.0) / np.sqrt(square) if square > 0 else 0.0
        decay, kept = np.exp(-dt / memory), np.exp(-dt * (1.0 / constant + speed / length))
        loss = 1.0 - decay
        variance = memory**3 * (dt / memory - 2.0 * loss + 0.5 * (1.0 - decay * decay))
        for k, sigma in enumerate(sigmas):
            F[k, d + k], F[d + k, d + k] = memory * loss, decay
            Q[k, k], Q[d + k, d + k] = sigma**2 * variance, sigma**2 * 0.5 * memory * (1.0 - decay * decay)
            Q[k, d + k] = Q[d + k, k] = sigma**2 * 0.5 * (memory * loss) ** 2
        F[biases, biases], Q[biases, biases] = kept, sigmas_bias**2 * (1.0 - kept * kept)
        return F @ x, F, Q

    return moved


def range_channels(
    sensor: RangeSensor, recording: Recording, d: int, biases_at: int, biases: int, levers: np.ndarray | None = None
) -> Any:
    """The range of a row, to its anchor, with the sensor's bias, the anchor's in the state and those after it.

    `d`: coordinates of the position in the state. `levers`: from the body to the tag, of a state with a quaternion.
    """
    readings, inputs = recording.readings[RANGES], recording.inputs
    z, seen, reported = readings.values[:, 0], readings.seen[:, 0], readings.reported
    anchors, numbers = inputs["anchors"][:, :3], inputs["anchor"][:, 0].astype(int)
    height = inputs["height"] if d == 2 else None
    known, skew = np.asarray(sensor.bias.value, float), float(sensor.positive_skew.value)
    variance = float(sensor.sigma_r.value) ** 2

    def channels(state: Any, row: int) -> Iterator[Channel]:
        if not seen[row]:
            return
        x = state[0] if isinstance(state, tuple) else state
        position = x[:3] if height is None else np.array([x[0], x[1], height[row]])
        ray, gradient, number = position - anchors[row], np.zeros(len(x)), numbers[row]
        if levers is not None:
            R = matrix(state[1])
            ray = ray + R @ levers[row, :3]
        distance = np.sqrt(ray @ ray)
        gradient[:d] = (ray / distance)[:d]
        if levers is not None:
            gradient[6:9] = -(ray @ R) @ cross(levers[row, :3]) / distance
        predicted = distance + (known[number] if number < len(known) else 0.0)
        bias = [biases_at + number] if number < biases else []
        for k in (*bias, *range(biases_at + biases, len(x))):
            gradient[k] = 1.0
            predicted += x[k]
        sigma = np.sqrt(variance + (0.0 if reported is None or not reported.size else reported[row, 0]))
        yield z[row] - predicted, gradient, sigma * (skew if z[row] > predicted else 1.0)

    return channels


def fix_channels(sensor: FixSensor, recording: Recording, planar: bool) -> Any:
    """The axes of a row's fix that were seen."""
    readings = recording.readings[FIXES]
    sigmas = [float(sensor.sigma_horizontal.value)] * 2 + [float(sensor.sigma_vertical.value)]
    scale = float(sensor.reported_std_scale.value)

    def channels(x: np.ndarray, row: int) -> Iterator[Channel]:
        for k in range(2 if planar else 3):
            if readings.seen[row, k]:
                gradient = np.zeros(len(x))
                gradient[k] = 1.0
                has = readings.reported is not None and readings.reported.size
                extra = scale**2 * readings.reported[row, k] if has else 0.0  # type: ignore[index]
                yield readings.values[row, k] - x[k], gradient, np.sqrt(sigmas[k] ** 2 + extra)

    return channels


def bearing_channels(sensor: BearingSensor, recording: Recording, planar: bool) -> Any:
    """Azimuth and elevation of a row in its station's axes, without compression, with the biases in the state."""
    readings, inputs = recording.readings[BEARINGS], recording.inputs
    sigmas = float(sensor.sigma_azimuth.value), float(sensor.sigma_elevation.value)
    offsets = np.asarray(sensor.offsets.value, float)
    d = 2 if planar else 3

    def channels(state: np.ndarray, row: int) -> Iterator[Channel]:
        position = np.array([state[0], state[1], inputs["height"][row]]) if planar else state[:3]
        axes = inputs["axes"][row].reshape(3, 3)
        x, y, z = axes @ (position - inputs["origin"][row])
        level = x * x + z * z
        root = np.sqrt(level)
        rows = np.array([[z / level, 0.0, -x / level], [-x * y / root, root, -z * y / root]])
        rows[1] /= level + y * y
        predicted = np.arctan2(x, z), np.arctan2(y, root)
        for k in (0, 1):
            if readings.seen[row, k]:
                bias = 2 * d + 2 * int(inputs["station"][row]) + k
                difference = readings.values[row, k] - predicted[k] - offsets[k] - state[bias]
                gradient = np.zeros(len(state))
                gradient[bias] = 1.0
                gradient[:d] = (rows[k] @ axes)[:d]
                yield difference - 2 * np.pi * np.round(difference / (2 * np.pi)), gradient, sigmas[k]

    return channels


InertialState = tuple[np.ndarray, np.ndarray]
"""Position, velocity, rotation error (zero), biases of accelerometer, gyro and ranges, (n,); quaternion (4,)."""


def inertial(motion: Strapdown, sensor: RangeSensor, recording: Recording) -> Model:
    """The model of an inertial tracker of ranges, whose biases walk."""
    inputs, noise = recording.inputs, motion.noise
    assert noise.sigma_range_walk is not None
    n = 15 + motion.biases
    gravity = np.array([0.0, 0.0, float(motion.gravity.value)])
    arms = inputs.get("arm", np.zeros((len(recording), 3)))
    white = [float(noise.sigma_a.value) ** 2, float(noise.sigma_accel.value) ** 2]
    turn = [float(noise.sigma_turn.value) ** 2, float(noise.sigma_gyro.value) ** 2]
    walks = np.zeros(n - 9)
    walks[:3], walks[3:6] = float(noise.sigma_accel_walk.value) ** 2, float(noise.sigma_gyro_walk.value) ** 2
    walks[6:] = float(noise.sigma_range_walk.value) ** 2
    diagonal = np.arange(n)
    F, Q = np.eye(n), np.zeros((n, n))

    def moved(state: InertialState, P: np.ndarray, row: int, dt: float) -> tuple[InertialState, np.ndarray, np.ndarray]:
        x, q = state
        has_accel, has_gyro = int(inputs["imu"][row, 0] > 0.5), int(inputs["imu"][row, 1] > 0.5)
        rate = has_gyro * (inputs["gyro"][row] - x[12:15])
        force = inputs["accel"][row] - x[9:12]
        R, turned = matrix(q), product(q, exponential(rate * dt))
        # The specific force in the middle of the step.
        middle = force + 0.5 * dt * np.cross(rate, force)
        acceleration = has_accel * (R @ middle - gravity)
        after = x.copy()
        after[:3] += x[3:6] * dt + 0.5 * dt * dt * acceleration
        after[3:6] += acceleration * dt
        F[:3, 3:6] = np.eye(3) * dt
        F[3:6, 6:9] = -has_accel * dt * R @ cross(middle)
        F[3:6, 9:12] = -has_accel * dt * R @ (np.eye(3) + 0.5 * dt * cross(rate))
        F[3:6, 12:15] = has_accel * has_gyro * 0.5 * dt * dt * R @ cross(force)
        F[:3, 6:15] = 0.5 * dt * F[3:6, 6:15]
        back, right = matrix(exponential(-rate * dt)), right_jacobian(rate * dt)
        F[6:9, 6:9], F[6:9, 12:15] = back, -has_gyro * dt * right
        turns = right @ right.T * (turn[has_gyro] * dt)
        if arms[row].any():
            lever = cross(arms[row])
            R_after = matrix(turned)
            after[:3] += (R_after - R) @ arms[row]
            F[:3, 6:9] += R @ lever - R_after @ lever @ back
            F[:3, 12:15] += has_gyro * dt * R_after @ lever @ right
        power = white[has_accel]
        Q[diagonal[:3], diagonal[:3]], Q[diagonal[3:6], diagonal[3:6]] = power * dt**3 / 3, power * dt
        Q[diagonal[:3], diagonal[3:6]] = Q[diagonal[3:6], diagonal[:3]] = power * dt**2 / 2
        Q[6:9, 6:9] = turns
        Q[diagonal[9:], diagonal[9:]] = walks * dt
        if arms[row].any():
            Q[:3, 6:9] = -R_after @ lever @ turns
            Q[6:9, :3] = Q[:3, 6:9].T
            Q[:3, :3] = np.eye(3) * power * dt**3 / 3 + R_after @ lever @ turns @ lever.T @ R_after.T
        return (after, turned / np.sqrt(turned @ turned)), F, Q

    def added(state: InertialState, step: np.ndarray) -> InertialState:
        x, q = state
        after = x + step
        after[6:9] = 0.0
        return after, product(q, exponential(step[6:9]))

    channels = range_channels(sensor, recording, 3, 15, motion.biases, inputs.get("levers"))
    return Model(moved, channels, added, float(sensor.dof.value))


def cross(v: np.ndarray) -> np.ndarray:
    """The matrix of the cross product with v from the left."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def right_jacobian(v: np.ndarray) -> np.ndarray:
    """The right Jacobian of a rotation vector, to second order (Solà 2017, equation 183)."""
    turn = cross(v)
    return np.eye(3) - 0.5 * turn + turn @ turn / 6.0


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The Hamilton product of two quaternions."""
    return np.array(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )


def exponential(v: np.ndarray) -> np.ndarray:
    """The quaternion of a rotation vector."""
    angle = np.sqrt(v @ v)
    half = 0.5 - angle * angle / 48.0 if angle < 1e-4 else np.sin(0.5 * angle) / angle
    return np.array([np.cos(0.5 * angle), *(half * v)])


def matrix(q: np.ndarray) -> np.ndarray:
    """The rotation matrix of a unit quaternion, body to world."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
