"""The most probable path given all readings, whose noise is Student's t: Gauss–Newton with iterated weights.

It begins at the path of the plain filter. The normal equations of a chain are banded, and SciPy solves them.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from trackwright.experiments.lab.benchmark.adapters.plain import states
from trackwright.experiments.lab.benchmark.motion import Levels, Path, diffusion, transition
from trackwright.experiments.lab.benchmark.problems import Problem, beginning
from trackwright.experiments.lab.benchmark.readings import gradient, predicted

DOF = 3.0
ITERATIONS = 60
CONVERGED = 1e-5
"""Largest step, m, of the last iteration."""


def estimate(problem: Problem, levels: Levels, dof: float = DOF) -> Path:
    """The path of a tag; it has no covariance. `dof`: degrees of freedom, inf for normal noise."""
    d = problem.dimensions
    times, row_of = problem.epochs
    mean, P = beginning(problem)
    prior, prior_sides = _motion(times, d, mean, P, levels.acceleration)
    x = states(problem, levels)[np.searchsorted(row_of, np.arange(len(times)), "right") - 1]
    for _ in range(ITERATIONS):
        band, sides = prior.copy(), prior_sides.copy()
        _readings(problem, levels, dof, x, row_of, band, sides)
        new = solveh_banded(band, sides.ravel(), lower=True).reshape(x.shape)
        moved = float(np.abs(new - x)[:, :d].max())
        x = new
        if moved < CONVERGED:
            break
    return Path(x[row_of, :d])


def _motion(times: np.ndarray, d: int, mean: np.ndarray, P: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Information of start and motion: lower band (4d, 2dT) and right side (T, 2d)."""
    n, T = 2 * d, len(times)
    band, sides = np.zeros((2 * n, n * T)), np.zeros((T, n))
    first = np.linalg.inv(P)
    _add(band, 0, 0, first)
    sides[0] = first @ mean
    for row, dt in enumerate(np.diff(times)):
        F, information = transition(d, dt), np.linalg.inv(diffusion(d, dt, sigma))
        _add(band, row, row, F.T @ information @ F)
        _add(band, row + 1, row, -information @ F)
        _add(band, row + 1, row + 1, information)
    return band, sides


def _add(band: np.ndarray, row: int, column: int, block: np.ndarray) -> None:
    """Adds a block of the lower triangle to the band."""
    n = len(block)
    for i in range(n):
        for j in range(n if row > column else i + 1):
            band[(row - column) * n + i - j, column * n + j] += block[i, j]


def _readings(
    problem: Problem, levels: Levels, dof: float, x: np.ndarray, row_of: np.ndarray, band: np.ndarray, sides: np.ndarray
) -> None:
    """Adds the information of all readings, linearised at x (T, 2d), with their weights."""
    d = problem.dimensions
    places = problem.places(x[row_of, :d])
    z = problem.values
    differences = (z - predicted(problem.kind, places, problem.geometry, z)) / levels.reading
    slopes = gradient(problem.kind, places, problem.geometry)[..., :d] / levels.reading
    seen = problem.seen & (np.abs(slopes).sum(axis=-1) > 0)
    weights = seen * (1.0 if np.isinf(dof) else (dof + 1.0) / (dof + differences**2))
    aimed = differences + np.einsum("nkd,nd->nk", slopes, x[row_of, :d])
    np.add.at(sides, (row_of[:, None], np.arange(d)), np.einsum("nk,nk,nkd->nd", weights, aimed * seen, slopes))
    information = np.einsum("nk,nki,nkj->nij", weights, slopes, slopes)
    for i in range(d):
        for j in range(i + 1):
            np.add.at(band[i - j], row_of * 2 * d + j, information[:, i, j])
