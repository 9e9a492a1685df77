"""The most probable anchors and paths for ranges with errors of Student's t.

Levenberg–Marquardt on all of them at once: the banded block of each path is eliminated by its Cholesky factor, which
leaves a system of four unknowns an anchor. The scales of errors and the acceleration density
of each path are those of the greatest marginal likelihood, linearised (MacKay 1992): the directions that the ranges
determine are counted with random probes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float
from scipy.linalg import cho_solve_banded, cholesky_banded, solve_banded

from trackwright.tuning.survey.walks import LEAST_SCALE, Walk

DOF = 4.0
"""Degrees of freedom of Student's t of the errors."""

PROBES = 12
_RIDGE = 1e-6
"""Information, m⁻², of each coefficient of a path: for directions that no range determines."""

_STEPS, _CONVERGED = 60, 1e-4


@dataclass(frozen=True, eq=False)
class Solution:
    """Positions and delays of anchors (A, 4), m, the coefficients of each walk's path (knots, d), m, and noise levels.

    `scales` (A,): of errors, m. `densities` (walks,): of the accelerations, m²/s³. `cost`: the negative
    log-likelihood, marginal over the paths, linearised; smaller is better.
    """

    anchors: Float[np.ndarray, "A 4"]
    paths: Sequence[np.ndarray]
    scales: Float[np.ndarray, " A"]
    densities: Float[np.ndarray, " walks"]
    cost: float = np.inf


@dataclass(frozen=True, eq=False)
class Prior:
    """The normal density of the unknowns (U,) before any range, by mean and precision; those not `free` are known."""

    mean: Float[np.ndarray, " U"]
    precision: Float[np.ndarray, "U U"]
    free: Bool[np.ndarray, " U"]


class Linearised(NamedTuple):
    """A walk at a solution: residuals (n,), m, their weights, and the parts of the reduced system.

    `partial` (n, U) and `along` (n, m): the derivatives of the ranges by anchors and by the path. `factor`: of the
    path's banded information. `cross` (m, U): its coupling to the anchors. `slope` (m,): of the path.
    """

    residuals: np.ndarray
    weights: np.ndarray
    partial: np.ndarray
    along: sparse.csr_array
    factor: np.ndarray
    cross: np.ndarray
    slope: np.ndarray


def robust_weights(residuals: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """The weights with which residuals of these scales count as normal ones."""
    return (DOF + 1.0) / (DOF * scales**2 + residuals**2)


def linearised(walk: Walk, solution: Solution, k: int, damping: float) -> Linearised:
    """Walk number `k` at a solution; `damping`: the share by which the diagonal of its path's information grows."""
    residuals, units, partial = walk.linearised(solution.anchors, solution.paths[k])
    weights = robust_weights(residuals, solution.scales[walk.anchor])
    along = walk.along(units)
    rough = walk.roughness / solution.densities[k]
    weighted = along.T.multiply(weights).tocsr()
    information = weighted @ along + rough
    factor = cholesky_banded(_banded(information, 4 * walk.dimensions - 1, damping))
    slope = weighted @ residuals - rough @ solution.paths[k].ravel()
    return Linearised(residuals, weights, partial, along, factor, weighted @ partial, slope)


def _banded(matrix: sparse.csr_array, width: int, damping: float) -> np.ndarray:
    """The upper bands (width + 1, m) of a symmetric sparse matrix, its diagonal increased by a share `damping`."""
    bands = np.zeros((width + 1, matrix.shape[0]))
    for k in range(width + 1):
        bands[width - k, k:] = matrix.diagonal(k)
    bands[width] += damping * bands[width] + _RIDGE
    return bands


def cost_of(walks: Sequence[Walk], solution: Solution, prior: Prior) -> float:
    """The negative log density of ranges, paths and anchors, with the noise levels of the solution."""
    away = solution.anchors.ravel() - prior.mean
    cost = 0.5 * away @ prior.precision @ away
    for walk, path, density in zip(walks, solution.paths, solution.densities, strict=True):
        residuals, scales = walk.linearised(solution.anchors, path)[0], solution.scales[walk.anchor]
        cost += 0.5 * (DOF + 1.0) * np.log1p((residuals / scales) ** 2 / DOF).sum() + np.log(scales).sum()
        flat = path.ravel()
        logs = path.shape[1] * np.log(density)
        cost += 0.5 * (flat @ (walk.roughness / density @ flat) + (path.shape[0] - 2) * logs)
    return float(cost)


def solved(walks: Sequence[Walk], start: Solution, prior: Prior, steps: int = _STEPS, levels: bool = True) -> Solution:
    """The solution of least cost near a start, with the noise levels fitted."""
    solution, damping = start, 1e-3
    cost = cost_of(walks, solution, prior)
    for _ in range(steps):
        while damping < 1e8:
            moved = _stepped(walks, solution, prior, damping)
            new = cost_of(walks, moved, prior)
            if new <= cost + 1e-9 * abs(cost):
                break
            damping *= 10.0
        else:
            break
        change = np.abs(moved.anchors - solution.anchors).max()
        solution, damping = moved, max(damping / 5.0, 1e-9)
        if levels:
            solution = _levelled(walks, moved)
            change = max(change, 1e-3 * np.abs(np.log(solution.scales / moved.scales)).max())
            new = cost_of(walks, solution, prior)
        cost = new
        if change < _CONVERGED:
            break
    return replace(solution, cost=cost + _log_volume(walks, solution))


def _stepped(walks: Sequence[Walk], solution: Solution, prior: Prior, damping: float) -> Solution:
    """The solution after a damped step of Gauss and Newton."""
    system, gradient, parts = _reduced(walks, solution, prior, damping)
    free = prior.free
    block = system[np.ix_(free, free)]
    block = block + damping * np.diag(np.diag(block)) + 1e-9 * np.eye(len(block))
    move = np.zeros(len(system))
    move[free] = np.linalg.solve(block, gradient[free])
    paths = [
        path + cho_solve_banded((part.factor, False), part.slope - part.cross @ move).reshape(path.shape)
        for path, part in zip(solution.paths, parts, strict=True)
    ]
    return replace(solution, anchors=solution.anchors + move.reshape(-1, 4), paths=paths)


def _reduced(
    walks: Sequence[Walk], solution: Solution, prior: Prior, damping: float
) -> tuple[np.ndarray, np.ndarray, list[Linearised]]:
    """The information (U, U) of anchors with the paths eliminated, its gradient (U,), and the walks linearised."""
    system = prior.precision.copy()
    gradient = prior.precision @ (prior.mean - solution.anchors.ravel())
    parts = []
    for k, walk in enumerate(walks):
        part = linearised(walk, solution, k, damping)
        eliminated = cho_solve_banded((part.factor, False), np.column_stack([part.cross, part.slope]))
        weighted = part.partial * part.weights[:, None]
        system += part.partial.T @ weighted - part.cross.T @ eliminated[:, :-1]
        gradient += weighted.T @ part.residuals - part.cross.T @ eliminated[:, -1]
        parts.append(part)
    return system, gradient, parts


def _levelled(walks: Sequence[Walk], solution: Solution) -> Solution:
    """The solution with noise levels of greater marginal likelihood."""
    count = len(solution.scales)
    squares, numbers, densities = np.zeros(count), np.zeros(count), []
    random = np.random.default_rng(0)
    for k, walk in enumerate(walks):
        part = linearised(walk, solution, k, 0.0)
        width = part.factor.shape[0] - 1
        probes = random.standard_normal((part.factor.shape[1], PROBES))
        drawn = solve_banded((0, width), part.factor, probes)
        leverage = part.weights * ((part.along @ drawn) ** 2).mean(axis=1)
        squares += np.bincount(walk.anchor, part.weights * part.residuals**2, count)
        numbers += np.bincount(walk.anchor, 1.0 - np.minimum(leverage, 1.0), count)
        densities.append(_density(walk, solution.paths[k], drawn, solution.densities[k]))
    # Four unknowns of each anchor are fitted to its ranges, too.
    scales = solution.scales * np.sqrt(squares / np.maximum(numbers - 4.0, 1.0))
    return replace(
        solution, scales=np.where(squares > 0, np.maximum(scales, LEAST_SCALE), solution.scales),
        densities=np.clip(densities, 1e-4, 1e3),
    )  # fmt: skip


def _density(walk: Walk, path: np.ndarray, drawn: np.ndarray, density: float) -> float:
    """The density of accelerations of greatest marginal likelihood, by errors of the path that are `drawn`."""
    bends = (path * (walk.roughness @ path.ravel()).reshape(path.shape)).sum(axis=0)
    unseen = (drawn * (walk.roughness / density @ drawn)).mean(axis=1).reshape(path.shape).sum(axis=0)
    bent = (len(path) - 2) * path.shape[1]
    return float(bends.sum() / max(bent - unseen.sum(), 0.05 * bent))


def _log_volume(walks: Sequence[Walk], solution: Solution) -> float:
    """Half the log determinant of the paths' information."""
    return sum(float(np.log(linearised(walk, solution, k, 0.0).factor[-1]).sum()) for k, walk in enumerate(walks))


def design_effect(walks: Sequence[Walk], solution: Solution, prior: Prior) -> float:
    """By how much the scatter of the scores exceeds that of independent errors; at least 1.

    Errors last: scores are summed over pieces of time and over cubes, each of one anchor (Cameron and
    Miller 2015), and the largest scatter counts. Paths take up the errors that all anchors could share with a motion.
    """
    free = prior.free
    system, _, parts = _reduced(walks, solution, prior, 0.0)
    values, vectors = np.linalg.eigh((system - prior.precision)[np.ix_(free, free)])
    kept = values > 1e-6 * values[-1]
    whiten = vectors[:, kept] / np.sqrt(values[kept])
    scores, pieces, spots = [], [], []
    began = 0.0
    for k, (walk, part) in enumerate(zip(walks, parts, strict=True)):
        partial = part.partial - part.along @ cho_solve_banded((part.factor, False), part.cross)
        scores.append((partial * (part.weights * part.residuals)[:, None])[:, free] @ whiten)
        pieces.append(walk.times - walk.times[0] + began)
        began += np.ptp(walk.times) + max(LENGTHS)
        spots.append(walk.positions(solution.paths[k]))
    score, time, spot = map(np.concatenate, (scores, pieces, spots))
    number = np.concatenate([walk.anchor for walk in walks])
    taken = np.mean([walk.dimensions for walk in walks])
    seen = np.mean([len(np.unique(walk.anchor)) for walk in walks])
    clusters = [(time / length).astype(int)[:, None] for length in LENGTHS]
    clusters += [np.floor(spot / size).astype(int) for size in SIZES]
    effects = []
    for keys in clusters:
        code = np.unique(np.column_stack([keys, number]), axis=0, return_inverse=True)[1].ravel()
        sums = np.stack([np.bincount(code, column) for column in score.T])
        groups, p = code.max() + 1, kept.sum()
        effects.append((sums**2).sum() / p * groups / max(groups - p, 0.2 * groups))
    return max(1.0, max(effects) / FISHER * seen / max(seen - taken, 1.0))


FISHER = (DOF + 1.0) / (DOF + 3.0)
"""The information of a range with errors of Student's t, in that of a normal one of the same scale."""

LENGTHS, SIZES = (1.0, 2.0, 4.0, 8.0, 16.0), (1.0, 2.0)
"""Pieces of time, s, and edges of cubes, m, over which errors may be the same."""


def information(walks: Sequence[Walk], solution: Solution) -> np.ndarray:
    """The Fisher information (U, U) of the ranges about anchors, with the paths eliminated."""
    system = np.zeros((solution.anchors.size, solution.anchors.size))
    for k, walk in enumerate(walks):
        _, units, partial = walk.linearised(solution.anchors, solution.paths[k])
        weights = FISHER / solution.scales[walk.anchor] ** 2
        along = walk.along(units)
        weighted = along.T.multiply(weights).tocsr()
        rough = walk.roughness / solution.densities[k]
        factor = cholesky_banded(_banded(weighted @ along + rough, 4 * walk.dimensions - 1, 0.0))
        cross = weighted @ partial
        system += partial.T @ (partial * weights[:, None]) - cross.T @ cho_solve_banded((factor, False), cross)
    return system
