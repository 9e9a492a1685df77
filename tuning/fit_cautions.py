"""Cautions on a finished fit: it stood still, a level collapsed, one recording decides, rows are not independent."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.recordings.reading_grids import REPEATED, ReadingGrid
from trackwright.tuning.correlation import rows_and_inflation
from trackwright.tuning.optimum import Optimum
from trackwright.tuning.parameters import Parameter, component_kinds, component_names
from trackwright.tuning.problem import Problem
from trackwright.tuning.profiles import refit
from trackwright.tuning.reading_grids import grid_of
from trackwright.tuning.uncertainty import Uncertainty, determined

COLLAPSED = 1e-3
"""Part of its starting value below which a noise level has collapsed."""

MOVED = 1e-6
"""Change in unconstrained coordinates below which a fit has not moved."""

DECIDES, CHANGES = 0.6, math.log(1.5)
"""Share of all influence, and change of a number by leaving it out, from which on one recording decides a fit."""

ROUNDS = 8
"""Steps of the fit without that recording."""

INFLATION = 2.0
"""Rows with the information of one from which on innovations are correlated."""


def fit_cautions(
    problem: Problem,
    start: Float[np.ndarray, " p"],
    end: Float[np.ndarray, " p"],
    uncertainty: Uncertainty | None,
    grids: Sequence[ReadingGrid],
    recordings: Sequence[str],
    selected: bool,
) -> list[str]:
    """Clauses on what speaks against the fit from `start` to `end` (p,); arguments as of `FitResult`."""
    found = [*standstill(start, end, selected), *collapsed(problem.parameters, start, end, grids, uncertainty)]
    if uncertainty is not None:
        found += deciding(problem, uncertainty, recordings)
    if problem.objective.is_likelihood:
        found += [*repetitions(grids), *correlation(problem, end)]
    return found


def standstill(start: Float[np.ndarray, " p"], end: Float[np.ndarray, " p"], selected: bool = False) -> list[str]:
    """A clause where a fit found no better point than its start; `selected`: by held-out recordings."""
    if np.max(np.abs(end - start), initial=0.0) >= MOVED:
        return []
    where = " on the held-out recordings" if selected else ""
    return [f"the fit did not move from its starting values: no other point tried has a better objective{where}"]


def collapsed(
    parameters: Sequence[Parameter],
    start: Float[np.ndarray, " p"],
    end: Float[np.ndarray, " p"],
    grids: Sequence[ReadingGrid],
    uncertainty: Uncertainty | None = None,
) -> Iterator[str]:
    """Clauses on noise levels that fell to the rounding of their readings, or to a thousandth of their start.

    The latter where the recordings do not determine them.
    """
    at = 0
    for parameter in parameters:
        part = slice(at, at + parameter.size)
        at += parameter.size
        if not isinstance(parameter.example, Scale):
            continue
        low, grid, unit = float(np.exp(end[part].min())), grid_of(grids, parameter), parameter.example.unit
        fell = grid is not None and low <= 1.001 * grid.lowest < float(np.exp(start[part].min()))
        if grid is not None and fell:
            what = "rounding" if grid.lowest == grid.floor else "changes"
            size = f"step {grid.step:.3g}" if what == "rounding" else f"typically {grid.change:.3g}"
            yield (
                f"{parameter.label} fell to {low:.3g} {unit}, the {what} of its readings ({size} {unit} / √12), below "
                "which it is not fitted: readings that repeat drive it down"
            )
        elif np.min(end[part] - start[part]) < math.log(COLLAPSED) and not _determined(uncertainty, parameter):
            yield (
                f"{parameter.label} collapsed to {low:.3g} {unit}, less than a thousandth of its starting "
                "value: give bounds or a prior"
            )


def _determined(uncertainty: Uncertainty | None, parameter: Parameter) -> bool:
    """Whether a noise level has a standard error below its value."""
    if uncertainty is None:
        return False
    at = [other.label for other in uncertainty.parameters].index(parameter.label)
    start = sum(other.size for other in uncertainty.parameters[:at])
    sigma = np.where(uncertainty.undetermined | uncertainty.at_bound, np.inf, uncertainty.sigmas)
    return bool(np.all(sigma[start : start + parameter.size] < 1.0))


def deciding(problem: Problem, uncertainty: Uncertainty, recordings: Sequence[str]) -> list[str]:
    """A clause where one recording, or one piece of a single recording, decides the fit.

    `recordings`: that of each trajectory. The one with the most influence is left out, and the rest fitted again by a
    few steps.
    """
    found: Optimum = uncertainty.optimum
    own = np.asarray(recordings)[found.used]
    names = [f"recording {name}" for name in own]
    if len(set(names)) == 1:
        names = [f"piece {k + 1} of {name}" for k, name in enumerate(own)]
    groups, index = np.unique(names, return_inverse=True)
    if len(groups) < 3 or not np.all(np.isfinite(found.hessian)):
        return []
    _, inverse, _ = determined(found.hessian, ~uncertainty.at_bound)
    pulls = np.stack([found.influence[index.ravel() == g].sum(axis=0) for g in range(len(groups))])
    shares = np.einsum("gp,pq,gq->g", pulls, inverse, pulls)
    worst = int(np.argmax(shares))
    if problem.stochastic or not shares[worst] > DECIDES * shares.sum():
        return []
    rest = found.used.astype(float)
    rest[np.flatnonzero(found.used)[index.ravel() == worst]] = 0.0
    refitted = refit(problem, found.vector[None], found.hessian, ~uncertainty.at_bound, rest[None], ROUNDS).vectors[0]
    scales = np.array(component_kinds(uncertainty.parameters)) == Scale
    change = np.where(scales & ~uncertainty.undetermined, refitted - found.vector, 0.0)
    largest = int(np.argmax(np.abs(change)))
    if not abs(change[largest]) > CHANGES:
        return []
    name = component_names(uncertainty.parameters)[largest]
    more = "larger" if change[largest] > 0 else "smaller"
    factor = math.exp(abs(float(change[largest])))
    return [f"{groups[worst]} decides the fit: without it {name} would be {factor:.2g} times {more}"]


def repetitions(grids: Sequence[ReadingGrid]) -> Iterator[str]:
    """Clauses on sensors most of whose readings repeat the one before."""
    for grid in {grid.sensor: grid for grid in reversed(grids)}.values():
        if grid.repeated > REPEATED:
            step = f" (in steps of {grid.step:.3g} {grid.unit})" if math.isfinite(grid.step) else ""
            yield (
                f"{100 * grid.repeated:.0f} % of the readings of {grid.sensor} repeat the one before{step}: a "
                "likelihood takes them for independent readings"
            )


def correlation(problem: Problem, vector: Float[np.ndarray, " p"]) -> list[str]:
    """A clause where innovations are correlated: the effective number of rows, and by how much intervals fall short."""
    rows, inflation = rows_and_inflation(problem, vector)
    if inflation < INFLATION:
        return []
    return [
        f"innovations are correlated over time: {rows} rows carry the information of about {rows / inflation:.0f} "
        f"independent ones, so that intervals by the curvature of the likelihood are about {math.sqrt(inflation):.2g} "
        "times too narrow; give the objective state-nll where there is truth"
    ]
