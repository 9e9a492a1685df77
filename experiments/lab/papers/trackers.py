"""Trackers of several studies: levels of constant biases, moving windows, and the fixes as they are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from trackwright.experiments.monte_carlo import TrackerConfig
from trackwright.trackers.baselines.windows import MovingWindow
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.trajectories import Trajectory

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


def built(
    base: str,
    about: str,
    build: Callable[[Trajectory, bool], AbstractTracker],
    tunables: Mapping[str, Any] = MappingProxyType({}),
) -> TrackerConfig:
    """The tracker `base` of the catalogue as `build(trajectory, planar)` makes it, with these tunables."""
    return TrackerConfig(replace(spec_of(base), about=about, build=build), tunables)


def window(rows: int) -> TrackerConfig:
    """The mean of the last `rows` fixes, per axis."""
    about = f"mean of the last {rows} fixes"
    return built("moving-average", about, lambda trajectory, planar: MovingWindow(rows, False, planar))


RAW = built("moving-average", "the fixes as they are", lambda trajectory, planar: MovingWindow(1, False, planar))
