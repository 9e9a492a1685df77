"""Bearings-only fusion: position and velocity from the angles of any number of stations, one bearing a row.

Which station a row's bearing comes from stands in the row's inputs (`origin`, `axes`), so that stations may report at
any time and in any order, and recordings from different installations share a tracker and its noise levels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, Vector, total
from trackers.core.motion import GroundMotion, Noise
from trackers.core.rig import Station
from trackers.core.sensor import AbstractSensor, Channel, Reading, Residual, log_peak, placed
from trackers.core.state import wrap
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tracker import Tracker
from trackers.core.tunable import Real, Scale
from trackers.parts.start_nearby import NearbyStart

BEARINGS = "bearings"


class BearingSensor(AbstractSensor):
    """Azimuth and elevation, rad, array frame, of a position as the station of this row sees it.

    Inputs: `origin` (3,) m, `axes` (9,) the array's x, y, z axes in the world, row after row, and `height` m for a
    planar state. `sigma_azimuth`, `sigma_elevation`: rad, beside what the station reports (variance of azimuth,
    covariance, variance of elevation, rad²), whose square root is scaled by `reported_std_scale`. `dof`: degrees of freedom of
    Student's t. `offsets` (2,) rad and `compression` (2,) rad⁻²: arrays pull large angles a towards boresight, as
    a/√(1 + c·a²) + offset; both zero for a calibrated one.
    """

    sigma_azimuth: Noise
    sigma_elevation: Noise
    reported_std_scale: Noise
    dof: Noise
    offsets: Noise
    compression: Noise

    def __init__(self, sigma_azimuth: float, sigma_elevation: float, dof: float):
        self.sigma_azimuth = Scale(sigma_azimuth, "rad")
        self.sigma_elevation = Scale(sigma_elevation, "rad")
        self.reported_std_scale = Scale(1.0)
        self.dof = Scale(dof)
        self.offsets = Real(np.zeros(2), "rad", typical=0.1)
        self.compression = Real(np.zeros(2), "rad^-2", typical=0.1)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Azimuth and elevation."""
        return Channel("azimuth", "rad", True), Channel("elevation", "rad", True)

    def measure(self, view: Any, inputs: Any) -> list[Scalar]:
        axes = [inputs["axes"][k] for k in range(9)]
        ray = Vector.of(p - inputs["origin"][k] for k, p in enumerate(placed(view.position, inputs)))
        x, y, z = (ray.dot(axes[3 * k : 3 * k + 3]) for k in range(3))
        true = jnp.arctan2(x, z), jnp.arctan2(y, jnp.sqrt(x * x + z * z))
        pairs = zip(true, self.compression.value, self.offsets.value, strict=True)
        return [a / jnp.sqrt(jnp.maximum(1.0 + squeeze * a * a, 0.1)) + offset for a, squeeze, offset in pairs]

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """Azimuth first, elevation given azimuth second: whitened by the Cholesky factor of the covariance."""
        azimuth, elevation = (wrap(z - p) for z, p in zip(reading.values, predicted, strict=True))
        saw_azimuth, saw_elevation = reading.seen
        reported = (
            [r * self.reported_std_scale.value**2 for r in reading.reported]
            if len(reading.reported)
            else [0.0, 0.0, 0.0]
        )
        first = jnp.sqrt(self.sigma_azimuth.value**2 + reported[0])
        coupling = jnp.where(saw_azimuth, reported[1] / first, 0.0)
        second = jnp.sqrt(self.sigma_elevation.value**2 + reported[2] - coupling**2)
        whitened = jnp.where(saw_azimuth, azimuth / first, 0.0)
        rest = jnp.where(saw_elevation, (elevation - coupling * whitened) / second, 0.0)
        scales = ((saw_azimuth, first), (saw_elevation, second))
        log_scale = total(jnp.where(s, log_peak(self.dof.value) - jnp.log(sigma), 0.0) for s, sigma in scales)
        nis_dof = total(jnp.where(s, jnp.ones_like(azimuth), 0.0) for s, _ in scales)
        return Residual([whitened, rest], log_scale, nis_dof, dof=self.dof.value)


def bearing_inputs(station: Station) -> np.ndarray:
    """The inputs `origin` and `axes` of a row whose bearing comes from this station, (12,)."""
    return np.concatenate([np.asarray(station.position, float), station.world_from_array().T.ravel()])


def surroundings(stations: Mapping[str, Station]) -> np.ndarray:
    """The middle of where tags can be, (3,) m: the point nearest to the boresights, drawn weakly to the stations."""
    positions = np.array([s.position for s in stations.values()])
    boresights = np.array([s.world_from_array()[:, 2] for s in stations.values()])
    across = np.eye(3) - boresights[:, :, None] * boresights[:, None, :]
    weak = 0.05 * np.eye(3)
    sums = np.einsum("sij,sj->i", across, positions) + weak @ positions.mean(axis=0)
    return np.linalg.solve(across.sum(axis=0) + weak, sums)


def bearing_tracker(
    sigma_a: float = 0.3,
    sigma_z: float = 0.05,
    sigma_azimuth: float = np.deg2rad(8.0),
    sigma_elevation: float = np.deg2rad(12.0),
    dof: float = 4.0,
    planar: bool = False,
) -> Tracker:
    """Position over the floor with velocity, and a drifting height unless it is known (`planar`), from bearings.

    The bearings-only EKF of Will et al. 2020, section 4.2, with Student's t instead of a gate. σa m/s² per √Hz, σz m
    per √s, angles rad.
    """
    sensors = {BEARINGS: BearingSensor(sigma_azimuth, sigma_elevation, dof)}
    # Errors of real bearings last for seconds: a large running NIS is no sign of a lost track there.
    return Tracker(
        GroundMotion(sigma_a, sigma_z),
        sensors,
        NearbyStart(Scale(1.5, "m"), Scale(1.0, "m/s"), planar, 2),
        track_loss=TrackLossPolicy(nis_limit=1e3, max_gap=10.0),
    )
