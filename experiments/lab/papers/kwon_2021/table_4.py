"""Table 4 and Figure 10 of Kwon et al. 2021: a tag at rest at (2.7 m, 2.7 m), about 380 fixes.

The spread of an axis is the range of 380 estimates after the filters have settled. Anchors, rate, noise and the
filters' parameters are not printed. Assumed: 40 rows a second, three anchors 0.7 m above the tag, two of them on one
side 5 m from the third, and an accelerometer noise of 0.001 m/s²/√Hz, known to the proposed filter. Fitted
(`fitted/table_4.toml`): five parameters and the window length. The two anchors on one side have slow errors, which
affect y more than x, so that filters improve y less, as printed. Eight printed spreads, six parameters: two degrees of
freedom are left. A tag at rest does not show a filter's lag.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.lab.papers.fitting import fitted
from experiments.lab.papers.kwon_2021._fixes_from_ranges import fixes_from_ranges
from experiments.lab.papers.moving_windows import RAW, window
from experiments.monte_carlo import (
    FITTED,
    Conclusion,
    ExpectedResult,
    Results,
    Study,
    TrackedRuns,
    TrackerConfig,
    World,
    inherited,
)
from experiments.monte_carlo.chunk import tracked_runs
from experiments.pages.plots.style import BLACK, BLUE, GREEN, GREY, HEIGHT, VERMILION, plain, write_svg
from sim.corruptions import gauss_markov
from sim.imu import constant_bias, level, simulate_uwb_imu, white_density
from sim.ranging import Protocol, chamber, on_anchors
from trackers.recordings.folder import RecordingFolder

TAG = np.array([2.7, 2.7, 1.8])
RATE_HZ, SCORED, SETTLING = 40.0, 380, 300
WINDOW = 4
ONE_SIDE = (0, 1)
SIGMA_ACCEL, SIGMA_RANGE = 0.001, 0.007
"""m/s²/√Hz and m."""

PRINTED = {
    "raw": (34.6, 49.9),
    "moving average": (18.4, 31.7),
    "Kalman": (15.0, 26.2),
    "proposed": (10.8, 18.4),
}
"""Table 4, largest less smallest: x and y, mm."""


def still(ids: np.ndarray, seed: int, sigma_stamp: float, base: float, slow: float, tau: float) -> RecordingFolder:
    """Tags at rest with an IMU: ranges to three anchors, what trilateration makes of them, and IMU samples.

    `sigma_stamp` s, of a time stamp; `base` m, between the two anchors on one side; `slow` m and `tau` s, of the slow
    errors of these two.
    """
    anchors = np.array([[0.0, 2.5 - base / 2, 2.5], [0.0, 2.5 + base / 2, 2.5], [5.0, 2.5, 2.5]])
    world = simulate_uwb_imu(
        chamber(anchors),
        lambda keys, times: np.tile(TAG, (len(keys), len(times), 1)),
        len(ids),
        seed,
        rate_hz=RATE_HZ,
        n_points=SETTLING + SCORED,
        protocol=Protocol(sigma_stamp=sigma_stamp),
        corruptions={"slow": on_anchors(ONE_SIDE, gauss_markov(slow, tau))},
        accel={"bias": constant_bias(0.1), "noise": white_density(SIGMA_ACCEL)},
        gyro={"bias": constant_bias(0.01), "noise": white_density(0.002)},
        attitude=level,
        ids=ids,
    )
    return fixes_from_ranges(world.folder("still tag"), "trilateration")


def settled(tracked: TrackedRuns) -> list[np.ndarray]:
    """The last 380 places (380, 2), m, of every tag."""
    return [e[k][-SCORED:, :2] for e, k in zip(tracked.estimates, tracked.known, strict=True)]


def _spread(axis: int) -> Callable[[TrackedRuns], np.ndarray]:
    return lambda tracked: np.array([np.ptp(places[:, axis]) for places in settled(tracked)])


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """Table 4."""
    found: list[ExpectedResult | Conclusion] = []
    for name, printed in PRINTED.items():
        for axis, number in zip("xy", printed, strict=True):
            ours = results.value(f"spread_{axis}_m", "still", name).times(1e3)
            found.append(ExpectedResult(f"Table 4, {name}, {axis}", number, ours, "mm", FITTED))
    order = list(PRINTED)
    less = [
        results.difference(f"spread_{axis}_m", "still", after, before).high < 0
        for before, after in pairwise(order)
        for axis in "xy"
    ]
    listed = ", ".join(f"{n} {results.value('spread_x_m', 'still', n).value * 1e3:.1f} mm" for n in order)
    says = "raw > moving average > Kalman > proposed, in x and in y"
    return [*found, Conclusion(says, all(less), f"in x {listed}", inherited(FITTED))]


def figure_10(results: Results, folder: Path) -> list[str]:
    """The estimates of the first tag."""
    runs = tracked_runs(results.study, "still", np.arange(1))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(2, 1, sharex=True)
        for colour, name in zip((GREY, GREEN, BLUE, VERMILION), PRINTED, strict=True):
            run = runs[name]
            last = np.append(np.diff(run.times[0]) > 0, True) & (run.times[0] >= SETTLING / RATE_HZ)
            for axes, values, letter in zip(panels, run.estimates[0, last].T, "xy", strict=False):
                axes.plot(run.times[0, last], 1e3 * values, color=colour, label=name)
                axes.axhline(1e3 * TAG[0], color=BLACK, linewidth=0.6)
                axes.set_title(f"{letter}, mm")
        panels[1].set_xlabel("time, s")
        figure.legend(*panels[0].get_legend_handles_labels(), ncols=4, loc="outside lower center")
        for axes in panels:
            plain(axes)

    return [write_svg(folder, "figure_10.svg", draw, height=2 * HEIGHT)]


def configs(sigma_a: float) -> dict[str, TrackerConfig]:
    """The paper's four; σa of the Kalman filter, m/s² per √Hz."""
    kalman = {
        "motion.sigma_a": sigma_a,
        "sensors.fixes.sigma_horizontal": SIGMA_RANGE,
        "sensors.fixes.dof": 1e3,
    }
    proposed = {
        "motion.noise.sigma_accel": SIGMA_ACCEL,
        "motion.noise.sigma_accel_walk": 1e-4,
        "sensors.ranges.sigma_r": SIGMA_RANGE,
        # Nothing is in the way: normal noise.
        "sensors.ranges.positive_skew": 1.0,
        "sensors.ranges.dof": 1e3,
        "sensors.ranges.bias": np.zeros(3),
    }
    return {
        "proposed": TrackerConfig("uwb-imu", proposed, every=1 / RATE_HZ),
        "raw": TrackerConfig(RAW),
        "moving average": TrackerConfig(window(WINDOW)),
        "Kalman": TrackerConfig("fix-kf", kalman),
    }


def study_with(numbers: dict[str, float], runs: int = 200, seed: int = 1) -> Study:
    """The study with these numbers of the world and of the Kalman filter; other tags than the fit's, of seed 0."""
    return Study(
        name="table-4",
        about="Table 4 and Figure 10 of Kwon et al. 2021: how far the estimates of a still tag spread",
        worlds={"still": World(still, {k: v for k, v in numbers.items() if k != "sigma_a"})},
        trackers=configs(numbers["sigma_a"]),
        runs=runs,
        seed=seed,
        measures={f"spread_{axis}_m": _spread(k) for k, axis in enumerate("xy")},
        metrics=("spread_x_m", "spread_y_m", "rmse_m", "nis_ratio"),
        expected=expected,
        draw=figure_10,
    )


STUDY = study_with(fitted("kwon_2021/table_4"))
