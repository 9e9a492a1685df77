"""The most probable anchors or stations and paths for readings with errors of Student's t.

Levenberg–Marquardt on all of them at once: the banded block of each path is eliminated by its Cholesky factor, which
leaves a system of a few unknowns per sensor, an anchor or a station. The scales of errors and the acceleration density
of each path are those of the greatest marginal likelihood, linearised (MacKay 1992): the directions that the readings
determine are counted with random probes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float
from scipy.linalg import cho_solve_banded, cholesky_banded, solve_banded

from trackwright.tuning.survey.walks import Walk

DOF = 4.0
"""Degrees of freedom of Student's t of the errors."""

PROBES = 12
_RIDGE = 1e-6
"""Information, m⁻², of each coefficient of a path: for directions that no range determines."""

_STEPS, _CONVERGED = 60, 1e-4


@dataclass(frozen=True, eq=False)
class Solution:
    """The unknowns of each sensor (S, w), the coefficients of each walk's path (knots, d), m, and noise levels.

    `scales` (levels,): of errors, m or rad. `densities` (walks,) or, by axis, (walks, 3): of the accelerations, m²/s³.
    `cost`: the negative log-likelihood, marginal over the paths, linearised; smaller is better.
    """

    sensors: Float[np.ndarray, "S w"]
    paths: Sequence[np.ndarray]
    scales: Float[np.ndarray, " levels"]
    densities: Float[np.ndarray, "walks *axes"]
    cost: float = np.inf


@dataclass(frozen=True, eq=False)
class Prior:
    """The normal density of the unknowns (U,) before any reading, by mean and precision; those not `free` are known.

    `tilt` (U,): the slope of what else the cost has.
    """

    mean: Float[np.ndarray, " U"]
    precision: Float[np.ndarray, "U U"]
    free: Bool[np.ndarray, " U"]
    tilt: Float[np.ndarray, " U"] | float = 0.0


@dataclass(frozen=True, eq=False)
class Linearised:
    """A walk at a solution: residuals (n,), m or rad, the factors of the path, and the parts of the reduced system.

    `factor`: of the path's banded information. `cross` (m, U): its coupling to the sensors. `weights` (n,): of the
    residuals. `partial` (n, U) and `along` (n, m): the derivatives of the readings by sensors and by the path.
    """

    residuals: np.ndarray
    weights: np.ndarray
    partial: np.ndarray
    along: sparse.csr_array
    factor: np.ndarray
    cross: np.ndarray
    slope: np.ndarray


def scales_of(walk: Walk, solution: Solution) -> np.ndarray:
    """The scale (n,), m or rad, of the error of each reading."""
    by_level = solution.scales[walk.levels]
    return by_level[:, 0] if by_level.shape[1] == 1 else np.sqrt((by_level**2).sum(axis=1))


def robust_weights(residuals: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """The weights with which residuals of these scales count as normal ones."""
    return (DOF + 1.0) / (DOF * scales**2 + residuals**2)


def linearised(walk: Walk, solution: Solution, k: int, damping: float) -> Linearised:
    """Walk number `k` at a solution; `damping`: the share by which the diagonal of its path's information grows."""
    residuals, units, partial = walk.linearised(solution.sensors, solution.paths[k])
    weights = robust_weights(residuals, scales_of(walk, solution))
    along = walk.along(units)
    rough = walk.rough(solution.densities[k])
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
    """The negative log density of readings, paths and sensors, with the noise levels of the solution."""
    away = solution.sensors.ravel() - prior.mean
    cost = 0.5 * away @ prior.precision @ away + float(np.sum(prior.tilt * away))
    for walk, path, density in zip(walks, solution.paths, solution.densities, strict=True):
        residuals = walk.residuals(solution.sensors, path)
        scales = scales_of(walk, solution)
        cost += 0.5 * (DOF + 1.0) * np.log1p((residuals / scales) ** 2 / DOF).sum() + np.log(scales).sum()
        flat = path.ravel()
        logs = np.broadcast_to(np.log(density), 3)[: path.shape[1]]
        cost += 0.5 * (flat @ (walk.rough(density) @ flat) + (path.shape[0] - 2) * logs.sum())
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
        change = np.abs(moved.sensors - solution.sensors).max()
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
    return replace(solution, sensors=solution.sensors + move.reshape(solution.sensors.shape), paths=paths)


def _reduced(
    walks: Sequence[Walk], solution: Solution, prior: Prior, damping: float
) -> tuple[np.ndarray, np.ndarray, list[Linearised]]:
    """The information (U, U) of sensors with the paths eliminated, its gradient (U,), and the walks linearised."""
    system = prior.precision.copy()
    gradient = prior.precision @ (prior.mean - solution.sensors.ravel()) - prior.tilt
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
        # A difference counts for both of its anchors.
        for end in walk.levels.T:
            squares += np.bincount(end, part.weights * part.residuals**2, count)
            numbers += np.bincount(end, 1.0 - np.minimum(leverage, 1.0), count)
        densities.append(_density(walk, solution.paths[k], drawn, solution.densities[k]))
    # Four unknowns of each anchor are fitted to its ranges, too.
    scales = solution.scales * np.sqrt(squares / np.maximum(numbers - 4.0, 1.0))
    return replace(
        solution, scales=np.where(squares > 0, np.maximum(scales, walks[0].least_scale), solution.scales),
        densities=np.clip(densities, 1e-4, 1e3),
    )  # fmt: skip


def _density(walk: Walk, path: np.ndarray, drawn: np.ndarray, density: np.ndarray) -> np.ndarray:
    """The density of accelerations of greatest marginal likelihood, by errors of the path that are `drawn`."""
    knots, d = path.shape
    bends = (path * (walk.roughness @ path.ravel()).reshape(path.shape)).sum(axis=0)
    unseen = (drawn * (walk.rough(density) @ drawn)).mean(axis=1).reshape(path.shape).sum(axis=0)
    if np.ndim(density) == 0:
        bent = (knots - 2) * d
        return bends.sum() / max(bent - unseen.sum(), 0.05 * bent)
    return np.append(bends / np.maximum(knots - 2 - unseen, 0.05 * (knots - 2)), density[d:])


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
    scores, pieces, spots, level = [], [], [], []
    began = 0.0
    for k, (walk, part) in enumerate(zip(walks, parts, strict=True)):
        partial = part.partial - part.along @ cho_solve_banded((part.factor, False), part.cross)
        scores.append((partial * (part.weights * part.residuals)[:, None])[:, free] @ whiten)
        pieces.append(walk.times - walk.times[0] + began)
        began += np.ptp(walk.times) + max(LENGTHS)
        spots.append(walk.positions(solution.paths[k]))
        level.append(walk.levels[:, 0])
    score, time, spot, number = map(np.concatenate, (scores, pieces, spots, level))
    taken = np.mean([walk.dimensions for walk in walks])
    seen = np.mean([len(np.unique(walk.levels)) for walk in walks])
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
    """The Fisher information (U, U) of the readings about sensors, with the paths eliminated."""
    system = np.zeros((solution.sensors.size, solution.sensors.size))
    for k, walk in enumerate(walks):
        _, units, partial = walk.linearised(solution.sensors, solution.paths[k])
        weights = FISHER / scales_of(walk, solution) ** 2
        along = walk.along(units)
        weighted = along.T.multiply(weights).tocsr()
        rough = walk.rough(solution.densities[k])
        factor = cholesky_banded(_banded(weighted @ along + rough, 4 * walk.dimensions - 1, 0.0))
        cross = weighted @ partial
        system += partial.T @ (partial * weights[:, None]) - cross.T @ cho_solve_banded((factor, False), cross)
    return system
