"""The assembled tracker of ranges without an IMU: position, velocity and a range bias per anchor."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

from trackwright.trackers.core.errors import is_count, require
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.track_loss import TrackScorePolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import BiasedStart, DriftingBiases
from trackwright.trackers.parts.ranges import RANGES, RangeSensor

if TYPE_CHECKING:
    from trackwright.trackers.recordings.calibration import Calibration

MAX_BIASES = 16
"""Largest number of anchors with a bias each in the state; the cost of an epoch grows with its square."""

REACH = 25.0
"""Width, m, of the uniform distribution of a range that does not depend on the track."""


def range_tracker(
    anchors: int,
    planar: bool = False,
    sigma_a: float = 0.44,
    sigma_z: float = 0.7,
    memory: float = 5.5,
    sigma_r: float = 0.09,
    positive_skew: float = 4.0,
    dof: float = 1.8,
    bias: float = 0.07,
    sigma_bias: float = 0.085,
    time_constant: float = 65.0,
    length: float = 5.0,
    sigma_shared: float = 0.1,
) -> Tracker:
    """Position and velocity from ranges to numbered anchors, one range per row; `planar`: at a known height.

    Motion numbers as in `DriftingBiases`, sensor numbers as in `RangeSensor`; `bias`: mean of the range biases, m;
    `sigma_shared`: standard deviation, m, of the bias of the tag, which its ranges to all anchors share. One set
    of defaults serves hand-held tags, drones, trolleys and tags on the floor; `range_levels` has the defaults of a
    calibrated site. Above `MAX_BIASES` anchors the state has only the shared bias; the tunable ones of the sensor
    remain.
    """
    require(is_count(anchors), "range_tracker", anchors, "the number of anchors, as range_tracker(len(rig.anchors))")
    biases = anchors if anchors <= MAX_BIASES else 0
    return Tracker(
        DriftingBiases(biases, sigma_a, sigma_z, memory, sigma_bias, time_constant, length),
        {RANGES: RangeSensor(1, anchors, sigma_r, positive_skew, dof, bias)},
        BiasedStart(
            Scale(1.0, "m"), Scale(1.0, "m/s"), Scale(sigma_bias, "m"), planar, biases, Scale(sigma_shared, "m")
        ),
        track_loss=TrackScorePolicy(REACH, "m"),
    )


LASTING = MappingProxyType({"time_constant": 5.0, "length": 1.5})
"""How long biases last that a calibration leaves, s and m, as errors of ranges against truth do (docs/decisions.md)."""


def range_levels(calibration: Calibration | None) -> dict[str, float]:
    """The noise levels of `range_tracker`, by name, at a site with this calibration; none where it has no anchors.

    The biases left by a calibration vary from place to place, with its `range_spread` as standard deviation.
    """
    if calibration is None or not calibration.anchors:
        return {}
    return {
        "bias": 0.0,
        "sigma_bias": calibration.range_spread or 0.07,
        **LASTING,
        "sigma_shared": 0.005,
        "sigma_r": 0.06,
        "positive_skew": 3.5,
        "dof": 2.0,
    }
