"""The optimum of a simulated world: the filter, and the most probable path, with the levels that it was drawn with."""

from __future__ import annotations

import numpy as np

from trackwright.experiments.lab.benchmark.adapters import plain, robust_map
from trackwright.experiments.lab.benchmark.motion import Levels, Path
from trackwright.experiments.lab.benchmark.problems import NotRead, Problem
from trackwright.experiments.lab.benchmark.worlds import WORLDS


def filtered(problem: Problem, levels: None) -> Path:
    """The filtered path of a tag; raises NotRead for a recording."""
    return plain.estimate(problem, _drawn_with(problem))


def smoothed(problem: Problem, levels: None) -> Path:
    """The most probable path of a tag; raises NotRead for a recording."""
    return robust_map.estimate(problem, _drawn_with(problem), np.inf)


def _drawn_with(problem: Problem) -> Levels:
    name = problem.folder.name
    if name not in WORLDS:
        raise NotRead(f"{name}: is no simulated world, whose levels are known")
    return WORLDS[name].levels
