"""The assembled trackers of an IMU with ranges or range differences: eight states in the plane, fifteen in space."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from trackwright.trackers.core.errors import is_count, require
from trackwright.trackers.core.model.algebra import Scalar, Vector, diagonal, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Input
from trackwright.trackers.core.model.motion import AbstractMotion, Noise
from trackwright.trackers.core.model.sensor import AbstractSensor, Row
from trackwright.trackers.core.model.state import Heading, Rotation, component_names
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.track_loss import TrackScorePolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import BiasDrift
from trackwright.trackers.parts.ranges import RANGES, RangeSensor, with_delay
from trackwright.trackers.parts.start_nearby import NEARBY, AbstractNearbyStart
from trackwright.trackers.uwb_imu.fusion import MAX_BIASES, REACH, TDOA, RangeDifferenceSensor
from trackwright.trackers.uwb_imu.strapdown import ImuNoise, Inertial, PlanarInertial, PlanarStrapdown, Strapdown
from trackwright.trackers.uwb_imu.yaw_mixture import YawMixtureFilter


class InertialStart(AbstractNearbyStart):
    """A start at the position in the input `nearby` (4,), at rest, levelled by the accelerometer, with unknown yaw.

    Input `rest` (7,): recent mean specific force m/s² and turning rate rad/s, and 1 if the body was at rest, in which
    case the rate is the gyro bias. Standard deviations: `sigma_position` m; `sigma_height` m, large because anchors at
    similar heights leave a mirror ambiguity; `sigma_velocity` m/s; `sigma_tilt`, `sigma_yaw` rad;
    `sigma_accel_bias` m/s², `sigma_gyro_bias` rad/s and `sigma_bias` m, of the ranges.
    """

    sigma_position: Noise
    sigma_height: Noise
    sigma_velocity: Noise
    sigma_tilt: Noise
    sigma_yaw: Noise
    sigma_accel_bias: Noise
    sigma_gyro_bias: Noise
    sigma_bias: Noise
    planar: bool = eqx.field(static=True)
    biases: int = eqx.field(static=True)

    def __init__(self, planar: bool, biases: int = 0, sigma_bias: float = 0.08):
        self.planar, self.biases = planar, biases
        self.sigma_position = Scale(1.0, "m")
        self.sigma_height = Scale(2.0, "m")
        self.sigma_velocity = Scale(1.0, "m/s")
        self.sigma_tilt = Scale(0.15, "rad")
        self.sigma_yaw = Scale(1.0, "rad")
        self.sigma_accel_bias = Scale(0.3, "m/s^2")
        self.sigma_gyro_bias = Scale(0.03, "rad/s")
        self.sigma_bias = Scale(sigma_bias, "m")

    @property
    def inputs(self) -> tuple[Input, ...]:
        rest = Input(
            "rest",
            (7,),
            "m/s^2, rad/s",
            "recent mean specific force and turning rate, and 1 at rest, else 0",
            "`tw.build('uwb-imu', folder)`, from the table imu of a recording folder",
        )
        return NEARBY, rest

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        zero = jnp.zeros_like(candidate[0])
        at_rest = row.inputs["rest"][6] > 0.5
        rate = Vector.of(jnp.where(at_rest, row.inputs["rest"][3 + k], 0.0) for k in range(3))
        force = Vector.of(row.inputs["rest"][k] for k in range(3))
        levelled = force.norm() > 1.0
        names = ("position", "height", "velocity", "tilt", "yaw", "accel_bias", "gyro_bias", "bias")
        variances = {name: zero + getattr(self, f"sigma_{name}").value ** 2 for name in names}
        variances["gyro_bias"] *= jnp.where(at_rest, 0.01, 1.0)
        variances["tilt"] *= jnp.where(levelled, 1.0, 25.0)
        zeros, biases = Vector(zero, zero, zero), Vector(*[zero] * self.biases)
        if self.planar:
            flat = Vector(zero, zero)
            state: Any = PlanarInertial(Vector(candidate[0], candidate[1]), flat, flat, Heading(zero), rate[2], biases)
            sizes = {"position": 2, "velocity": 2, "accel_bias": 2, "yaw": 1, "gyro_bias": 1, "bias": self.biases}
            return Gaussian(state, diagonal([variances[k] for k, count in sizes.items() for _ in range(count)], zero))
        attitude = level_attitude(
            Vector.of(jnp.where(levelled, f, up) for f, up in zip(force, (0.0, 0.0, 1.0), strict=True))
        )
        state = Inertial(Vector(*(candidate[k] for k in range(3))), zeros, attitude, zeros, rate, biases)
        sizes = {"position": 2, "height": 1, "velocity": 3, "tilt": 3, "accel_bias": 3, "gyro_bias": 3}
        sizes["bias"] = self.biases
        cov = diagonal([variances[k] for k, count in sizes.items() for _ in range(count)], zero)
        # The accelerometer does not observe rotations about the vertical, here in body axes.
        vertical = attitude.inverse().apply(Vector(zero, zero, zero + 1.0))
        return with_yaw_variance(Gaussian(state, cov), vertical, variances["yaw"])


def with_yaw_variance(belief: Gaussian, axis: Vector, variance: Scalar) -> Gaussian:
    """The belief with a rotation about `axis` (body axes) of `variance` rad² added to the error of its `attitude`."""
    names = component_names(belief.mean)
    part = {names.index(f"attitude.{k}"): axis[k] for k in range(3)}
    cov = tuple(
        p + part[i] * part[j] * variance if i in part and j in part else p
        for p, (i, j) in zip(belief.cov, triangle(len(names)), strict=True)
    )
    return Gaussian(belief.mean, cov)


def level_attitude(force: Vector) -> Rotation:
    """The attitude with zero yaw of a body at rest whose accelerometer measures `force`, not zero.

    The smallest rotation that brings the force to the vertical; half a turn about x if it points down.
    """
    x, y, z = force / force.norm()
    down = z < -0.999
    w = jnp.where(down, 1.0, 1.0 + z)
    smallest = Rotation(w, y, -x, jnp.zeros_like(x)).normalised()
    half = Rotation(*(jnp.zeros_like(x) + value for value in (0.0, 1.0, 0.0, 0.0)))
    return Rotation(*(jnp.where(down, getattr(half, q), getattr(smallest, q)) for q in "wxyz"))


def inertial_tracker(
    anchors: int = 0,
    planar: bool = False,
    sigma_r: float = 0.1,
    positive_skew: float = 3.0,
    dof: float = 3.0,
    bias: float = 0.05,
) -> Tracker:
    """Position, velocity, attitude and IMU biases from ranges and an IMU; any row may lack either.

    `planar`: the paper's eight states, at a known height; else fifteen in three dimensions, and a range bias for each
    of up to `MAX_BIASES` numbered `anchors`. Sensor numbers as in `RangeSensor`, with one slot per row.
    """
    expected = "the number of anchors, as inertial_tracker(len(rig.anchors))"
    require(is_count(anchors), "inertial_tracker", anchors, expected)
    # In the plane, with three anchors, biases and position are not jointly observable.
    biases = anchors if anchors <= MAX_BIASES and not planar else 0
    sensors = {RANGES: RangeSensor(1, anchors, sigma_r, positive_skew, dof, bias)}
    return _strapdown_tracker(sensors, InertialStart(planar, biases), ImuNoise(), None)


def inertial_difference_tracker(
    anchors: int,
    slots: int = 1,
    planar: bool = False,
    noise: ImuNoise | None = None,
    sigma_d: float = 0.13,
    dof: float = 1.8,
    drift: BiasDrift | None = None,
) -> Tracker:
    """As `inertial_tracker`, from range differences, `slots` to a row, and an IMU; biases are in the plane, too.

    Numbers of the sensor as in `difference_tracker`; `drift`: of the biases, by default as there.
    """
    require(is_count(anchors), "inertial_difference_tracker", anchors, "the number of anchors, as len(rig.anchors)")
    drift = drift or BiasDrift(0.12, 20.0, 2.0)
    biases = anchors if anchors <= MAX_BIASES else 0
    start = InertialStart(planar, biases, float(drift.sigma_bias.value))
    noise = noise or ImuNoise(sigma_range_walk=None)
    return _strapdown_tracker({TDOA: RangeDifferenceSensor(slots, sigma_d, dof)}, start, noise, drift)


def _strapdown_tracker(
    sensors: Mapping[str, AbstractSensor], start: InertialStart, noise: ImuNoise, drift: BiasDrift | None
) -> Tracker:
    """The tracker of an IMU and readings to anchors, in the plane or in three dimensions as the start."""
    drift = drift if start.biases else None
    sensors = {name: with_delay(sensor) for name, sensor in sensors.items()}
    motion: AbstractMotion = Strapdown(noise, biases=start.biases, drift=drift)
    if start.planar:
        motion = PlanarStrapdown(noise, biases=start.biases, drift=drift)
    return Tracker(motion, sensors, start, YawMixtureFilter(), TrackScorePolicy(REACH, "m"))
