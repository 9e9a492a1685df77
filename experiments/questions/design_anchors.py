"""Four anchors in a hall: in its corners, on a grid, and where the gradient of the Cramér–Rao bound puts them.

Two anchors stand low, two high, on the walls of a hall of 30 m × 10 m; tags move in it 0.8 m to 1.8 m high. The layouts
are those of `python -m experiments.questions.fit_design_anchors`: nothing printed was used. Whether a lower bound makes a
better tracker is seen on tracks: a filter's errors fall as the bound of one epoch does. Multilateration, which forgets
everything from row to row and with four ranges can take a wrong place for the right one, gains less: a bound is of
small errors alone.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from experiments.monte_carlo.declaration import Study, TrackerConfig, World
from experiments.monte_carlo.expectations import Conclusion, ExpectedResult
from experiments.monte_carlo.results import Results
from experiments.plots.style import BLACK, VERMILION
from experiments.questions._design_pictures import maps
from experiments.questions._designs import (
    HALL,
    LAYOUTS,
    SIGMA_R,
    TAGS,
    against_grid,
    bound_map,
    designs,
    fall,
    hall,
    squares,
)
from sim.corruptions import white_noise
from sim.paths import hand_motion
from sim.ranging import Protocol, chamber, simulate_ranges
from trackers.recordings.folder import RecordingFolder

DESIGNS = designs("anchors")
EXACT = Protocol(drift=0.0, sigma_stamp=0.0)
HEIGHT = 1.3


def walks(ids: np.ndarray, seed: int, layout: str) -> RecordingFolder:
    """Tags that move through the hall at 0.7 m/s, ranged by all four anchors ten times a second."""
    path = partial(hand_motion, volume=TAGS, speed=0.7)
    world = simulate_ranges(
        chamber(DESIGNS[layout].places), path, len(ids), seed, rate_hz=10.0, n_points=200, protocol=EXACT,
        corruptions={"white": white_noise(SIGMA_R)}, ids=ids,
    )  # fmt: skip
    return world.folder("hall")


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """The gradient against the grid, and tracks against bounds."""
    usual, grid, gradient = (DESIGNS[layout] for layout in LAYOUTS)
    bound, found = gradient.bound / usual.bound, fall(results, "uwb", "gradient")
    median, rmse = (
        results.value(figure, "gradient", "multilateration").value
        / results.value(figure, "default", "multilateration").value
        for figure in ("median_3d_m", "rmse_3d_m")
    )
    return [
        against_grid(usual, grid, gradient),
        Conclusion(
            "the filter's RMSE falls as the bound of an epoch does, within 10 %",
            abs(found.value / bound - 1) < 0.10,
            f"RMSE to {found.value:.3f} [{found.low:.3f}, {found.high:.3f}] of the corners', bound to {bound:.3f}",
        ),
        Conclusion(
            "so does the median without a filter, within 10 %, where its largest errors do not",
            abs(median / bound - 1) < 0.10 and rmse > median,
            f"multilateration's median to {median:.3f}, its RMSE to {rmse:.3f}: four ranges have wrong solutions too",
        ),
    ]


def draw(results: Results, folder: Path) -> list[str]:
    """The three layouts over a map of their bounds at the height of a tool in the hand."""
    x, y = np.linspace(0, HALL[1, 0], 61), np.linspace(0, HALL[2, 1], 21)
    grid = np.stack([a.ravel() for a in np.meshgrid(x, y, [HEIGHT], indexing="ij")], axis=1)
    layout = hall()
    fields = {}
    for name, design in DESIGNS.items():
        fields[name] = bound_map(layout, layout.theta(design.places), grid).reshape(len(x), len(y))

    def anchors(axes: Axes, name: str) -> None:
        for px, py, pz in DESIGNS[name].places:
            high = pz > HEIGHT
            axes.plot(px, py, "^" if high else "v", color=VERMILION if high else BLACK, markersize=8, clip_on=False)

    return [
        maps(
            folder, "layouts.svg", fields, x, y, anchors, "Bound in the hall, and anchors: ▲ high, ▼ low", stacked=True
        )
    ]


TOLD = {
    "sensors.ranges.sigma_r": SIGMA_R,
    "sensors.ranges.positive_skew": 1.0,
    "sensors.ranges.dof": 30.0,
    "sensors.ranges.bias": [0.0] * 8,
    "motion.sigma_bias": 0.002,
    "start.sigma_bias": 0.002,
}
"""The noise of this world, which has no biases."""

STUDY = Study(
    name="design-anchors",
    about="Where four anchors must stand in a hall: corners, grid and gradient, by their bounds and on tracks",
    worlds={layout: World(walks, {"layout": layout}) for layout in LAYOUTS},
    trackers={
        "uwb": TrackerConfig("uwb", TOLD),
        "multilateration": TrackerConfig("multilateration", {"sigma_r": SIGMA_R}),
    },
    runs=100,
    measures={"square_3d_m2": squares},
    metrics=("rmse_3d_m", "median_3d_m", "p95_3d_m", "rmse_m"),
    expected=expected,
    draw=draw,
)
