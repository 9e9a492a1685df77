"""The fifteen-state error-state filter of ranges and an IMU as a plain NumPy loop (Solà 2017, chapter 5)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from trackers.core.recording import Recording
from trackers.parts.ranges import RANGES, RangeSensor
from trackers.uwb_imu.strapdown import Strapdown

InertialState = tuple[np.ndarray, np.ndarray]
"""Position, velocity, rotation error (zero), biases of accelerometer, gyro and ranges, (n,); quaternion (4,)."""


def inertial(motion: Strapdown, sensor: RangeSensor, recording: Recording) -> tuple[Any, Any, Any, float]:
    """`moved`, `channels`, `added` and `dof` of a `Model`, for the fields of an inertial tracker."""
    inputs, noise = recording.inputs, motion.noise
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

    return moved, channels_of(sensor, recording), added, float(sensor.dof.value)


def channels_of(sensor: RangeSensor, recording: Recording) -> Any:
    """The range of a row, from the tag at its lever arm to its anchor."""
    readings, inputs = recording.readings[RANGES], recording.inputs
    known, skew = np.asarray(sensor.bias.value, float), float(sensor.positive_skew.value)
    variance, reported = float(sensor.sigma_r.value) ** 2, readings.reported
    numbers = inputs["anchor"][:, 0].astype(int)

    def channels(state: InertialState, row: int) -> Iterator[tuple[float, np.ndarray, float]]:
        if not readings.seen[row, 0]:
            return
        x, q = state
        gradient, number = np.zeros(len(x)), numbers[row]
        ray = x[:3] - inputs["anchors"][row, :3]
        if "levers" in inputs:
            lever, R = inputs["levers"][row, :3], matrix(q)
            ray = ray + R @ lever
            gradient[6:9] = -(ray @ R) @ cross(lever)
        distance = np.sqrt(ray @ ray)
        gradient[6:9] /= distance
        gradient[:3] = ray / distance
        predicted = distance + (known[number] if number < len(known) else 0.0)
        if 15 + number < len(x):
            gradient[15 + number] = 1.0
            predicted += x[15 + number]
        z = readings.values[row, 0]
        sigma = np.sqrt(variance + (0.0 if reported is None or not reported.size else reported[row, 0]))
        yield z - predicted, gradient, sigma * (skew if z > predicted else 1.0)

    return channels


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
