"""Table 3 and Figure 9 of Kwon et al. 2021: a tag moved by a robot along x, y and z, with and without IMU.

Assumed: five strokes of 4 s along each axis, ten rows a second. An error is the distance between the mean estimated end
of the strokes and the true end. Two printed errors contradict their own rows (3,190 mm estimated as 3,191 mm with an
error of 41 mm, 2,710 mm as 2,730 mm with 30 mm); the printed errors are used.
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import CONSTANT_BIASES, CONSTANT_BIASES_INERTIAL, Printed
from trackwright.experiments.lab.papers.kwon_2021.chamber import NUMBERS, PROTOCOL, anchors, deviations
from trackwright.experiments.text.expectations import fixed_interval, listed
from trackwright.sim.corruptions import antenna_biases
from trackwright.sim.imu import ImuDraw, level
from trackwright.sim.keys import Keys
from trackwright.sim.ranging import RangeDraw, chamber
from trackwright.trackers.recordings.folder import RecordingFolder

LOW, HIGH = np.array([2.80, 2.71, 1.50]), np.array([3.19, 3.09, 1.89])
STROKES, STROKE_S, RATE_HZ = 5, 4.0, 10.0
AXIS_S = STROKES * STROKE_S
MEASURED = "measured"
HEIGHTS = "the higher end is nearer to the anchors' plane, where heights are seen worse; printed is the reverse"
FOLLOWS = "follows from the ends above"

_of = partial(Printed, unit="mm", worlds=("robot",), tracker=MEASURED)
PRINTED = (
    _of("Table 3, x, least, mean error", 40.0, "least_x_m", mc.PREDICTED),
    _of("Table 3, x, largest, mean error", 41.0, "largest_x_m", mc.PREDICTED),
    _of("Table 3, y, least, mean error", 30.0, "least_y_m", mc.PREDICTED),
    _of("Table 3, y, largest, mean error", 37.0, "largest_y_m", mc.PREDICTED),
    _of("Table 3, z, least, mean error", 179.0, "least_z_m", mc.FITTED, HEIGHTS),
    _of("Table 3, z, largest, mean error", 95.0, "largest_z_m", mc.FITTED, HEIGHTS),
    _of("Table 3, x and y, both ends, mean", 37.0, "flat_m", mc.DERIVED, FOLLOWS),
    _of("Table 3, z, both ends, mean", 137.0, "height_m", mc.DERIVED, FOLLOWS),
)
"""Mean errors at the least and at the largest coordinate, and their means."""


def strokes(keys: Keys, times: np.ndarray) -> np.ndarray:
    """Strokes along x, then y, then z, from the smallest coordinate to the largest and back."""
    path = np.tile(LOW, (len(times), 1))
    for axis in range(3):
        mine = (times >= axis * AXIS_S) & (times < (axis + 1) * AXIS_S)
        swing = np.cos(2 * np.pi * (times[mine] - axis * AXIS_S) / STROKE_S)
        path[mine, axis] += 0.5 * (HIGH - LOW)[axis] * (1.0 - swing)
    return np.tile(path, (len(keys), 1, 1))


def robot(ids: np.ndarray, seed: int, sigma_bias: float, height: float) -> RecordingFolder:
    """Tags with a level IMU on the robot, among the chamber's anchors."""
    biases, points = {"biases": antenna_biases(sigma_bias)}, round(3 * AXIS_S * RATE_HZ)
    ranges = RangeDraw(chamber(anchors(height)), strokes, biases, RATE_HZ, points, PROTOCOL)
    return ImuDraw(ranges, attitude=level).drawn(ids, seed).folder("robot")


def _end(axis: int, largest: bool) -> Callable[[mc.TrackedRuns], np.ndarray]:
    """Error, m, of the mean of the strokes' smallest or largest coordinates."""

    def off(tracked: mc.TrackedRuns) -> np.ndarray:
        coordinates = (deviations(tracked) + tracked.truth)[..., axis]
        if not largest:
            coordinates = -coordinates
        true = HIGH[axis] if largest else -LOW[axis]
        number = np.floor((tracked.times - axis * AXIS_S) / STROKE_S + 1e-6)
        ends = [np.nanmax(np.where(number == k, coordinates, np.nan), axis=1) for k in range(STROKES)]
        return np.abs(np.mean(ends, axis=0) - true)

    return off


def _mean_of(axes: range) -> Callable[[mc.TrackedRuns], np.ndarray]:
    """The mean error of both ends of some axes."""
    ends = [_end(axis, largest) for axis in axes for largest in (False, True)]
    return lambda tracked: np.mean([end(tracked) for end in ends], axis=0)


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Table 3, and the benefit of the IMU."""
    yield from (figure.beside(results) for figure in PRINTED)
    means = {axis: results.value(f"least_{axis}_m", "robot", MEASURED).times(1e3) for axis in "xyz"}
    says = "tracking is accurate in x and y, the error in z is larger"
    how = listed(means, "{:.0f} mm")
    yield mc.Conclusion(says, means["z"].low > max(means["x"].high, means["y"].high), how, mc.DERIVED)
    without, raw = (
        results.difference("rmse_m", "robot", "with IMU", other).times(1e3) for other in ("without IMU", MEASURED)
    )
    how = f"{fixed_interval(without, '+.1f', ' mm')} beside the filter of ranges, "
    how += f"{raw.value:+.1f} mm beside least squares: the remaining errors are biases, which an IMU does not measure"
    yield mc.Conclusion("with an IMU the horizontal error is smaller than without", without.high < 0, how, mc.PREDICTED)


STUDY = mc.Study(
    name="robot",
    about="Table 3 and Figure 9 of Kwon et al. 2021: a tag that a robot moves along each axis, with and without IMU",
    worlds={"robot": mc.World(robot, NUMBERS)},
    trackers={
        "with IMU": mc.TrackerConfig("uwb-imu", CONSTANT_BIASES_INERTIAL, every=1 / RATE_HZ),
        "without IMU": mc.TrackerConfig("uwb", CONSTANT_BIASES, every=1 / RATE_HZ),
        MEASURED: mc.TrackerConfig("multilateration"),
    },
    runs=60,
    seed=1,
    measures={
        **{f"{e}_{a}_m": _end(k, e == "largest") for k, a in enumerate("xyz") for e in ("least", "largest")},
        "flat_m": _mean_of(range(2)),
        "height_m": _mean_of(range(2, 3)),
    },
    metrics=("flat_m", "height_m", "rmse_m", "p95_m"),
    expected=expected,
)
