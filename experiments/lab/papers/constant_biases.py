"""Levels of the trackers `uwb` and `uwb-imu` for simulated anchors, whose biases are constant and of centimetres."""

from __future__ import annotations

from types import MappingProxyType

CONSTANT = MappingProxyType({"motion.time_constant": 1000.0, "motion.length": 1e4, "start.sigma_shared": 1e-3})
"""Biases that neither time nor the way changes, and that the anchors do not share."""

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
"""Levels for small constant biases and ranges that are too long more often than too short."""

CONSTANT_INERTIAL = MappingProxyType({"motion.noise.sigma_range_walk": 0.005})
"""The same of `uwb-imu`: range biases that hardly change."""

CONSTANT_BIASES_INERTIAL = CONSTANT_INERTIAL | {"start.sigma_bias": 0.05, "sensors.ranges.bias": [0.03] * 4}
"""Levels of `uwb-imu` for small constant biases."""
