"""The papers' way to tune: an objective over a grid of values of one or two numbers, each tried as it is.

The assembly-line thesis (2.7 and chapter 3) varies the dynamic noise over 0 … 100 cm and takes the value of least
RMSE over all its recordings, ten runs of the particle filter each. Here many values run in one compiled call, forward
only: a sweep needs no derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from trackers.core.chunks import CHUNK
from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker
from tuning.objectives import AbstractObjective
from tuning.parameters import TIED, Parameter, select_parameters
from tuning.problem import Problem

AT_ONCE = 32
"""Values that are filtered before progress is told."""


@dataclass(frozen=True)
class Sweep:
    """An objective over a grid: `values` (repeats, n) or (repeats, n, m) at `grids`, physical, one for each parameter.

    NaN where a trajectory gave no finite figure. `filter_runs`: trajectories filtered for it.
    """

    parameters: list[Parameter]
    grids: list[np.ndarray]
    values: np.ndarray
    filter_runs: int

    @property
    def mean(self) -> np.ndarray:
        """The mean over repeats, on the grid."""
        return self.values.mean(axis=0)

    @property
    def spread(self) -> np.ndarray:
        """The standard deviation over repeats, on the grid; zero where there is one."""
        return self.values.std(axis=0, ddof=1) if len(self.values) > 1 else np.zeros(self.values.shape[1:])

    @property
    def best_index(self) -> tuple[int, ...]:
        """Where on the grid the mean is least."""
        return tuple(int(k) for k in np.unravel_index(np.nanargmin(self.mean), self.mean.shape))

    @property
    def best(self) -> dict[str, float]:
        """The physical values of least mean, by the parameters' labels."""
        places = zip(self.parameters, self.grids, self.best_index, strict=True)
        return {p.label: float(grid[k]) for p, grid, k in places}


def swept_parameters(tracker: AbstractTracker, patterns: Sequence[str]) -> list[Parameter]:
    """A parameter for each pattern, of all that it names, kept equal; raises ValueError as `sweep` does."""
    if not 1 <= len(patterns) <= 2:
        raise ValueError(f"a sweep goes over one or two patterns, found {len(patterns)}")
    parameters = select_parameters(tracker, [p if p.startswith(TIED) else TIED + p for p in patterns])
    if len(parameters) < len(patterns):
        raise ValueError(f"the patterns {' and '.join(patterns)} name the same tunables")
    return parameters


def grid_vectors(parameters: Sequence[Parameter], grids: Sequence[np.ndarray]) -> np.ndarray:
    """The unconstrained vectors (points, p) of all points of the grid, the last parameter's values fastest.

    A parameter of several numbers takes a value in all of them. Raises ValueError for a value outside its constraint.
    """
    columns = []
    for parameter, mesh in zip(parameters, np.meshgrid(*grids, indexing="ij"), strict=True):
        shape = np.shape(parameter.example.raw)
        try:
            held = [parameter.example.with_value(np.full(shape, value)) for value in mesh.ravel()]
        except ValueError as error:
            raise ValueError(f"{parameter.label}: {error}") from error
        columns.append([np.ravel(node.raw) for node in held])
    return np.concatenate([np.asarray(c, float) for c in columns], axis=1)


def sweep(
    tracker: AbstractTracker,
    batches: Batch | Sequence[Batch],
    objective: AbstractObjective,
    over: Mapping[str, np.ndarray],
    repeats: int = 1,
    chunk: int = CHUNK,
    report: Callable[[int], None] = lambda points: None,
) -> Sweep:
    """The objective at every point of the grid that `over` spans: one or two patterns of tunables, and their values.

    What a pattern names is kept equal. A tracker that draws random numbers runs `repeats` times with other keys, one
    that doesn't runs once. `report` counts points of the grid done, a repeat being a fresh set of them. Raises
    ValueError for a pattern that names nothing or what can't be kept equal, for values outside a constraint, and for
    other than one or two patterns.
    """
    parameters = swept_parameters(tracker, list(over))
    grids = [np.asarray(values, float) for values in over.values()]
    problem = Problem(tracker, [batches] if isinstance(batches, Batch) else batches, objective, parameters, chunk)
    points = grid_vectors(parameters, grids)
    repeats = repeats if problem.random else 1
    values = np.stack([comparable_values(problem, points, turn, report) for turn in range(repeats)])
    return Sweep(parameters, grids, values.reshape(repeats, *map(len, grids)), problem.filter_runs)


def comparable_values(
    problem: Problem, points: np.ndarray, turn: int = 0, report: Callable[[int], None] = lambda points: None
) -> np.ndarray:
    """The objective (S,) at unconstrained vectors (S, p), without derivatives; another turn has other random numbers.

    A trajectory that is finite at none of the vectors is left out; one that is finite at some makes the others NaN,
    since figures over different trajectories can't be compared.
    """
    found = []
    for first in range(0, len(points), AT_ONCE):
        found.append(problem.terms(points[first : first + AT_ONCE], turn))
        report(len(found[-1]))
    every = np.concatenate(found)
    finite = np.isfinite(every).all(axis=1)
    return problem.figures(every[..., finite.any(axis=0)].sum(axis=-1))
