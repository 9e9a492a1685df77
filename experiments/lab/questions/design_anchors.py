"""Four anchors in a hall: in its corners, on the best grid points, and at a minimum of the Cramér–Rao bound.

Two low and two high anchors stand on the walls of a hall of 30 m × 10 m; tags move 0.8 m to 1.8 m above the floor. The
layouts were searched beforehand (`fit`), by gradient from 48 random starts, and exhaustively on a grid: twelve
positions along the walls at the limits of both height bands, 76,176 layouts; no printed number was used. The study
tests whether a lower bound improves tracking. The errors of a filter decrease in proportion to the bound of one epoch.
Those of multilateration, which has no memory, decrease less: with four ranges it sometimes converges to the wrong
solution, and the bound holds for small errors only.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import combinations

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import CONSTANT, plot
from trackwright.experiments.lab.papers.fitting import Fitted
from trackwright.experiments.lab.questions import _designs as of
from trackwright.experiments.lab.questions._designs import LAYOUTS, SIGMA_R
from trackwright.experiments.pages.charts.style import BLACK, VERMILION
from trackwright.sim.corruptions import white_noise
from trackwright.sim.paths import hand_motion
from trackwright.sim.ranging import Protocol, chamber, simulate_ranges
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.design import SearchResult, descend, exhaust

DESIGNS = of.designs("anchors")
EXACT = Protocol(drift=0.0, sigma_stamp=0.0)
HEIGHT = 1.3


def walks(ids: np.ndarray, seed: int, layout: str) -> RecordingFolder:
    """Tags that move through the hall at 0.7 m/s, with ranges to all four anchors ten times a second."""
    path = partial(hand_motion, volume=of.TAGS, speed=0.7)
    world = simulate_ranges(
        chamber(DESIGNS[layout].positions), path, ids, seed, rate_hz=10.0, n_points=200, protocol=EXACT,
        corruptions={"white": white_noise(SIGMA_R)},
    )  # fmt: skip
    return world.folder("hall")


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Search by gradient against the grid, and errors of trackers against bounds."""
    default, _, gradient = (DESIGNS[layout] for layout in LAYOUTS)
    bound, ratio = gradient.bound / default.bound, of.rmse_ratio(results, "uwb", "gradient")
    median, rmse = (
        results.value(metric, "gradient", "multilateration").value
        / results.value(metric, "default", "multilateration").value
        for metric in ("median_3d_m", "rmse_3d_m")
    )
    yield of.against_grid("anchors")
    yield mc.Conclusion(
        "the filter's RMSE decreases in proportion to the bound of an epoch, within 10 %",
        abs(ratio.value / bound - 1) < 0.10,
        f"ratio to the corners: RMSE {ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}], bound {bound:.3f}",
        mc.PREDICTED,
    )
    yield mc.Conclusion(
        "the median error without a filter does so too, within 10 %, its RMSE does not",
        abs(median / bound - 1) < 0.10 and rmse > median,
        f"multilateration: median {median:.3f}, RMSE {rmse:.3f}, since four ranges also have wrong solutions",
        mc.PREDICTED,
    )


def bounds(results: mc.Results, figure: Figure) -> None:
    """Map of the bound for each layout, 1.3 m above the floor, with its anchors."""
    axes = np.linspace(0, of.HALL[1, 0], 61), np.linspace(0, of.HALL[2, 1], 21), HEIGHT

    def anchors(panel: Axes, design: of.Design) -> None:
        for x, y, z in design.positions:
            high = z > HEIGHT
            panel.plot(x, y, "^" if high else "v", color=VERMILION if high else BLACK, markersize=8, clip_on=False)

    of.maps(of.hall(), DESIGNS, axes, anchors, "Bound in the hall, and anchors: ▲ high, ▼ low", True, figure)


NOISE = {
    "sensors.ranges.sigma_r": SIGMA_R,
    "sensors.ranges.positive_skew": 1.0,
    "sensors.ranges.dof": 30.0,
    "sensors.ranges.bias": [0.0] * 8,
    "motion.sigma_a": 0.3,
    "motion.memory": 5.0,
    "motion.sigma_bias": 0.002,
    "start.sigma_bias": 0.002,
} | CONSTANT
"""Tunables that agree with the noise of this world, which has no biases."""

STUDY = mc.Study(
    name="design-anchors",
    about="Which positions of four anchors in a hall give the smallest errors? Corners, grid and gradient compared",
    worlds={layout: mc.World(walks, {"layout": layout}) for layout in LAYOUTS},
    trackers={
        "uwb": mc.TrackerConfig("uwb", NOISE),
        "multilateration": mc.TrackerConfig("multilateration", {"sigma_r": SIGMA_R}),
    },
    runs=100,
    measures={"square_3d_m2": of.mean_square},
    metrics=("rmse_3d_m", "median_3d_m", "p95_3d_m", "rmse_m"),
    expected=expected,
    draw=plot("layouts.svg", bounds, 7.0, 6.0),
)


STARTS, STEPS, RATE = 48, 150, 0.05
POSITIONS = 12


def fit() -> tuple[str, dict[str, Fitted]]:
    """Both searches, in double precision."""
    with jax.enable_x64(True):
        layout = of.hall()
        objective = layout.objective(of.TAG_POINTS)
        starts = np.random.default_rng(0).random((STARTS, *layout.shape))
        choices = np.array([(k / POSITIONS, z) for k in range(POSITIONS) for z in (0.0, 1.0)])
        pairs = list(combinations(range(len(choices)), 2))
        searches = {
            "default": SearchResult(of.default_hall(), 0.0, 0),
            "grid": exhaust(objective, choices, (low + high for low in pairs for high in pairs)),
            "gradient": descend(objective, layout.project, starts, STEPS, RATE),
        }
        return of.searched(layout, of.TAG_POINTS, searches)
