"""The beam tracker: an EKF on azimuth and elevation, straight from phases (Will et al. 2020, section 3).

Its baseline is delay-and-sum on each row separately (section 4.1).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.aoa.beamformer import Grid, direction
from trackwright.trackers.aoa.phases import InPlanePhases, PlanePhases, require_array
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.filters.filter import AbstractStart
from trackwright.trackers.core.model.algebra import Scalar, Vector, diagonal, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.motion import AbstractMotion, Noise, process_noise
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.sensor import Channel, Row
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker, Tracker

PHASES = "phases"  # the name of a station's phases in the recordings of a tracker of one station


class Beam(NamedTuple):
    """A direction in the array frame and its rates, rad and rad/s: equation (4)."""

    azimuth: Scalar
    elevation: Scalar
    azimuth_rate: Scalar
    elevation_rate: Scalar

    @property
    def direction(self) -> Vector:
        """Azimuth and elevation, rad."""
        return Vector(self.azimuth, self.elevation)


class InPlaneBeam(NamedTuple):
    """An angle in the array's plane, about its z axis, and its rate, rad and rad/s."""

    heading: Heading
    rate: Scalar


class BeamMotion(AbstractMotion):
    """Constant angular rates with an acceleration that is constant during a step: F and Q of equations (5), (6).

    `sigma_a`: rad/s². The noise depends on how an interval is divided into steps; the paper's rate is constant.
    """

    sigma_a: Noise

    @property
    def noise_dimension(self) -> int:
        return 2

    def step(self, state: Beam, inputs: Inputs, dt: Scalar, w: Vector) -> Beam:
        azimuth, elevation = w * self.sigma_a.value
        half = 0.5 * dt * dt
        return Beam(
            state.azimuth + state.azimuth_rate * dt + azimuth * half,
            state.elevation + state.elevation_rate * dt + elevation * half,
            state.azimuth_rate + azimuth * dt,
            state.elevation_rate + elevation * dt,
        )


class InPlaneBeamMotion(AbstractMotion):
    """A constant turning rate about the array's z axis with white acceleration; `sigma_a`: rad/s² per √Hz."""

    sigma_a: Noise

    @property
    def noise_dimension(self) -> int:
        return 2

    def step(self, state: InPlaneBeam, inputs: Inputs, dt: Scalar, w: Vector) -> InPlaneBeam:
        kick = self.sigma_a.value * jnp.sqrt(dt)
        turn = state.rate * dt + kick * dt * (0.5 * w[0] + w[1] / 12**0.5)
        return InPlaneBeam(state.heading.retract([turn]), state.rate + kick * w[0])


class BeamStart(AbstractStart):
    """A start at the maximum of the delay-and-sum spectrum of one row with at least three phases.

    `sigma_angle` rad, 30° in the paper, and `sigma_rate` rad/s: standard deviations. A grid of one angle gives an
    `InPlaneBeam`.
    """

    searches: ClassVar[bool] = True

    station: str = eqx.field(static=True)
    grid: Grid
    sigma_angle: Noise
    sigma_rate: Noise

    @property
    def readings(self) -> Mapping[str, int]:
        """The phases of its station."""
        return {self.station: 3}

    def can_start(self, row: Row) -> Scalar:
        return jnp.sum(row.readings[self.station].seen) >= 3

    def candidate(self, sensors: Any, row: Row) -> Any:
        reading = row.readings[self.station]
        return direction(self.grid, reading.values - sensors[self.station].offsets.value, reading.seen)

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        angle, rate = self.sigma_angle.value**2, self.sigma_rate.value**2
        zero = jnp.zeros_like(candidate[0])
        if candidate.shape[0] == 1:
            return Gaussian(InPlaneBeam(Heading(candidate[0]), zero), diagonal([angle, rate], zero))
        return Gaussian(Beam(candidate[0], candidate[1], zero, zero), diagonal([angle, angle, rate, rate], zero))


def beam_tracker(
    station: Station,
    name: str = PHASES,
    sigma_a: float = 0.5,
    sigma_p: float = 0.2,
    paper_form: bool = False,
    span: float = np.deg2rad(30.0),
) -> Tracker:
    """The beam tracker of one station, whose phases a recording holds under `name`; `span`: of the start's grid, rad.

    `sigma_a` rad/s², `sigma_p` rad. `paper_form`: residuals as printed, see `pairwise` in phases.py. Raises
    UnusableInput for anything but a station with an array.
    """
    require_array("beam_tracker", station)
    sensor = PlanePhases(station, sigma_p, paper_form)
    start = BeamStart(name, Grid.of(station, span), Scale(np.deg2rad(30.0), "rad"), Scale(1.0, "rad/s"))
    motion = BeamMotion(process_noise(sigma_a, "rad/s^2"))
    return Tracker(motion, {name: sensor}, start, track_loss=TrackLossPolicy())


def in_plane_beam_tracker(
    station: Station, name: str = PHASES, sigma_a: float = 0.005, sigma_p: float = 0.7
) -> Tracker:
    """The beam tracker in the plane of a flat array, over all angles; `sigma_a` rad/s² per √Hz, `sigma_p` rad.

    Over all angles ambiguous lobes are close, so track loss is declared earlier than by the default policy. Raises
    UnusableInput for anything but a station with an array.
    """
    require_array("in_plane_beam_tracker", station)
    sensor = InPlanePhases(station, sigma_p)
    start = BeamStart(name, Grid.in_plane(station), Scale(np.deg2rad(30.0), "rad"), Scale(0.05, "rad/s"))
    motion = InPlaneBeamMotion(process_noise(sigma_a, "rad/s^2/sqrt(Hz)"))
    return Tracker(
        motion, {name: sensor}, start, track_loss=TrackLossPolicy(nis_limit=2.5, nis_window=16.0, max_gap=30.0)
    )


class DelayAndSum(AbstractEpochwiseTracker):
    """The maximum of the delay-and-sum spectrum of each row with three antennas or more; the covariance is NaN."""

    grid: Grid
    name: str = eqx.field(static=True)

    @classmethod
    def of(cls, station: Station, name: str = PHASES, in_plane: bool = False) -> DelayAndSum:
        """The beamformer of a station, whose readings a recording holds under `name`, on the paper's grid.

        Raises UnusableInput for anything but a station with an array.
        """
        require_array("DelayAndSum.of", station)
        return cls(Grid.in_plane(station) if in_plane else Grid.of(station), name)

    def check_layout(self, layout: Layout) -> None:
        antennas = range(1, len(self.grid.cosine) + 1)
        layout.check_readings("DelayAndSum", self.name, [Channel(f"phase_{k}", "rad", True) for k in antennas])

    def scan(self, batch: Batch, initial: Any = None) -> tuple[Output, Any]:
        reading = batch.readings[self.name]

        def one(values: Any, seen: Any) -> Any:
            return direction(self.grid, values, seen)

        # One row at a time: the spectra of a whole chunk would take gigabytes.
        row = jax.vmap(one, in_axes=-1, out_axes=-1)
        angles = jax.lax.map(lambda r: row(*r), (jnp.asarray(reading.values), jnp.asarray(reading.seen)))
        zero = jnp.zeros_like(angles[:, 0])
        in_plane = angles.shape[1] == 1
        mean = InPlaneBeam(Heading(angles[:, 0]), zero) if in_plane else Beam(angles[:, 0], angles[:, 1], zero, zero)
        cov = tuple(zero + jnp.nan for _ in triangle(2 if in_plane else 4))
        status = jnp.where(jnp.sum(reading.seen, axis=1) >= 3, Status.OK, Status.WAITING)
        status = jnp.where(jnp.asarray(batch.valid), status, Status.PADDING).astype(jnp.int8)
        return Output(mean, cov, zero, zero, zero, zero, status), ()
