"""What is compared: the data sets, the estimators with how their noise levels were chosen, and the protocol.

Development recordings are those on which our default levels were set. The levels of other estimators have the least
geometric mean of the horizontal RMSE over these, on a grid: the search by hand or on a grid that their documentation
shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from trackwright.experiments.lab.benchmark.motion import Levels

MOST_READINGS = 6_000
"""Readings of a recording that every estimator is given, from its beginning."""

OURS, SMOOTHED = DEFAULT = ("trackwright", "trackwright-smoothed")
MOTION = ("trackwright-motion", "trackwright-motion-smoothed")
"""Our estimators with defaults, and at several levels of motion; each pair filtered and smoothed."""

OPTIMUM = ("optimum", "optimum-smoothed")
"""Those that know the levels of a simulated world, and are not compared with ours."""


class Estimator(NamedTuple):
    """An estimator: `run`, file and function in `adapters`; `about`, what it is; `levels`, a key of `LEVELS`, or empty.

    `later`: whether an estimate uses later readings. `library`: the distribution that it needs. `compiled`: the
    function returns one that is called twice, whose second call is timed. `whole`: it takes a recording, not the
    readings of a tag.
    """

    run: str
    about: str
    levels: str = ""
    later: bool = False
    library: str = ""
    compiled: bool = False
    whole: bool = False


ESTIMATORS: Mapping[str, Estimator] = MappingProxyType({
    OURS: Estimator("ours:filtered", "our default tracker", compiled=True, whole=True),
    SMOOTHED: Estimator("ours:smoothed", "our default tracker, smoothed", later=True, compiled=True, whole=True),
    MOTION[0]: Estimator("ours:motion", "our default tracker, `--motion auto`", compiled=True, whole=True),
    MOTION[1]: Estimator(
        "ours:motion_smoothed", "our default tracker, `--motion auto --smooth`", later=True, compiled=True, whole=True
    ),
    "numpy-ekf": Estimator("plain:estimate", "textbook extended Kalman filter", "plain"),
    "filterpy": Estimator("with_filterpy:estimate", "EKF with a gate of 3 σ", "gated", library="filterpy"),
    "stonesoup": Estimator(
        "with_stonesoup:estimate", "EKF, hypotheses by Mahalanobis distance", "gated", library="stonesoup"
    ),
    "cuthbert": Estimator(
        "with_cuthbert:prepared", "square-root EKF", "plain", library="cuthbert", compiled=True
    ),
    "dynamax": Estimator(
        "with_dynamax:prepared", "extended Kalman smoother", "smoothed", True, "dynamax", compiled=True
    ),
    "gtsam-lag": Estimator(
        "with_gtsam:fixed_lag", "incremental smoother over 2 s, newest state, Huber's loss", "gated", library="gtsam"
    ),
    "gtsam": Estimator("with_gtsam:batch", "batch, Huber's loss", "robust", True, "gtsam"),
    "robust-map": Estimator("robust_map:estimate", "batch, Student's t with 3 degrees of freedom", "robust", True),
    "zero-velocity": Estimator("zero_velocity:estimate", "EKF with IMU and zero-velocity updates of a thesis"),
    OPTIMUM[0]: Estimator("optimum:filtered", "EKF with the levels of the world"),
    OPTIMUM[1]: Estimator("optimum:smoothed", "most probable path with the levels of the world", later=True),
    "maker": Estimator("maker:fixes", "fixes of the maker's system", whole=True),
})  # fmt: skip

LEVELS: Mapping[str, Mapping[str, Levels]] = MappingProxyType({
    "plain": {
        "ranges": Levels(0.3, 0.4), "tdoa": Levels(0.3, 0.4), "bearings": Levels(0.3, 0.4), "fixes": Levels(24, 0.013),
    },
    "gated": {
        "ranges": Levels(0.3, 0.2), "tdoa": Levels(0.3, 0.2), "bearings": Levels(0.1, 0.2), "fixes": Levels(24, 0.013),
    },
    "smoothed": {
        "ranges": Levels(0.1, 0.2), "tdoa": Levels(0.1, 0.2), "bearings": Levels(0.1, 0.1), "fixes": Levels(0.3, 0.1),
    },
    "robust": {
        "ranges": Levels(0.3, 0.4), "tdoa": Levels(0.1, 0.05), "bearings": Levels(0.9, 0.8), "fixes": Levels(0.3, 0.05),
    },
})  # fmt: skip
"""Noise levels of a group of estimators by kind of readings."""

DEVELOPMENT: Mapping[str, tuple[str, ...]] = MappingProxyType({
    "ranges": (
        "starloc-fast-s1", "starloc-2d-s5", "rcv-drone-3", "iasl-drone-1", "lias-planar-fast", "labyrinth",
        "ngbui-line-1-1", "ngbui-line-2-1",
    ),
    "tdoa": ("util-c1-t1-tdoa2", "util-c1-t1-tdoa3", "util-c4-t5-tdoa2"),
    "bearings": ("ble51-walk-u1-r1", "ble51-walk-u2-r1", "ble51-walk-u3-r1"),
    "fixes": ("tiers-1tag-01",),
})  # fmt: skip
"""The recordings on which levels were chosen, by kind of readings: those that set the defaults of a tracker of ours.

That of fixes is another one than the tracker that is compared, `fix-kf`.
"""
