"""Grid search: an objective over a grid of values of one or two parameters, without derivatives.

The assembly-line thesis (2.7 and chapter 3) tunes this way: it varies the dynamic noise over 0 … 100 cm and takes the
value of least RMSE over all recordings, ten runs of the particle filter each. Here a compiled call has many values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.parameters import TIED, Parameter, select_parameters
from trackwright.tuning.problem import Problem

POINTS_PER_REPORT = 32  # grid points between two progress reports


@dataclass(frozen=True)
class Sweep:
    """An objective over a grid: `values` (repeats, n) or (repeats, n, m) at the physical `grids`, one per parameter.

    NaN where a trajectory's objective is not finite. `filter_runs`: number of trajectories filtered.
    """

    parameters: list[Parameter]
    grids: list[Float[np.ndarray, " _"]]
    values: Float[np.ndarray, "repeats n *m"]
    filter_runs: int

    @property
    def mean(self) -> Float[np.ndarray, "n *m"]:
        """The mean over repeats, on the grid."""
        return self.values.mean(axis=0)

    @property
    def spread(self) -> Float[np.ndarray, "n *m"]:
        """The standard deviation over repeats, on the grid; zero for a single repeat."""
        return self.values.std(axis=0, ddof=1) if len(self.values) > 1 else np.zeros(self.values.shape[1:])

    @property
    def best_index(self) -> tuple[int, ...]:
        """The grid index of the least mean."""
        return tuple(int(k) for k in np.unravel_index(np.nanargmin(self.mean), self.mean.shape))

    @property
    def best(self) -> dict[str, float]:
        """The physical values of least mean, by the parameters' labels."""
        points = zip(self.parameters, self.grids, self.best_index, strict=True)
        return {p.label: float(grid[k]) for p, grid, k in points}

    def to_polars(self, objective: str = "objective") -> pl.DataFrame:
        """One row per grid point: swept values, mean objective, and of several runs its spread and each value."""
        mesh = np.meshgrid(*self.grids, indexing="ij")
        columns = {p.label: values for p, values in zip(self.parameters, mesh, strict=True)} | {objective: self.mean}
        if len(self.values) > 1:
            columns |= {"spread": self.spread} | {f"repeat_{k + 1}": values for k, values in enumerate(self.values)}
        return pl.DataFrame({name: values.ravel() for name, values in columns.items()}).fill_nan(None)

    def text(self, objective: str = "objective", unit: str = "") -> str:
        """The best point in lines."""
        at, repeats, lines = self.best_index, len(self.values), list[str]()
        for parameter, grid, k in zip(self.parameters, self.grids, at, strict=True):
            end = "; at the end of the grid: widen it" if len(grid) > 2 and k in (0, len(grid) - 1) else ""
            shown = "" if parameter.example.unit == "1" else f" {parameter.example.unit}"
            lines.append(f"best {parameter.label} = {grid[k]:.6g}{shown}{end}")
        spread = f" ± {self.spread[at]:.2g} over {repeats} repeats" if repeats > 1 else ""
        lines.append(f"{objective} = {self.mean[at]:.6g}{' ' if unit else ''}{unit}{spread}")
        if undefined := int(np.sum(~np.isfinite(self.mean))):
            lines.append(f"undefined: {undefined} of {self.mean.size} grid points, where a trajectory is not finite")
        return "\n".join(lines)


def swept_parameters(tracker: AbstractTracker, patterns: Sequence[str]) -> list[Parameter]:
    """One parameter per pattern, with all its matches tied; raises ValueError as `sweep` does."""
    if not 1 <= len(patterns) <= 2:
        raise ValueError(f"a sweep goes over one or two patterns, found {len(patterns)}")
    parameters = select_parameters(tracker, [p if p.startswith(TIED) else TIED + p for p in patterns], thresholds=True)
    if len(parameters) < len(patterns):
        raise ValueError(f"the patterns {' and '.join(patterns)} match the same tunables")
    return parameters


def grid_vectors(
    parameters: Sequence[Parameter], grids: Sequence[Float[np.ndarray, " _"]]
) -> Float[np.ndarray, "points p"]:
    """The unconstrained vectors (points, p) of all grid points, with the last parameter varying fastest.

    All numbers of a parameter get the same value. Raises ValueError for a value outside the parameter's constraint.
    """
    columns = []
    for parameter, mesh in zip(parameters, np.meshgrid(*grids, indexing="ij"), strict=True):
        try:
            nodes = [parameter.example.with_value(np.full(parameter.shape, value)) for value in mesh.ravel()]
        except ValueError as error:
            raise ValueError(f"{parameter.label}: {error}") from error
        columns.append([np.ravel(node.raw) for node in nodes])
    return np.concatenate([np.asarray(c, float) for c in columns], axis=1)


def sweep(
    tracker: AbstractTracker, batches: Batch | Sequence[Batch], objective: AbstractObjective,
    over: Mapping[str, np.ndarray], repeats: int = 1, report: Callable[[int], None] = lambda points: None,
    weights: Sequence[Float[np.ndarray, " B"]] | None = None,
) -> Sweep:  # fmt: skip
    """The objective on the grid spanned by `over`: one or two patterns of tunables with their values.

    All matches of a pattern are tied. A particle filter runs `repeats` times with other random numbers, any other
    tracker once. `report` gets the number of grid points done since the last call. `weights`: of the trajectories of
    each batch, default 1. Raises ValueError for a pattern without match or whose matches can't be tied, for values
    outside a constraint, and for more than two patterns.
    """
    parameters = swept_parameters(tracker, list(over))
    grids = [np.asarray(values, float) for values in over.values()]
    rows = [batches] if isinstance(batches, Batch) else batches
    problem = Problem(tracker, rows, objective, parameters, weights=weights)
    points = grid_vectors(parameters, grids)
    values = []
    for realisation in range(repeats if problem.stochastic else 1):
        parts = []
        for first in range(0, len(points), POINTS_PER_REPORT):
            parts.append(problem.terms(points[first : first + POINTS_PER_REPORT], realisation))
            report(len(parts[-1]))
        terms = np.concatenate(parts)
        # Values over different trajectories are not comparable. Those that are finite at no point are left out.
        some = np.isfinite(terms).all(axis=1).any(axis=0)
        values.append(problem.values_of(terms[..., some].sum(axis=-1)))
    return Sweep(parameters, grids, np.reshape(values, (-1, *map(len, grids))), problem.filter_runs)
