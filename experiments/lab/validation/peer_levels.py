"""Noise levels of the estimators that our trackers are compared with, on the recordings that set our own defaults.

A search on a grid without edges: from its start to the best neighbour, until none is better.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from itertools import product

import numpy as np
import polars as pl

from trackwright.experiments.lab.benchmark.adapters import plain, robust_map, with_filterpy
from trackwright.experiments.lab.benchmark.data import folder_of
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

START, STEPS = Levels(0.3, 0.2), (3.0, 2.0)
"""Where the search begins, and the factors between neighbours on its grid."""

SPAN = 4
"""Most steps from the start in each direction."""


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
    folders = [folder_of(name) for name in DEVELOPMENT[kind]]
    given = [[(p, _truth(p)) for p in problems(folder)] for folder in folders]
    groups = {name: f for name, f in GROUPS.items() if name != "gated" or find_spec("filterpy")}
    for group, estimate in groups.items():
        best, tried = searched(partial(_mean, given, estimate), 0 if small else SPAN)
        levels = levels_at(*best)
        yield {
            "readings": kind, "group": group, "acceleration": levels.acceleration, "reading": levels.reading,
            "RMSE, m": tried[best], "tried": len(tried), "at the end of the span": SPAN in map(abs, best),
        }  # fmt: skip


Place = tuple[int, int]
"""Steps from the start, of accelerations and of readings."""


def levels_at(acceleration: int, reading: int) -> Levels:
    """The levels at a place of the grid, rounded to two digits."""
    each = zip(START, STEPS, (acceleration, reading), strict=True)
    return Levels(*(float(f"{start * factor**steps:.2g}") for start, factor, steps in each))


def searched(mean: Callable[[Levels], float], span: int) -> tuple[Place, dict[Place, float]]:
    """The place than which no neighbour has a smaller mean, and the means of all places tried."""
    best, tried = (0, 0), {(0, 0): mean(START)}
    while True:
        near = [(best[0] + i, best[1] + j) for i, j in product((-1, 0, 1), repeat=2)]
        for place in near:
            if place not in tried and max(map(abs, place)) <= span:
                tried[place] = mean(levels_at(*place))
        found = min(tried, key=tried.__getitem__)
        if found == best:
            return best, tried
        best = found


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
