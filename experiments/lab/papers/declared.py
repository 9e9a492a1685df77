"""What declarations of studies share: printed numbers as data, and trackers of several studies."""

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.trackers.baselines.fixes import MovingWindow
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.tracks import Trajectory

UNITS = {"cm": 100.0, "mm": 1e3, "cm²": 1e4, "deg": 180 / np.pi, "%": 100.0}
"""Factors from SI units and from fractions."""


@dataclass(frozen=True)
class Printed:
    """A number that a paper prints in `unit`, and what of a study is compared with it.

    `metric`: a metric or measure; of several `worlds` its mean. The rest as of `ExpectedResult`. What the numbers of a
    table have in common is given by keyword, once, by `functools.partial`.
    """

    quantity: str
    number: float
    metric: str
    origin: mc.Origin
    note: str = ""
    _: KW_ONLY
    unit: str
    worlds: tuple[str, ...]
    tracker: str

    def ours(self, results: mc.Results, **point: float) -> mc.Value:
        """The study's own number, in the same unit."""
        pairs = [(world, self.tracker) for world in self.worlds]
        return results.average(self.metric, pairs, **point).times(UNITS[self.unit])

    def beside(self, results: mc.Results, note: str = "", **point: float) -> mc.ExpectedResult:
        """The printed number beside the study's own; `note`: in place of the declared one."""
        share, ours = self.unit == "%", self.ours(results, **point)
        return mc.ExpectedResult(
            self.quantity, self.number, ours, self.unit, self.origin, note=note or self.note, share=share
        )


CONSTANT_BIASES = {
    "motion.time_constant": 1000.0,
    "motion.length": 1e4,
    "start.sigma_shared": 1e-3,
    "motion.sigma_a": 0.3,
    "motion.memory": 5.0,
    "motion.sigma_bias": 0.025,
    "start.sigma_bias": 0.025,
    "sensors.ranges.sigma_r": 0.12,
    "sensors.ranges.positive_skew": 3.0,
    "sensors.ranges.dof": 3.0,
    "sensors.ranges.bias": [0.015] * 8,
}
"""Levels of `uwb` for biases of centimetres that hardly change and that the anchors do not share, and ranges that are
too long more often than too short."""

CONSTANT_BIASES_INERTIAL = {
    "motion.noise.sigma_range_walk": 0.005,
    "start.sigma_bias": 0.05,
    "sensors.ranges.bias": [0.03] * 4,
}
"""The same of `uwb-imu`."""


def built(
    base: str,
    about: str,
    build: Callable[[Trajectory, bool], AbstractTracker],
    tunables: Mapping[str, Any] = MappingProxyType({}),
) -> mc.TrackerConfig:
    """The tracker `base` of the catalogue as `build(trajectory, planar)` makes it, with these tunables."""
    return mc.TrackerConfig(replace(spec_of(base), about=about, build=build), tunables)


def window(rows: int, about: str) -> mc.TrackerConfig:
    """The mean of the last `rows` fixes, per axis."""
    return built("moving-average", about, lambda trajectory, planar: MovingWindow(rows, False, planar))


RAW = window(1, "the fixes as they are")
