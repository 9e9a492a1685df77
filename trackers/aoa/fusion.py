"""Positions in space from angle-of-arrival stations: from their bearings, or straight from their phases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackers.aoa.beam import diagonal
from trackers.aoa.beamformer import Grid, delay_and_sum, strongest
from trackers.aoa.phases import SphericalPhases, placed
from trackers.core.algebra import Scalar, Vector, total
from trackers.core.ekf import Gaussian
from trackers.core.motion import ConstantVelocity, GroundMotion, Kinematic, Noise
from trackers.core.rig import Station
from trackers.core.sensor import LOG_2PI, AbstractSensor, Channel, Reading, Residual
from trackers.core.state import wrap
from trackers.core.tracker import AbstractStart, LossPolicy, Row, Tracker
from trackers.core.tunable import Real, Scale


class BearingSensor(AbstractSensor):
    """Azimuth and elevation of a position as one station sees it, rad, array frame.

    `sigma_azimuth`, `sigma_elevation`: rad, beside what the station reports of its own covariance (three numbers per
    row: variance of azimuth, covariance, variance of elevation, rad²), whose square root is scaled by `trust`.
    """

    sigma_azimuth: Noise
    sigma_elevation: Noise
    trust: Noise
    tail: Noise
    offsets: Noise
    compression: Noise
    origin: Any
    array_from_world: Any

    def __init__(self, station: Station, sigma_azimuth: float, sigma_elevation: float, tail: float = 4.0):
        self.sigma_azimuth = Scale(sigma_azimuth, "rad")
        self.sigma_elevation = Scale(sigma_elevation, "rad")
        self.trust = Scale(1.0)
        self.tail = Scale(tail)
        self.offsets = Real(np.zeros(2), "rad", typical=0.1)
        self.compression = Real(np.zeros(2), "rad^-2", typical=0.1)
        self.origin = np.asarray(station.position, float)
        self.array_from_world = station.world_from_array().T

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Azimuth and elevation."""
        return Channel("azimuth", "rad", True), Channel("elevation", "rad", True)

    def measure(self, view: Any, inputs: Any) -> list[Scalar]:
        x, y, z = in_array(self, placed(view.position, inputs))
        true = jnp.arctan2(x, z), jnp.arctan2(y, jnp.sqrt(x * x + z * z))
        pairs = zip(true, self.offsets.value, self.compression.value, strict=True)
        return [angle / jnp.sqrt(jnp.maximum(1.0 + squeeze * angle * angle, 0.1)) + offset for angle, offset, squeeze in pairs]

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """Azimuth first, elevation given azimuth second: whitened by the Cholesky factor of the covariance."""
        azimuth, elevation = (wrap(z - p) for z, p in zip(reading.values, predicted, strict=True))
        saw_azimuth, saw_elevation = reading.seen
        reported = [r * self.trust.value**2 for r in reading.reported] if len(reading.reported) else [0.0, 0.0, 0.0]
        first = jnp.sqrt(self.sigma_azimuth.value**2 + reported[0])
        coupling = jnp.where(saw_azimuth, reported[1] / first, 0.0)
        second = jnp.sqrt(self.sigma_elevation.value**2 + reported[2] - coupling**2)
        whitened = jnp.where(saw_azimuth, azimuth / first, 0.0)
        rest = jnp.where(saw_elevation, (elevation - coupling * whitened) / second, 0.0)
        scales = ((saw_azimuth, first), (saw_elevation, second))
        log_scale = total(jnp.where(s, -0.5 * LOG_2PI - jnp.log(sigma), 0.0) for s, sigma in scales)
        return Residual([whitened, rest], log_scale, total(jnp.where(s, 1.0, 0.0) for s, _ in scales), tail=self.tail.value)


def in_array(sensor: Any, world: Vector) -> Vector:
    """A world position, m, in the array frame of the station that a sensor describes."""
    ray = Vector.of(p - o for p, o in zip(world, sensor.origin, strict=True))
    return Vector.of(ray.dot(row) for row in sensor.array_from_world)


class RayStart(AbstractStart):
    """The point nearest to the rays of a row's bearings, held near the stations' surroundings where rays are few.

    `centre`: (3,) m, the middle of where tags can be; `sigma_position`: m, how far from it; `sigma_velocity`: m/s.
    `grids`: by station, where rays come from phases by delay-and-sum; empty where stations give angles. `planar`: the
    state has two dimensions and the row's inputs hold the height.
    """

    centre: Any
    sigma_position: Noise
    sigma_velocity: Noise
    grids: Mapping[str, Grid]
    planar: bool = eqx.field(static=True)
    velocities: int = eqx.field(static=True)
    stations: int = eqx.field(static=True, default=1)

    def ready(self, row: Row) -> Scalar:
        enough = [jnp.sum(r.seen) >= (3 if self.grids else 2) for r in row.readings.values()]
        return total(jnp.where(e, 1, 0) for e in enough) >= self.stations

    def acquire(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        eye = jnp.eye(3, dtype=row.dt.dtype)
        centre = jnp.asarray(self.centre)
        information = eye * 1e-2
        if self.planar:
            centre = centre.at[2].set(row.inputs["height"])
            information = information.at[2, 2].set(1e6)
        sums = information @ centre
        for name, sensor in sensors.items():
            reading = row.readings[name]
            direction, origin, saw = self._ray(name, sensor, reading)
            across = jnp.where(saw, eye - jnp.outer(direction, direction), 0.0)
            information, sums = information + across, sums + across @ origin
        return jnp.linalg.inv(information) @ sums

    def _ray(self, name: str, sensor: Any, reading: Reading) -> tuple[Any, Any, Any]:
        """Unit direction in world axes, origin, and whether there is one."""
        if name in self.grids:
            calibrated = reading.values - sensor.offsets.value
            azimuth, elevation = strongest(self.grids[name], delay_and_sum(self.grids[name], calibrated, reading.seen))
            saw = jnp.sum(reading.seen) >= 3
        else:
            azimuth, elevation = reading.values
            saw = jnp.all(reading.seen)
        cosine = jnp.cos(elevation)
        u = jnp.stack([jnp.sin(azimuth) * cosine, jnp.sin(elevation), jnp.cos(azimuth) * cosine])
        return sensor.array_from_world.T @ u, jnp.asarray(sensor.origin), saw

    def begin(self, found: Any, row: Row) -> Gaussian:
        n, m = 2 if self.planar else 3, self.velocities
        zero = jnp.zeros_like(found[0])
        position, velocity = self.sigma_position.value**2, self.sigma_velocity.value**2
        state = Kinematic(Vector(*(found[k] for k in range(n))), Vector(*[zero] * m))
        return Gaussian(state, diagonal([position] * n + [velocity] * m, zero))


def surroundings(stations: Mapping[str, Station]) -> tuple[np.ndarray, float]:
    """The middle of where tags can be and a standard deviation from it, m: the stations' rays' nearest point and spread."""
    positions = np.array([s.position for s in stations.values()])
    axes = np.array([s.world_from_array()[:, 2] for s in stations.values()])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = positions.mean(axis=0)
    weak = 0.05 * np.eye(3)
    centre = np.linalg.solve(across.sum(axis=0) + weak, (across @ positions[:, :, None]).sum(axis=0)[:, 0] + weak @ middle)
    return centre, float(np.sqrt(np.mean(np.sum((positions - centre) ** 2, axis=1))))


def bearing_tracker(
    stations: Mapping[str, Station],
    sigma_a: float = 0.5,
    sigma_z: float = 0.1,
    sigma_azimuth: float = np.deg2rad(5.0),
    sigma_elevation: float = np.deg2rad(5.0),
    planar: bool = False,
    loss: LossPolicy | None = None,
) -> Tracker:
    """Position and velocity from bearings of any number of stations (Will et al. 2020, section 4.2, its reference [37])."""
    sensors = {name: BearingSensor(s, sigma_azimuth, sigma_elevation) for name, s in stations.items()}
    centre, spread = surroundings(stations)
    start = RayStart(centre, Scale(spread, "m"), Scale(1.0, "m/s"), {}, planar, 2)
    motion = ConstantVelocity(sigma_a, 2) if planar else GroundMotion(sigma_a, sigma_z)
    return Tracker(motion, sensors, start, loss=loss or LossPolicy())


def direct_tracker(
    stations: Mapping[str, Station],
    sigma_a: float = 2.0,
    sigma_p: float = 0.3,
    span: float = np.deg2rad(45.0),
    planar: bool = False,
    paper_form: bool = False,
    loss: LossPolicy | None = None,
) -> Tracker:
    """Position and velocity in one filter straight from all stations' phases, on spherical waves; σa m/s² per √Hz."""
    sensors = {name: SphericalPhases(s, sigma_p, paper_form) for name, s in stations.items()}
    centre, _ = surroundings(stations)
    grids = {name: Grid.of(s, span) for name, s in stations.items()}
    start = RayStart(centre, Scale(0.3, "m"), Scale(0.5, "m/s"), grids, planar, 2 if planar else 3, stations=min(2, len(stations)))
    return Tracker(ConstantVelocity(sigma_a, 2 if planar else 3), sensors, start, loss=loss or LossPolicy())
