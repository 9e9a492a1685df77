"""Cautions on a finished fit: it stood still, a level collapsed, one recording decides, rows are not independent."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from trackers.core.chunks import run_chunks
from trackers.core.rank_correlation import rank_sums
from trackers.core.recording import Batch
from trackers.core.scan import Output
from trackers.core.tunable import Scale
from tuning.optimum import Optimum
from tuning.parameters import Parameter, component_kinds, component_names
from tuning.point import Point
from tuning.problem import Problem
from tuning.profiles import refit
from tuning.reading_grids import ReadingGrid, grid_of
from tuning.uncertainty import Uncertainty, determined

COLLAPSED = 1e-3
"""Part of its starting value below which a noise level has collapsed."""

MOVED = 1e-6
"""Change in unconstrained coordinates below which a fit has not moved."""

DECIDES, CHANGES = 0.6, math.log(1.5)
"""Share of all influence, and change of a number by leaving it out, from which on one recording decides a fit."""

ROUNDS = 8
"""Steps of the fit without that recording."""

REPEATED = 0.5
"""Share of repeated readings from which on they are not independent."""

WINDOWS_S = (1.0, 5.0, 20.0)
"""Lengths of time, s, over which innovations are looked at; the inflation grows with them up to that of the errors."""

MIN_WINDOWS, INFLATION = 40, 2.0
"""Windows of a length for an estimate, and the rows with the information of one from which on rows are correlated."""


def fit_cautions(
    problem: Problem,
    start: Float[np.ndarray, " p"],
    end: Float[np.ndarray, " p"],
    uncertainty: Uncertainty | None,
    grids: Sequence[ReadingGrid],
    recordings: Sequence[str],
) -> list[str]:
    """Clauses on what speaks against the fit from `start` to `end` (p,); arguments as of `FitResult`."""
    found = [*standstill(start, end), *collapsed(problem.parameters, start, end, grids, uncertainty)]
    if uncertainty is not None:
        found += deciding(problem, uncertainty, recordings)
    if problem.objective.is_likelihood:
        found += [*repetitions(grids), *correlation(problem, end)]
    return found


def standstill(start: Float[np.ndarray, " p"], end: Float[np.ndarray, " p"]) -> list[str]:
    """A clause where a fit found no better point than its start."""
    if np.max(np.abs(end - start), initial=0.0) >= MOVED:
        return []
    return ["the fit did not move from its starting values: no other point tried has a better objective"]


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
        if grid is not None and low <= 1.001 * grid.floor:
            yield (
                f"{parameter.label} fell to {low:.3g} {unit}, the rounding of its readings (step {grid.step:.3g} "
                f"{unit} / √12), below which it is not fitted: readings that repeat drive it down"
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
    """A clause where innovations are correlated: the effective number of rows, and how much too narrow intervals are.

    The inflation is that of `trackers.core.rank_correlation`, the largest over windows of several lengths.
    """
    points = [(problem.point(vector), part) for part in problem.chunks]
    found = run_chunks(_nis_of_rows, points)
    columns: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for (nis, dof), part in zip(found, problem.chunks, strict=True):
        valid, times = np.asarray(part.valid), np.cumsum(np.asarray(part.dt, float), axis=0)
        columns += [(times[v, k], nis[v, k], dof[v, k]) for k, v in enumerate(valid.T) if v.any()]
    starts = np.cumsum([0, *(len(times) for times, _, _ in columns)])
    times, nis, dof = (np.concatenate(x).astype(float) for x in zip(*columns, strict=True))
    rows, inflation = int(np.sum(np.isfinite(nis) & (dof > 0))), 1.0
    for window in WINDOWS_S:
        if sum(np.ptp(own) for own, _, _ in columns) >= MIN_WINDOWS * window:
            inflation = max(inflation, np.nan_to_num(rank_sums(times, nis, dof, starts, window).inflation()))
    if inflation < INFLATION:
        return []
    return [
        f"innovations are correlated over time: {rows} rows carry the information of about {rows / inflation:.0f} "
        f"independent ones, so that intervals by the curvature of the likelihood are about {math.sqrt(inflation):.2g} "
        "times too narrow"
    ]


def _nis_of_rows(point: Point, batch: Batch) -> tuple[np.ndarray, np.ndarray]:
    """NIS and degrees of freedom of every row (T, B) at the point's first vector."""

    def score(output: Output, truth: object) -> tuple[np.ndarray, np.ndarray]:
        return output.nis, output.nis_dof

    nis, dof = point.tracker_at(point.vectors[0]).accumulate(batch, score, every_row=True)
    return nis, dof
