"""An IMU on a moving body: ideal measurements along a true path with attitude, and the errors of real ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from trackwright.sim.corruptions import Corruption, Times, constant_bias, corrupted, random_walk, white_density
from trackwright.sim.keys import Keys, normals, stream, uniforms
from trackwright.sim.tables import AXES, AbstractDraw, AbstractRigDraw, ArrayRows, SimulatedWorld, by_name, static
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.state import Rotation
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.folder import RecordingFolder

GRAVITY, _WAVES = 9.81, 8

Vectors = Float[np.ndarray, "n T 3"]
Attitudes = Float[np.ndarray, "n T 4"]


def swinging(keys: Keys, times: Times) -> Attitudes:
    """Attitudes (n, T, 4), w x y z, body to room, of a hand-held body: smooth random yaw, pitch and roll.

    Standard deviations are 1.5 rad of the yaw about its random mean, 0.15 rad of pitch and roll; the shortest period of
    the oscillations is 6 s.
    """
    omega = 2 * np.pi / 6.0 * (np.arange(_WAVES) + 0.5) / _WAVES
    t = np.asarray(times, float)
    waves = np.concatenate([np.cos(t[:, None] * omega), np.sin(t[:, None] * omega)], axis=1)
    weights = normals(stream(keys, "swinging"), (2 * _WAVES, 3)).astype(float) / np.sqrt(_WAVES)
    yaw, pitch, roll = np.moveaxis(np.matmul(waves, weights) * [1.5, 0.15, 0.15], -1, 0)
    yaw = yaw + 2 * np.pi * normals(stream(keys, "yaw"), (1,)).astype(float)
    (cy, cp, cr), (sy, sp, sr) = ([f(angle / 2) for angle in (yaw, pitch, roll)] for f in (np.cos, np.sin))
    quaternion = (
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    )
    return np.stack(quaternion, axis=-1)


def level(keys: Keys, times: Times) -> Attitudes:
    """Attitudes (n, T, 4) of a level body with a random, constant yaw."""
    half = np.pi * uniforms(stream(keys, "yaw"), (1,)).astype(float) + 0.0 * np.asarray(times, float)
    nothing = np.zeros_like(half)
    return np.stack([np.cos(half), nothing, nothing, np.sin(half)], axis=-1)


def ideal_readings(times: Times, positions: Vectors, attitudes: Attitudes) -> tuple[Vectors, Vectors]:
    """Specific force (n, T, 3), m/s², and angular rate (n, T, 3), rad/s, in body axes, from path and attitudes.

    Each sample is the mean over the interval before its time, as of an IMU's own filter; the first repeats the second.
    """
    dt = np.diff(times)[:, None]
    between = np.diff(positions, axis=1) / dt
    # The velocity at a time is the mean over the adjacent intervals; at both ends, from a parabola.
    middle = 0.5 * (between[:, 1:] + between[:, :-1])
    ends = 1.5 * between[:, [0, -1]] - 0.5 * middle[:, [0, -1]]
    velocity = np.concatenate([ends[:, :1], middle, ends[:, 1:]], axis=1)
    acceleration = np.diff(velocity, axis=1) / dt
    with jax.enable_x64(True):
        both = _in_body(np.asarray(acceleration + np.array([0.0, 0.0, GRAVITY]), float), np.asarray(attitudes, float))
        force, rate = (np.asarray(x) for x in both)
    rate = rate / dt
    return np.concatenate([force[:, :1], force], axis=1), np.concatenate([rate[:, :1], rate], axis=1)


@jax.jit
def _in_body(
    force: Float[jax.Array, "n intervals 3"], attitudes: Float[jax.Array, "n T 4"]
) -> tuple[Float[jax.Array, "n intervals 3"], Float[jax.Array, "n intervals 3"]]:
    """Forces (n, T − 1, 3) rotated from room to body axes half-way between two attitudes, and the rotation vectors."""
    first, second = (Rotation(*jnp.moveaxis(x, -1, 0)) for x in (attitudes[:, :-1], attitudes[:, 1:]))
    turn = first.local(second)
    middle = first.retract([0.5 * x for x in turn])
    forces = middle.inverse().apply(Vector(*jnp.moveaxis(force, -1, 0)))
    return jnp.stack([*forces], axis=-1), jnp.stack([*turn], axis=-1)


MEMS_ACCEL = MappingProxyType({"bias": constant_bias(0.1), "walk": random_walk(0.005), "noise": white_density(0.02)})
"""Errors of a low-cost accelerometer, m/s²."""

MEMS_GYRO = MappingProxyType({"bias": constant_bias(0.01), "walk": random_walk(0.0005), "noise": white_density(0.002)})
"""Errors of a low-cost gyroscope, rad/s."""


class ImuDraw(AbstractDraw):
    """The ranges, or range differences, of a draw as they are, beside the samples of an IMU, in NumPy alone.

    `imu_hz`: samples per second, by default three times as many as rows of the draw. `accel`, `gyro`: corruptions of
    the IMU by name, in order. `gap_s`: start and end, s, of a gap in its samples. `attitude`: the body's attitudes (n,
    S, 4) as a function of (keys, times). Its arrays: those of the draw; at its `times` (S,), those of the samples,
    `positions` (n, S, 3) m and `attitudes` (n, S, 4), the truth, and `accel`, `gyro` (n, S, 3) m/s² and rad/s.
    """

    readings: AbstractRigDraw
    accel: Mapping[str, Corruption] = by_name(default_factory=lambda: MEMS_ACCEL)
    gyro: Mapping[str, Corruption] = by_name(default_factory=lambda: MEMS_GYRO)
    gap_s: tuple[float, float] | None = static(default=None)
    attitude: Callable[[Keys, Times], Attitudes] = static(default=swinging)
    imu_hz: float | None = static(default=None)

    size = 32

    @property
    def times(self) -> Times:
        of, rate = self.readings, self.imu_hz or 3 * self.readings.rate_hz
        last = 3 * (of.n_points - 1) if self.imu_hz is None else math.ceil(of.times[-1] * rate)
        return np.arange(max(3, last + 1)) / rate

    def arrays(self, keys: Keys) -> dict[str, Any]:
        times = self.times
        positions = self.readings.positions(keys, times)
        attitudes = self.attitude(stream(keys, "attitude"), times)
        force, rate = ideal_readings(times, positions, attitudes)
        force, _ = corrupted(self.accel, stream(keys, "accelerometer"), times, force)
        rate, _ = corrupted(self.gyro, stream(keys, "gyro"), times, rate)
        return self.readings(keys) | {"positions": positions, "attitudes": attitudes, "accel": force, "gyro": rate}

    def folder(self, world: SimulatedWorld) -> RecordingFolder:
        """The folder of the readings, with IMU samples, and truth with attitudes at the samples' times."""
        start, end = self.gap_s or (np.inf, np.inf)
        kept = np.broadcast_to((world.times < start) | (world.times >= end), world.accel.shape[:2])
        columns = {tuple(f"accel_{axis}_mps2" for axis in "xyz"): world.accel}
        columns |= {tuple(f"gyro_{axis}_radps" for axis in "xyz"): world.gyro}
        truth = ArrayRows(world.times, world.ids, {AXES: world.positions, QUATERNION: world.attitudes})
        return self.readings.folder(world, truth=truth, imu=ArrayRows(world.times, world.ids, columns, kept))
