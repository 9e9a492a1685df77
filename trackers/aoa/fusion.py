"""Bearings-only fusion: position and velocity from the angles of any number of stations, one bearing per row.

The station of a row's bearing is given by the row's inputs `origin` and `axes`, so that stations may report at any time
and in any order, and recordings of different installations share a tracker.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from trackers.aoa.calibrated import CALIBRATION, measured_angles
from trackers.core.algebra import Scalar, Vector, total
from trackers.core.inputs import HEIGHT, Input, Inputs
from trackers.core.motion import GroundMotion, Noise
from trackers.core.rig import Station
from trackers.core.sensor import AbstractSensor, Channel, Reading, Residual, position_in_space, student_t_log_peak
from trackers.core.state import wrap
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tracker import Tracker
from trackers.core.tunable import Real, Scale
from trackers.parts.start_nearby import NearbyStart

BEARINGS = "bearings"


ORIGIN = Input(
    "origin", (3,), "m", "the position of the station", "`bearing_recording`, or `bearing_inputs` of the station"
)
"""The input with the position of a row's station."""

AXES = Input(
    "axes",
    (9,),
    "",
    "x, y and z axis of the station's array in world axes",
    "`bearing_recording`, or `bearing_inputs` of the station",
)
"""The input with the orientation of a row's station."""


class BearingSensor(AbstractSensor):
    """Azimuth and elevation, rad, of a position in the array frame of this row's station.

    Inputs: `origin` (3,) m; `axes` (9,), the array's x, y and z axes in world axes; `height` m for a planar state;
    `calibration` (12,) of the station, if given.
    `sigma_azimuth`, `sigma_elevation` rad add to the reported covariance (variance of azimuth, covariance, variance of
    elevation, rad²), whose square root is scaled by `reported_std_scale`. `dof`: degrees of freedom of Student's t.
    `offsets` (2,) rad and `compression` (2,) rad⁻²: arrays compress large angles a to a/√(1 + c·a²) + offset; both zero
    for a calibrated array.
    """

    view_fields: ClassVar[tuple[str, ...]] = ("position",)

    sigma_azimuth: Noise
    sigma_elevation: Noise
    reported_std_scale: Noise
    dof: Noise
    offsets: Noise
    compression: Noise

    def __init__(self, sigma_azimuth: float, sigma_elevation: float, dof: float):
        self.sigma_azimuth = Scale(sigma_azimuth, "rad", "measurement noise")
        self.sigma_elevation = Scale(sigma_elevation, "rad", "measurement noise")
        self.reported_std_scale = Scale(1.0)
        self.dof = Scale(dof)
        self.offsets = Real(np.zeros(2), "rad", typical=0.1)
        self.compression = Real(np.zeros(2), "rad^-2", typical=0.1)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Azimuth and elevation."""
        return Channel("azimuth", "rad", True), Channel("elevation", "rad", True)

    @property
    def inputs(self) -> tuple[Input, ...]:
        return ORIGIN, AXES, HEIGHT, CALIBRATION

    @property
    def reported(self) -> tuple[Channel, ...]:
        """The covariance of azimuth and elevation, upper triangle, rad²."""
        names = ("variance_azimuth", "covariance", "variance_elevation")
        return tuple(Channel(name, "rad^2") for name in names)

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        axes = [inputs["axes"][k] for k in range(9)]
        ray = Vector.of(p - inputs["origin"][k] for k, p in enumerate(position_in_space(view.position, inputs)))
        x, y, z = (ray.dot(axes[3 * k : 3 * k + 3]) for k in range(3))
        angles = jnp.arctan2(x, z), jnp.arctan2(y, jnp.sqrt(x * x + z * z))
        if CALIBRATION.name in inputs:
            angles = measured_angles(angles, inputs[CALIBRATION.name])
        pairs = zip(angles, self.compression.value, self.offsets.value, strict=True)
        return [a / jnp.sqrt(jnp.maximum(1.0 + c * a * a, 0.1)) + offset for a, c, offset in pairs]

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """Azimuth first, elevation given azimuth second: whitened by the Cholesky factor of the covariance."""
        azimuth, elevation = (wrap(z - p) for z, p in zip(reading.values, predicted, strict=True))
        azimuth_seen, elevation_seen = reading.seen
        reported = (
            [r * self.reported_std_scale.value**2 for r in reading.reported]
            if len(reading.reported)
            else [0.0, 0.0, 0.0]
        )
        first = jnp.sqrt(self.sigma_azimuth.value**2 + reported[0])
        coupling = jnp.where(azimuth_seen, reported[1] / first, 0.0)
        second = jnp.sqrt(self.sigma_elevation.value**2 + reported[2] - coupling**2)
        whitened = jnp.where(azimuth_seen, azimuth / first, 0.0)
        second_whitened = jnp.where(elevation_seen, (elevation - coupling * whitened) / second, 0.0)
        scales = ((azimuth_seen, first), (elevation_seen, second))
        log_scale = total(jnp.where(s, student_t_log_peak(self.dof.value) - jnp.log(sigma), 0.0) for s, sigma in scales)
        nis_dof = total(jnp.where(s, jnp.ones_like(azimuth), 0.0) for s, _ in scales)
        return Residual([whitened, second_whitened], log_scale, nis_dof, dof=self.dof.value)


def bearing_inputs(station: Station) -> np.ndarray:
    """The inputs `origin` and `axes` of a row whose bearing comes from this station, (12,)."""
    return np.concatenate([np.asarray(station.position, float), station.world_from_array().T.ravel()])


def region_centre(stations: Mapping[str, Station]) -> np.ndarray:
    """The centre of the region of tags, (3,) m: the point nearest to the boresights, weakly drawn to the stations."""
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
    """Constant velocity in x and y, from bearings; the height is a random walk, or known if `planar`.

    The bearings-only EKF of Will et al. 2020, section 4.2, with Student's t instead of a gate. `sigma_a` m/s² per √Hz,
    `sigma_z` m per √s, angles rad; `dof`: degrees of freedom.
    """
    sensors = {BEARINGS: BearingSensor(sigma_azimuth, sigma_elevation, dof)}
    # Errors of real bearings are correlated over seconds, so a large NIS average is no evidence of track loss.
    return Tracker(
        GroundMotion(sigma_a, sigma_z),
        sensors,
        NearbyStart(Scale(1.5, "m"), Scale(1.0, "m/s"), planar, 2),
        track_loss=TrackLossPolicy(nis_limit=1e3, max_gap=10.0),
    )
