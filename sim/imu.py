"""An IMU on a moving body: ideal measurements along a true path with attitude, and the errors of real ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.sim.corruptions import Corruption, Times, constant_bias, corrupted, random_walk, white_density
from trackwright.sim.keys import Keys, in_blocks, normals, stream, trajectory_keys, uniforms
from trackwright.sim.paths import PathFunction
from trackwright.sim.ranging import (
    WALK,
    Protocol,
    SimulatedDifferences,
    SimulatedRanges,
    round_robin,
    simulate_ranges,
)
from trackwright.sim.tables import AXES, ArrayRows, folder_of
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.model.state import Rotation
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.folder import RecordingFolder

GRAVITY, _WAVES = 9.81, 8
SAMPLES = 3  # of an IMU for each row of ranges

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
    force, rate = _in_body(acceleration + np.array([0.0, 0.0, GRAVITY]), attitudes)
    rate = rate / dt
    return np.concatenate([force[:, :1], force], axis=1), np.concatenate([rate[:, :1], rate], axis=1)


def _in_body(
    force: Float[np.ndarray, "n intervals 3"], attitudes: Attitudes
) -> tuple[Float[np.ndarray, "n intervals 3"], Float[np.ndarray, "n intervals 3"]]:
    """Forces (n, T − 1, 3) rotated from room to body axes half-way between two attitudes, and the rotation vectors."""
    given = (force, attitudes[:, :-1], attitudes[:, 1:])
    with jax.enable_x64(True):
        turned, turn = _in_body_each(*(jnp.asarray(np.asarray(x, np.float64)) for x in given))
        return np.asarray(turned), np.asarray(turn)


@jax.jit
@jax.vmap
@jax.vmap
def _in_body_each(
    force: Float[jax.Array, " 3"], before: Float[jax.Array, " 4"], after: Float[jax.Array, " 4"]
) -> tuple[Float[jax.Array, " 3"], Float[jax.Array, " 3"]]:
    first, second = Rotation(*before), Rotation(*after)
    turn = first.local(second)
    middle = first.retract([0.5 * x for x in turn])
    return middle.inverse().apply(Vector(*force)).array(), jnp.stack(turn)


MEMS_ACCEL: Mapping[str, Corruption] = MappingProxyType(
    {"bias": constant_bias(0.1), "walk": random_walk(0.005), "noise": white_density(0.02)}
)
"""Errors of a low-cost accelerometer, m/s²."""

MEMS_GYRO: Mapping[str, Corruption] = MappingProxyType(
    {"bias": constant_bias(0.01), "walk": random_walk(0.0005), "noise": white_density(0.002)}
)
"""Errors of a low-cost gyroscope, rad/s."""


@dataclass(frozen=True)
class SimulatedUwbImu:
    """Ranges, or range differences, and IMU samples of n bodies with their truth.

    `readings`: those to the anchors, and their times. `times` (S,) s, of the IMU samples; at these times `positions`
    (n, S, 3) m and `attitudes` (n, S, 4), the truth, and `accel`, `gyro` (n, S, 3) m/s² and rad/s, zero where not
    `seen` (n, S).
    """

    readings: SimulatedRanges | SimulatedDifferences
    times: Float[np.ndarray, " S"]
    positions: Float[np.ndarray, "n S 3"]
    seen: Bool[np.ndarray, "n S"]
    accel: Float[np.ndarray, "n S 3"]
    gyro: Float[np.ndarray, "n S 3"]
    attitudes: Float[np.ndarray, "n S 4"]

    @property
    def ids(self) -> Int[np.ndarray, " n"]:
        """The trajectory ids (n,)."""
        return self.readings.ids

    def folder(self, name: str) -> RecordingFolder:
        """The recording folder of the readings, with IMU samples, and truth with attitudes at the samples' times."""
        rig, (tag, row) = self.readings.folder(name).rig, np.nonzero(self.seen)
        accel = {tuple(f"accel_{axis}_mps2" for axis in "xyz"): self.accel[self.seen]}
        gyro = {tuple(f"gyro_{axis}_radps" for axis in "xyz"): self.gyro[self.seen]}
        tables = {
            self.readings.table: self.readings.rows(),
            "truth": ArrayRows.regular(self.times, self.ids, {AXES: self.positions, QUATERNION: self.attitudes}),
            "imu": ArrayRows.of_entries(tag, self.ids, self.times[row], accel | gyro),
        }
        return folder_of(name, tables, rig.tags, anchors=rig.anchors)


def simulate_uwb_imu(
    rig: Rig,
    path: PathFunction = WALK,
    n: int | Sequence[int] | np.ndarray = 1,
    seed: int = 0,
    *,
    rate_hz: float = 40.0,
    n_points: int = 800,
    protocol: Protocol | None = None,
    corruptions: Mapping[str, Corruption] = MappingProxyType({"turn": round_robin()}),
    accel: Mapping[str, Corruption] = MEMS_ACCEL,
    gyro: Mapping[str, Corruption] = MEMS_GYRO,
    gap_s: tuple[float, float] | None = None,
    attitude: Callable[[Keys, Times], Attitudes] = swinging,
) -> SimulatedUwbImu:
    """Tags, each with an IMU, on smooth paths; by default one anchor's range at a time.

    `n`, `rate_hz`, `n_points`, `protocol` and `corruptions` as for `simulate_ranges`. There are `SAMPLES` of
    the IMU per row of ranges. `accel`, `gyro`: corruptions of the IMU by name, in order. `gap_s`: start and end, s, of
    a gap in the IMU's samples. `attitude`: the body's attitudes (n, T, 4) as a function of (keys, times).
    """
    ranges = simulate_ranges(
        rig, path, n, seed, rate_hz=rate_hz, n_points=n_points, protocol=protocol, corruptions=corruptions
    )
    times = np.arange((n_points - 1) * SAMPLES + 1) / (rate_hz * SAMPLES)
    return with_imu(ranges, path, seed, times, accel=accel, gyro=gyro, gap_s=gap_s, attitude=attitude)


def with_imu(
    readings: SimulatedRanges | SimulatedDifferences,
    path: PathFunction,
    seed: int,
    times: Times,
    *,
    accel: Mapping[str, Corruption] = MEMS_ACCEL,
    gyro: Mapping[str, Corruption] = MEMS_GYRO,
    gap_s: tuple[float, float] | None = None,
    attitude: Callable[[Keys, Times], Attitudes] = swinging,
) -> SimulatedUwbImu:
    """The readings of a world with this path and seed as they are, and the samples of an IMU at `times` (S ≥ 3,) s.

    Further arguments as in `simulate_uwb_imu`.
    """
    seen = np.ones((len(readings.ids), len(times)), bool)
    if gap_s is not None:
        seen &= ~((times >= gap_s[0]) & (times < gap_s[1]))

    def sampled(keys: Keys, seen: Bool[np.ndarray, "n T"]) -> dict[str, np.ndarray]:
        positions, attitudes = path(stream(keys, "path"), times), attitude(stream(keys, "attitude"), times)
        force, rate = ideal_readings(times, positions, attitudes)
        all_seen = np.ones(force.shape, bool)
        force, _ = corrupted(accel.items(), stream(keys, "accelerometer"), times, force, all_seen)
        rate, _ = corrupted(gyro.items(), stream(keys, "gyro"), times, rate, all_seen)
        force, rate = (np.where(seen[..., None], x, 0.0) for x in (force, rate))
        return {"positions": positions, "accel": force, "gyro": rate, "attitudes": attitudes}

    arrays = in_blocks(sampled, trajectory_keys(seed, readings.ids), seen, size=32)
    return SimulatedUwbImu(readings, times, seen=seen, **arrays)
