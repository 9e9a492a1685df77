"""Noise levels of the estimators that our trackers are compared with, on the recordings that set our own defaults."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from itertools import product

import numpy as np
import polars as pl

from trackwright.experiments.lab.benchmark.adapters import plain, robust_map, with_filterpy
from trackwright.experiments.lab.benchmark.data import beginning_of, folder_of
from trackwright.experiments.lab.benchmark.declaration import DEVELOPMENT
from trackwright.experiments.lab.benchmark.motion import Levels, Path
from trackwright.experiments.lab.benchmark.problems import Problem, problems
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen, shown
from trackwright.trackers.recordings.truth import TruePaths

GROUPS: dict[str, Callable[[Problem, Levels], Path]] = {
    "plain": plain.estimate,
    "gated": with_filterpy.estimate,
    "smoothed": partial(robust_map.estimate, dof=np.inf),
    "robust": robust_map.estimate,
}
"""The estimator whose errors choose the levels of its group."""

ACCELERATIONS = (0.1, 0.3, 1.0)
READINGS = (0.1, 0.2, 0.4, 0.8)

MOST_READINGS = 500
"""Readings of a recording, from its beginning."""


def peer_levels(*, kind: tuple[str, ...] = (), output: Output = DEFAULTS) -> int:
    """Levels of other estimators: least geometric mean of the horizontal RMSE over the development recordings.

    Args:
        kind: of readings, all by default.
    """
    kinds = chosen(kind, DEVELOPMENT)
    rows = shown(row for name in kinds for row in _of_kind(name, output.small))
    output.publish("validation peer-levels", Table(rows))
    return 0


def _of_kind(kind: str, small: bool) -> Iterator[Row]:
    folders = [beginning_of(folder_of(name), MOST_READINGS) for name in DEVELOPMENT[kind]]
    given = [[(p, _truth(p)) for p in problems(folder)] for folder in folders]
    groups = {name: f for name, f in GROUPS.items() if name != "gated" or find_spec("filterpy")}
    for group, estimate in groups.items():
        grid = [Levels(*pair) for pair in product(ACCELERATIONS, READINGS)]
        means = {levels: _mean(given, estimate, levels) for levels in grid[:: 8 if small else 1]}
        best = min(means, key=means.__getitem__)
        yield {
            "readings": kind, "group": group, "acceleration": best.acceleration, "reading": best.reading,
            "RMSE, m": means[best],
        }  # fmt: skip


def _truth(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """The true x and y at the times of the readings (N, 2), and where they are known."""
    truth = problem.folder.tables["truth"].filter(pl.col("tag").cast(pl.String) == problem.tag)
    paths = TruePaths.of_table(truth, problem.folder.name)
    places, _ = paths.at([problem.tag], np.array([0, len(problem.times)]), problem.times)
    return places[:, :2], np.isfinite(places[:, 0])


def _mean(given: list, estimate: Callable[[Problem, Levels], Path], levels: Levels) -> float:
    logs = []
    for tags in given:
        squares = []
        for problem, (truth, known) in tags:
            try:
                positions = estimate(problem, levels).positions[:, :2]
            except np.linalg.LinAlgError:
                return np.inf
            squares.append(np.sum((positions - truth)[known] ** 2, axis=1))
        logs.append(0.5 * np.log(np.mean(np.concatenate(squares))))
    return float(np.exp(np.mean(logs)))
