"""The assembled tracker of ranges without an inertial sensor: position, velocity and a bias per anchor."""

from __future__ import annotations

from typing import Any

import equinox as eqx

from trackers.core.algebra import Vector, diagonal
from trackers.core.ekf import Gaussian
from trackers.core.motion import Noise
from trackers.core.recording import Row
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tracker import Tracker
from trackers.core.tunable import Scale
from trackers.parts.ranges import RANGES, RangeSensor
from trackers.parts.start_nearby import AbstractNearbyStart
from trackers.uwb_imu.drifting import DriftingBiases, Ranged

OWN_BIASES = 16
"""Anchors up to which each has a bias in the state; the cost of a row grows with the square of their number."""


class RangeStart(AbstractNearbyStart):
    """The place where recent ranges meet, from the row's input `nearby` (4,): m, and 1 where there is one.

    `sigma_position` m, `sigma_velocity` m/s, `sigma_bias` m: how far off place, rest and mean biases may be.
    """

    sigma_position: Noise
    sigma_velocity: Noise
    sigma_bias: Noise
    planar: bool = eqx.field(static=True)
    biases: int = eqx.field(static=True)

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        n = 2 if self.planar else 3
        zero = candidate[0] * 0.0
        state = Ranged(Vector(*(candidate[k] for k in range(n))), Vector(*[zero] * n), Vector(*[zero] * self.biases))
        variances = [s.value**2 for s in (self.sigma_position, self.sigma_velocity, self.sigma_bias)]
        return Gaussian(state, diagonal([variances[0]] * n + [variances[1]] * n + [variances[2]] * self.biases, zero))


def range_tracker(
    anchors: int,
    planar: bool = False,
    sigma_a: float = 0.3,
    sigma_z: float = 0.7,
    memory: float = 5.0,
    sigma_r: float = 0.12,
    positive_skew: float = 3.0,
    dof: float = 3.0,
    bias: float = 0.015,
    sigma_bias: float = 0.025,
    time_constant: float = 1000.0,
) -> Tracker:
    """Position and velocity from ranges to numbered anchors, one range a row; at a known height where `planar`.

    σa, σz m/s² per √Hz, horizontal and vertical; the velocities' `memory` s; σr, the biases' mean and σ_bias m, and
    their time constant s. The numbers are one set for walks with a tag in the hand, drones, trolleys and tags on the
    floor. Above `OWN_BIASES` anchors the state has no biases, only those that are tunables.
    """
    biases = anchors if anchors <= OWN_BIASES else 0
    return Tracker(
        DriftingBiases(biases, sigma_a, sigma_z, memory, sigma_bias, time_constant),
        {RANGES: RangeSensor(1, anchors, sigma_r, positive_skew, dof, bias)},
        RangeStart(Scale(1.0, "m"), Scale(1.0, "m/s"), Scale(sigma_bias, "m"), planar, biases),
        # Student's t bounds what one range adds to the NIS, and real biases make it large: silence ends a track.
        track_loss=TrackLossPolicy(nis_limit=1e3, max_gap=10.0),
    )
