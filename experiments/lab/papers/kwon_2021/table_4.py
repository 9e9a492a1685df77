"""Table 4 and Figure 10 of Kwon et al. 2021: the range of 380 estimates of a tag at rest, once filters have settled.

Assumed: 40 rows a second, three anchors 0.7 m above the tag, two of them on one side 5 m from the third, and an
accelerometer noise of 0.001 m/s²/√Hz, known to the proposed filter. The two anchors on one side have slow errors, which
affect y more than x, so that filters improve y less, as printed. A tag at rest does not show a filter's lag.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import RAW, Printed, window
from trackwright.experiments.lab.papers.fitting import Fit, Fitted, fitted
from trackwright.sim.corruptions import constant_bias, gauss_markov, on_anchors, white_density
from trackwright.sim.imu import ImuDraw, level
from trackwright.sim.ranging import Protocol, RangeDraw, chamber
from trackwright.trackers.catalogue import build
from trackwright.trackers.recordings.folder import RecordingFolder

TAG = np.array([2.7, 2.7, 1.8])
RATE_HZ, SCORED, SETTLING = 40.0, 380, 300
WINDOW = 4
ONE_SIDE = (0, 1)
SIGMA_ACCEL, SIGMA_RANGE = 0.001, 0.007  # m/s²/√Hz and m

SPREADS_MM = {"raw": (34.6, 49.9), "moving average": (18.4, 31.7), "Kalman": (15.0, 26.2), "proposed": (10.8, 18.4)}
"""Table 4, largest less smallest: x and y, mm."""

PRINTED = {
    (name, axis): Printed(
        f"Table 4, {name}, {axis}", number, f"spread_{axis}_m", mc.FITTED, unit="mm", worlds=("still",), tracker=name
    )
    for name, spreads in SPREADS_MM.items()
    for axis, number in zip("xy", spreads, strict=True)
}


def still(ids: np.ndarray, seed: int, sigma_stamp: float, base: float, slow: float, tau: float) -> RecordingFolder:
    """Tags at rest with an IMU: ranges to three anchors, what trilateration makes of them, and IMU samples.

    `sigma_stamp` s, of a time stamp; `base` m, between the two anchors on one side; `slow` m and `tau` s, of the slow
    errors of these two.
    """
    anchors = np.array([[0.0, 2.5 - base / 2, 2.5], [0.0, 2.5 + base / 2, 2.5], [5.0, 2.5, 2.5]])
    ranges = RangeDraw(
        chamber(anchors), lambda keys, times: np.tile(TAG, (len(keys), len(times), 1)),
        {"slow": on_anchors(ONE_SIDE, gauss_markov(slow, tau))}, RATE_HZ, SETTLING + SCORED,
        Protocol(sigma_stamp=sigma_stamp),
    )  # fmt: skip
    accel = {"bias": constant_bias(0.1), "noise": white_density(SIGMA_ACCEL)}
    gyro = {"bias": constant_bias(0.01), "noise": white_density(0.002)}
    folder = ImuDraw(ranges, accel, gyro, attitude=level).drawn(ids, seed).folder("still tag")
    places = build("trilateration", folder).run(folder).to_polars().select("t_s", "tag", "x_m", "y_m", "z_m")
    fixes = places.drop_nulls().sort("t_s", maintain_order=True)
    return replace(folder, tables={**folder.tables, "fixes": fixes})


def _spread(axis: int) -> Callable[[mc.TrackedRuns], np.ndarray]:
    """The range (n,), m, of the last 380 places along an axis."""

    def spread(tracked: mc.TrackedRuns) -> np.ndarray:
        pairs = zip(tracked.estimates, tracked.known, strict=True)
        return np.array([np.ptp(estimates[known][-SCORED:, axis]) for estimates, known in pairs])

    return spread


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Table 4."""
    yield from (figure.beside(results) for figure in PRINTED.values())
    less = [
        results.difference(f"spread_{axis}_m", "still", after, before).high < 0
        for before, after in pairwise(SPREADS_MM)
        for axis in "xy"
    ]
    listed = ", ".join(f"{name} {PRINTED[name, 'x'].ours(results).value:.1f} mm" for name in SPREADS_MM)
    says = "raw > moving average > Kalman > proposed, in x and in y"
    yield mc.Conclusion(says, all(less), f"in x {listed}", mc.DERIVED)


NUMBERS = fitted("papers/kwon_2021/table_4")
KALMAN = {"motion.sigma_a": NUMBERS["sigma_a"], "sensors.fixes.sigma_horizontal": SIGMA_RANGE, "sensors.fixes.dof": 1e3}
PROPOSED = {
    "motion.noise.sigma_accel": SIGMA_ACCEL,
    "motion.noise.sigma_accel_walk": 1e-4,
    "sensors.ranges.sigma_r": SIGMA_RANGE,
    # Nothing is in the way: normal noise.
    "sensors.ranges.positive_skew": 1.0,
    "sensors.ranges.dof": 1e3,
    "sensors.ranges.bias": np.zeros(3),
}
STUDY = mc.Study(
    name="table-4",
    about="Table 4 and Figure 10 of Kwon et al. 2021: how far the estimates of a still tag spread",
    worlds={"still": mc.World(still, {k: v for k, v in NUMBERS.items() if k != "sigma_a"})},
    trackers={
        "proposed": mc.TrackerConfig("uwb-imu", PROPOSED, every=1 / RATE_HZ),
        "raw": RAW,
        "moving average": window(WINDOW, f"mean of the last {WINDOW} fixes"),
        "Kalman": mc.TrackerConfig("fix-kf", KALMAN),
    },
    runs=200,
    seed=1,
    measures={f"spread_{axis}_m": _spread(k) for k, axis in enumerate("xy")},
    metrics=("spread_x_m", "spread_y_m", "rmse_m", "nis_ratio"),
    expected=expected,
)

fit = Fit(
    STUDY,
    {
        "sigma_stamp": Fitted(2.7e-11, "s", "raw x"),
        "base": Fitted(6.0, "m", "raw y"),
        "slow": Fitted(5.4e-3, "m", "moving average y"),
        "tau": Fitted(0.55, "s", "proposed x and y, their geometric mean"),
        "sigma_a": Fitted(0.028, "m/s^2/sqrt(Hz)", "Kalman x and y, their geometric mean"),
    },
    [
        *([PRINTED[key]] for key in (("raw", "x"), ("raw", "y"), ("moving average", "y"))),
        *([PRINTED[name, axis] for axis in "xy"] for name in ("Kalman", "proposed")),
    ],
    f"2 of 8 printed figures: beside these five numbers the window's length, {WINDOW}, was chosen",
    runs=48,
    rounds=2,
    tunables={"sigma_a": ("Kalman", "motion.sigma_a")},
)
