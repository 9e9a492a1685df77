"""Four anchors in a hall: in its corners, on the best grid points, and at a minimum of the Cramér–Rao bound.

Two low and two high anchors stand on the walls of a hall of 30 m × 10 m; tags move 0.8 m to 1.8 m above the floor. The
layouts were found by `python -m experiments.lab.questions.fit_design_anchors`; no printed number was used. The study
tests whether a lower bound improves tracking. The errors of a filter decrease in proportion to the bound of one epoch.
Those of multilateration, which has no memory, decrease less: with four ranges it sometimes converges to the wrong
solution, and the bound holds for small errors only.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from experiments.lab.papers.constant_biases import CONSTANT
from experiments.lab.questions._designs import (
    HALL,
    LAYOUTS,
    SIGMA_R,
    TAGS,
    against_grid,
    bound_map,
    designs,
    hall,
    maps,
    mean_square,
    rmse_ratio,
)
from experiments.monte_carlo import PREDICTED, Conclusion, ExpectedResult, Results, Study, TrackerConfig, World
from experiments.pages.plots.style import BLACK, VERMILION
from sim.corruptions import white_noise
from sim.paths import hand_motion
from sim.ranging import Protocol, chamber, simulate_ranges
from trackers.recordings.folder import RecordingFolder

DESIGNS = designs("anchors")
EXACT = Protocol(drift=0.0, sigma_stamp=0.0)
HEIGHT = 1.3


def walks(ids: np.ndarray, seed: int, layout: str) -> RecordingFolder:
    """Tags that move through the hall at 0.7 m/s, with ranges to all four anchors ten times a second."""
    path = partial(hand_motion, volume=TAGS, speed=0.7)
    world = simulate_ranges(
        chamber(DESIGNS[layout].positions), path, len(ids), seed, rate_hz=10.0, n_points=200, protocol=EXACT,
        corruptions={"white": white_noise(SIGMA_R)}, ids=ids,
    )  # fmt: skip
    return world.folder("hall")


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """Search by gradient against the grid, and errors of trackers against bounds."""
    default, _, gradient = (DESIGNS[layout] for layout in LAYOUTS)
    bound, found = gradient.bound / default.bound, rmse_ratio(results, "uwb", "gradient")
    median, rmse = (
        results.value(metric, "gradient", "multilateration").value
        / results.value(metric, "default", "multilateration").value
        for metric in ("median_3d_m", "rmse_3d_m")
    )
    return [
        against_grid("anchors"),
        Conclusion(
            "the filter's RMSE decreases in proportion to the bound of an epoch, within 10 %",
            abs(found.value / bound - 1) < 0.10,
            f"ratio to the corners: RMSE {found.value:.3f} [{found.low:.3f}, {found.high:.3f}], bound {bound:.3f}",
            PREDICTED,
        ),
        Conclusion(
            "the median error without a filter does so too, within 10 %, its RMSE does not",
            abs(median / bound - 1) < 0.10 and rmse > median,
            f"multilateration: median {median:.3f}, RMSE {rmse:.3f}, since four ranges also have wrong solutions",
            PREDICTED,
        ),
    ]


def draw(results: Results, folder: Path) -> list[str]:
    """Map of the bound for each layout, 1.3 m above the floor, with its anchors."""
    x, y = np.linspace(0, HALL[1, 0], 61), np.linspace(0, HALL[2, 1], 21)
    grid = np.stack([a.ravel() for a in np.meshgrid(x, y, [HEIGHT], indexing="ij")], axis=1)
    layout = hall()
    fields = {}
    for name, design in DESIGNS.items():
        fields[name] = bound_map(layout, layout.theta(design.positions), grid).reshape(len(x), len(y))

    def anchors(axes: Axes, name: str) -> None:
        for px, py, pz in DESIGNS[name].positions:
            high = pz > HEIGHT
            axes.plot(px, py, "^" if high else "v", color=VERMILION if high else BLACK, markersize=8, clip_on=False)

    return [
        maps(
            folder, "layouts.svg", fields, x, y, anchors, "Bound in the hall, and anchors: ▲ high, ▼ low", stacked=True
        )
    ]


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

STUDY = Study(
    name="design-anchors",
    about="Which positions of four anchors in a hall give the smallest errors? Corners, grid and gradient compared",
    worlds={layout: World(walks, {"layout": layout}) for layout in LAYOUTS},
    trackers={
        "uwb": TrackerConfig("uwb", NOISE),
        "multilateration": TrackerConfig("multilateration", {"sigma_r": SIGMA_R}),
    },
    runs=100,
    measures={"square_3d_m2": mean_square},
    metrics=("rmse_3d_m", "median_3d_m", "p95_3d_m", "rmse_m"),
    expected=expected,
    draw=draw,
)
