"""Trackers of several studies: levels of constant biases, moving windows, and the fixes as they are."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from trackers.baselines.rows import TRACKERS
from trackers.baselines.windows import MovingWindow
from trackers.recordings.tracker_spec import TrackerSpec

CONSTANT = MappingProxyType({"motion.time_constant": 1000.0, "motion.length": 1e4, "start.sigma_shared": 1e-3})
"""Levels of `uwb` for biases that neither time nor the way changes, and that the anchors do not share."""

CONSTANT_BIASES = CONSTANT | {
    "motion.sigma_a": 0.3,
    "motion.memory": 5.0,
    "motion.sigma_bias": 0.025,
    "start.sigma_bias": 0.025,
    "sensors.ranges.sigma_r": 0.12,
    "sensors.ranges.positive_skew": 3.0,
    "sensors.ranges.dof": 3.0,
    "sensors.ranges.bias": [0.015] * 8,
}
"""Levels for constant biases of centimetres, and ranges that are too long more often than too short."""

CONSTANT_INERTIAL = MappingProxyType({"motion.noise.sigma_range_walk": 0.005})
"""The same of `uwb-imu`: range biases that hardly change."""

CONSTANT_BIASES_INERTIAL = CONSTANT_INERTIAL | {"start.sigma_bias": 0.05, "sensors.ranges.bias": [0.03] * 4}


def window(rows: int, median: bool = False) -> TrackerSpec:
    """The mean or median of the last `rows` fixes, per axis."""
    spec = TRACKERS["median" if median else "moving-average"]
    about = f"{'median' if median else 'mean'} of the last {rows} fixes"
    return replace(spec, about=about, build=lambda trajectory, planar: MovingWindow(rows, median, planar))


RAW = replace(window(1), about="the fixes as they are")
