"""The extended Kalman filter of ranges and an IMU with zero-velocity updates, with the settings of its author.

github.com/ngbui101/bachelorarbeit-uwb-imu-ekf (bachelor thesis, 2025), written anew from its description: positions and
velocities over the floor; accelerations, turned to the world, are the input; the tag is at rest where they are small.
It begins as all estimators do; the thesis begins at the known place.
"""

from __future__ import annotations

import numpy as np

from trackwright.experiments.lab.benchmark.motion import Levels, Path, transition
from trackwright.experiments.lab.benchmark.problems import NotRead, Problem, beginning
from trackwright.experiments.lab.benchmark.readings import gradient, predicted
from trackwright.trackers.recordings.columns import float_column

AT_REST_MPS2 = 0.5
SIGMA_ACCELERATION, SIGMA_RANGE = 0.1, 0.5
REST_VARIANCE = 1e-3
"""Variance of each velocity after a row at rest, m²/s²."""

COLUMNS = ("accel_x_mps2", "accel_y_mps2", "accel_z_mps2", "qw", "qx", "qy", "qz")


def estimate(problem: Problem, levels: Levels) -> Path:
    """The filtered path of a tag at a known height; the levels are the author's.

    Raises NotRead for a recording without accelerations that are free of gravity, or whose height is not known.
    """
    imu = problem.folder.tables.get("imu")
    if imu is None or "qw" not in imu.columns or problem.kind != "ranges" or problem.dimensions != 2:
        raise NotRead(f"{problem.folder.name}: no acceleration without gravity at a known height")
    inertial = np.column_stack([float_column(imu, name) for name in COLUMNS])
    imu_times = float_column(imu, "t_s")
    times = np.concatenate([imu_times, problem.times])
    (x, P), before, results = beginning(problem), problem.times[0], np.empty((len(problem.times), 2))
    covariances = np.empty((len(results), 2, 2))
    resting = False
    for k in np.argsort(times, kind="stable"):
        if times[k] < before:
            continue
        dt, before = times[k] - before, times[k]
        if k < len(imu_times):
            acceleration = _in_world(inertial[k])
            resting = bool(np.linalg.norm(acceleration) < AT_REST_MPS2)
            x, P = _moved(x, P, dt, np.zeros(2) if resting else acceleration[:2])
            if resting:
                x[2:] = 0.0
                P[2, 2] = P[3, 3] = REST_VARIANCE
        else:
            row = k - len(imu_times)
            x, P = _moved(x, P, dt, np.zeros(2))
            x, P = _ranged(problem, row, x, P)
            results[row], covariances[row] = x[:2], P[:2, :2]
    return Path(results, covariances)


def _in_world(row: np.ndarray) -> np.ndarray:
    """The acceleration (3,) in the axes of the sensor's own attitude."""
    a, w, v = row[:3], row[3], row[4:]
    return np.asarray(a + 2.0 * np.cross(v, np.cross(v, a) + w * a))


def _moved(x: np.ndarray, P: np.ndarray, dt: float, acceleration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    F, G = transition(2, dt), np.vstack([0.5 * dt * dt * np.eye(2), dt * np.eye(2)])
    return F @ x + G @ acceleration, F @ P @ F.T + SIGMA_ACCELERATION**2 * G @ G.T


def _ranged(problem: Problem, row: int, x: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    place, z = problem.places(x[:2]), problem.values[row]
    h = np.append(gradient("ranges", place, problem.geometry[row])[0, :2], [0.0, 0.0])
    k = P @ h / (h @ P @ h + SIGMA_RANGE**2)
    expected = predicted("ranges", place, problem.geometry[row], z)
    return x + k * (z - expected)[0], P - np.outer(k, h) @ P
