"""Effect of the confidence compensation (14) of Kwon et al. 2021 on trilateration, with and without line of sight.

Tags at a known height among the chamber's four anchors, with line of sight and with anchors hidden for a third of the
time. Compared: trilateration with and without (14), least squares on all four ranges, and the filter. J of (15), whose
unit is not printed, is taken as the standard deviation of a range. Time stamps of 0.1 ns, biases of 3 cm.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import CONSTANT_BIASES
from trackwright.experiments.text.expectations import fixed_interval
from trackwright.sim.corruptions import Corruption
from trackwright.sim.paths import hand_motion
from trackwright.sim.ranging import WALK_VOLUME, antenna_biases, chamber, obstruction, simulate_ranges
from trackwright.trackers.recordings.folder import RecordingFolder

FLOOR = WALK_VOLUME * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.2]
SETTLED_S = 5.0
"""Seconds at the beginning that are not scored, while the filter estimates its biases."""


def walk(ids: np.ndarray, seed: int, hidden: float = 0.0, rows: int = 300) -> RecordingFolder:
    """Tags with `rows` rows of four ranges each, ten rows a second, anchors hidden for a fraction of the time."""
    pieces: dict[str, Corruption] = {"biases": antenna_biases(0.03)}
    if hidden:
        pieces["hidden"] = obstruction(hidden, 2.0, 0.2, 0.15)
    path = partial(hand_motion, volume=FLOOR, speed=0.5)
    world = simulate_ranges(chamber(), path, ids, seed, n_points=rows, corruptions=pieces)
    return world.folder("chamber")


def settled(tracked: mc.TrackedRuns) -> np.ndarray:
    """The root mean square of the horizontal errors after the first seconds."""
    size = np.linalg.norm(tracked.error[..., :2], axis=-1)
    return np.asarray(np.sqrt(np.nanmean(np.where(tracked.times >= SETTLED_S, size, np.nan) ** 2, axis=1)))


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Effect of (14), which the paper claims without a figure, and of the fourth range."""
    for world in results.study.worlds:
        more = results.difference("settled_rmse_m", world, "with (14)", "trilateration").times(100)
        yield mc.Conclusion(
            f"{world}: lengthening every range by (14) prevents errors",
            more.high < 0,
            f"RMSE with (14) less without: {fixed_interval(more, '+.1f', ' cm')}",
            mc.PREDICTED,
        )
    for world in results.study.worlds:
        less = results.difference("settled_rmse_m", world, "least squares", "trilateration").times(100)
        yield mc.Conclusion(
            f"{world}: all four ranges are better than three",
            less.high < 0,
            f"RMSE of least squares less that of trilateration: {less.value:+.1f} cm",
            mc.PREDICTED,
        )


STUDY = mc.Study(
    name="trilateration",
    about="What the confidence compensation (14) of Kwon et al. 2021 does to trilateration",
    worlds={"line of sight": mc.World(walk), "hidden for a third": mc.World(walk, {"hidden": 1 / 3})},
    trackers={
        "trilateration": mc.TrackerConfig("trilateration"),
        "with (14)": mc.TrackerConfig("trilateration-compensated"),
        "least squares": mc.TrackerConfig("multilateration"),
        "filter": mc.TrackerConfig("uwb", CONSTANT_BIASES),
    },
    runs=100,
    measures={"settled_rmse_m": settled},
    metrics=("settled_rmse_m", "median_m", "p95_m"),
    expected=expected,
)
