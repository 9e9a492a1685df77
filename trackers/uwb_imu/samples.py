"""An IMU's samples as inputs of rows, on the host: held from row to row; levelled where it knows its attitude."""

from __future__ import annotations

import numpy as np

HELD_S = 0.2
"""Seconds for which a sample stands for what follows; beyond, there is no IMU."""

RESTING_S = 1.0
"""Seconds in which a body must not have moved to count as at rest."""

STILL_ACCEL, STILL_GYRO = 0.15, 0.02
"""Largest standard deviations at rest, m/s² and rad/s: several times a MEMS sensor's noise, well below a hand's."""


def held_inputs(
    times: np.ndarray, imu_times: np.ndarray, accel: np.ndarray, gyro: np.ndarray, hold: float = HELD_S
) -> dict[str, np.ndarray]:
    """The inputs `accel` (T, 3), `gyro` (T, 3), `imu` (T, 2) and those of the start, for rows at `times` (T,).

    Each row moves by the latest sample not after it. `accel`, `gyro` (n, 3): at `imu_times` (n,), s, sorted, NaN where
    missing. `rest` (T, 7): the mean of both over the last `RESTING_S`, or over the first where the IMU has just begun,
    and 1 where the body was at rest; zeros where nothing was heard.
    """
    inputs = {"imu": np.zeros((len(times), 2))}
    for k, (name, values) in enumerate((("accel", accel), ("gyro", gyro))):
        known = np.isfinite(values).all(axis=1)
        own, samples = imu_times[known], values[known]
        last = np.searchsorted(own, times, side="right") - 1
        fresh = last >= 0
        fresh[fresh] = times[fresh] - own[last[fresh]] <= hold
        inputs["imu"][:, k] = fresh
        inputs[name] = np.where(fresh[:, None], samples[np.maximum(last, 0)] if len(own) else 0.0, 0.0)
    both = np.isfinite(accel).all(axis=1)
    own, pairs = imu_times[both], np.concatenate([accel, np.nan_to_num(gyro)], axis=1)[both]
    inputs["rest"] = _rests(times, own, pairs) if len(own) else np.zeros((len(times), 7))
    return inputs


def _rests(times: np.ndarray, own: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """The input `rest` of `held_inputs`, from running sums."""
    stop = np.searchsorted(own, np.maximum(times, own[0] + RESTING_S), side="right")
    start = np.minimum(np.searchsorted(own, own[stop - 1] - RESTING_S), stop - 1)
    # About the mean of all, or squares of gravity would hide the noise.
    middle = samples.mean(axis=0)
    sums, squares = (
        np.concatenate([np.zeros((1, 6)), np.cumsum((samples - middle) ** power, axis=0)]) for power in (1, 2)
    )
    count = (stop - start)[:, None]
    mean = (sums[stop] - sums[start]) / count
    spread = np.sqrt(np.maximum((squares[stop] - squares[start]) / count - mean**2, 0.0))
    quiet = (spread[:, :3] < STILL_ACCEL).all(axis=1) & (spread[:, 3:] < STILL_GYRO).all(axis=1)
    still = quiet & (own[stop - 1] - own[start] > 0.5 * RESTING_S)
    recent = times - own[stop - 1] <= RESTING_S
    return np.where(recent[:, None], np.concatenate([mean + middle, still[:, None]], axis=1), 0.0)


def levelled(accel: np.ndarray, attitude: np.ndarray, gravity: float) -> tuple[np.ndarray, np.ndarray]:
    """Samples of a sensor that takes gravity out and knows its attitude, as those of one whose case stays level.

    `accel` (n, 3) m/s² without gravity, body axes; `attitude` (n, 4), body to the sensor's own upright world. Returned:
    specific force in that world's axes, and a gyro that reads no turning: what that world turns against the room is
    left to the gyro's noise and bias. NaN stays NaN.
    """
    w, q = np.split(attitude / np.linalg.norm(attitude, axis=1, keepdims=True), [1], axis=1)
    twice = 2.0 * np.cross(q, accel)
    force = accel + w * twice + np.cross(q, twice)
    force[:, 2] += gravity
    return force, np.where(np.isfinite(force), 0.0, np.nan)
