"""Bearings-only fusion: position and velocity from the angles of any number of stations, one bearing per row.

The station of a row's bearing is given by the row's inputs `origin` and `axes`, so that stations may report at any time
and in any order, and recordings of different installations share a tracker.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.errors import is_count, require
from trackwright.trackers.core.model.algebra import Scalar, Vector
from trackwright.trackers.core.model.inputs import HEIGHT, AnyArray, Input, Inputs, Need
from trackwright.trackers.core.model.motion import Noise
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.sensor import (
    AbstractSensor,
    Channel,
    Reading,
    Residual,
    delayed_position,
    position_in_space,
)
from trackwright.trackers.core.model.state import wrap
from trackwright.trackers.core.model.tunable import Real, Scale
from trackwright.trackers.core.run.track_loss import TrackScorePolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import BiasedStart, DriftingBiases
from trackwright.trackers.parts.fixes import correlated
from trackwright.trackers.parts.ranges import bias_in

BEARINGS = "bearings"

_FROM = "`bearing_recording`, or `bearing_inputs` of the station"
ORIGIN = Input("origin", (3,), "m", "the position of the station", _FROM)
AXES = Input("axes", (9,), "", "x, y and z axis of the station's array in world axes", _FROM)
_MEANS, _COUNTED = (
    "the number of the station, from 0, for a view with biases",
    "`bearing_recording`, in the order given",
)
STATION = Input("station", (), "", _MEANS, _COUNTED, Need.IF_GIVEN)
"""The inputs with position, orientation and number of a row's station."""

CALIBRATION = Input(
    "calibration",
    (12,),
    "",
    "offset, gain, cubic and cross term of azimuth and of elevation, and lowest and highest value of each in the fit",
    "`folder.calibrated(calibration)`",
    Need.IF_GIVEN,
)
"""The input with the systematic errors of a row's station."""


def measured_angles(true: Sequence[Scalar], calibration: AnyArray) -> tuple[Scalar, Scalar]:
    """The measured azimuth and elevation, rad, given the true ones; linear beyond the span of the fit.

    The model of `recordings/calibration.py`, for JAX.
    """
    azimuth, elevation = true
    inside = [jnp.clip(a, calibration[8 + 2 * k], calibration[9 + 2 * k]) for k, a in enumerate(true)]

    def measured(k: int, a: Scalar, clipped: Scalar, other: Scalar) -> Scalar:
        offset, gain, cubic, cross = (calibration[4 * k + i] for i in range(4))
        return offset + a * (gain + cross * other) + cubic * clipped * clipped * (3.0 * a - 2.0 * clipped)

    return measured(0, azimuth, inside[0], inside[1]), measured(1, elevation, inside[1], inside[0])


class AbstractBearingSensor(AbstractSensor):
    """Azimuth and elevation, rad, of a position in the array frame of this row's station, with its biases.

    Inputs: `origin` (3,) m; `axes` (9,), the array's x, y and z axes in world axes; `height` m for a planar state;
    `calibration` (12,) of the station, if given.
    `sigma_azimuth`, `sigma_elevation` rad add to the reported covariance (variance of azimuth, covariance, variance of
    elevation, rad²), whose square root is scaled by `reported_std_scale`. `dof`: degrees of freedom of Student's t.
    `offsets` (2,) rad and `compression` (2,) rad⁻²: arrays compress large angles a to a/√(1 + c·a²) + offset; both zero
    for a calibrated array.
    """

    view_fields: ClassVar[tuple[str, ...]] = ("position",)
    curved: ClassVar[bool] = True

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
        return ORIGIN, AXES, STATION, HEIGHT, CALIBRATION

    @property
    def reported(self) -> tuple[Channel, ...]:
        """The covariance of azimuth and elevation, upper triangle, rad²."""
        names = ("variance_azimuth", "covariance", "variance_elevation")
        return tuple(Channel(name, "rad^2") for name in names)

    def angles(self, position: Vector, inputs: Inputs) -> list[Scalar]:
        """Azimuth and elevation of a position, with the calibration of the station or else compressed."""
        axes = [inputs["axes"][k] for k in range(9)]
        ray = Vector.of(p - inputs["origin"][k] for k, p in enumerate(position_in_space(position, inputs)))
        x, y, z = (ray.dot(axes[3 * k : 3 * k + 3]) for k in range(3))
        true = jnp.arctan2(x, z), jnp.arctan2(y, jnp.sqrt(x * x + z * z))
        pairs = zip(true, self.compression.value, strict=True)
        angles = tuple(a / jnp.sqrt(jnp.maximum(1.0 + c * a * a, 0.1)) for a, c in pairs)
        if CALIBRATION.name in inputs:
            angles = measured_angles(true, inputs[CALIBRATION.name])
        return [a + offset for a, offset in zip(angles, self.offsets.value, strict=True)]

    def biases(self, view: Any, inputs: Inputs) -> list[Scalar]:
        """The biases of both angles of the row's station, rad."""
        # A view without biases needs no number of a station.
        first = 2 * inputs[STATION.name] if hasattr(view, "bias") else 0.0
        return [bias_in(view, BEARINGS, first + k) for k in range(2)]

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """Azimuth first, elevation given azimuth second: whitened by the Cholesky factor of the covariance."""
        differences = [wrap(z - p) for z, p in zip(reading.values, predicted, strict=True)]
        scale, reported = self.reported_std_scale.value**2, reading.reported
        azimuth, both, elevation = (r * scale for r in reported) if len(reported) else (0.0, 0.0, 0.0)
        variances = self.sigma_azimuth.value**2 + azimuth, self.sigma_elevation.value**2 + elevation
        covariance = [[variances[0], both], [both, variances[1]]]
        return correlated(differences, covariance, list(reading.seen), self.dof.value)


class BearingSensor(AbstractBearingSensor):
    """As `AbstractBearingSensor`; `late`: by how many s angles are later than other readings at their position."""

    late: Noise | None

    def __init__(self, sigma_azimuth: float, sigma_elevation: float, dof: float):
        super().__init__(sigma_azimuth, sigma_elevation, dof)
        self.late = None

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        """Azimuth and elevation, with the calibration of the station or else compressed, and with its biases."""
        angles = self.angles(delayed_position(view, inputs, self.late), inputs)
        return [angle + bias for angle, bias in zip(angles, self.biases(view, inputs), strict=True)]


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
    stations: int,
    planar: bool = False,
    sigma_a: float = 1.2,
    sigma_z: float = 0.3,
    memory: float = 3.8,
    sigma_azimuth: float = 0.037,
    sigma_elevation: float = 0.28,
    dof: float = 1.0,
    sigma_bias: Sequence[float] = (0.22, 0.25),
    time_constant: float = 9.7,
    length: float = 0.63,
) -> Tracker:
    """Position and velocity from the bearings of numbered stations, with a drifting bias of each one's two angles.

    The bearings-only EKF of Will et al. 2020, section 4.2, with Student's t instead of a gate, and with biases: errors
    of real bearings are correlated in time. Motion numbers as in `DriftingBiases`, with the biases of azimuth and
    elevation, rad; sensor numbers as in `BearingSensor`. The defaults are for uncalibrated stations whose bearings are
    averages over 0.5 s; `CALIBRATED` has the values for calibrated ones. `planar`: at a known height.
    """
    expected = "the number of stations, as bearing_tracker(len(rig.stations))"
    require(is_count(stations), "bearing_tracker", stations, expected)
    biases = 2 * stations
    return Tracker(
        DriftingBiases(biases, sigma_a, sigma_z, memory, np.array(sigma_bias), time_constant, length, "rad"),
        {BEARINGS: BearingSensor(sigma_azimuth, sigma_elevation, dof)},
        BiasedStart(Scale(1.5, "m"), Scale(1.0, "m/s"), Scale(np.array(sigma_bias), "rad"), planar, biases),
        # An array covers half a turn of either angle.
        track_loss=TrackScorePolicy(np.pi, "rad"),
    )


CALIBRATED: Mapping[str, Any] = MappingProxyType(
    {
        "sigma_a": 0.2,
        "memory": 6.5,
        "sigma_azimuth": 0.068,
        "sigma_elevation": 0.33,
        "dof": 1.0,
        "sigma_bias": (0.115, 0.055),
        "time_constant": 1.7,
        "length": 0.1,
    }
)
"""The noise levels of `bearing_tracker` for calibrated stations."""
