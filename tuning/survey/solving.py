"""The most probable anchors and paths for ranges with errors of Student's t.

Levenberg–Marquardt on all of them at once: the banded information of the paths is factorised and eliminated, which
leaves four unknowns an anchor. Scales of errors and densities of accelerations are those of the greatest marginal
likelihood, linearised (MacKay 1992): random probes count the directions that the ranges determine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float
from scipy.sparse.linalg import SuperLU, splu

from trackwright.tuning.survey.walks import LEAST_SCALE, Walks

DOF = 4.0  # degrees of freedom of Student's t of the errors
FISHER = (DOF + 1.0) / (DOF + 3.0)
"""The information of a range with errors of Student's t, in that of a normal one of the same scale."""

LENGTHS, SIZES = (1.0, 2.0, 4.0, 8.0, 16.0), (1.0, 2.0)
"""Pieces of time, s, and edges of cubes, m, over which errors may be the same."""

PROBES, STEPS, CONVERGED = 12, 60, 1e-4
RIDGE = 1e-6  # information, m⁻², of each coefficient of a path: for directions that no range determines


@dataclass(frozen=True, eq=False)
class Solution:
    """Positions and delays of anchors, m, the coefficients (knots, 3) of all paths, m, scales of errors, m, densities
    of accelerations, m²/s³, and `cost`: the negative log-likelihood, marginal over the paths, linearised."""

    anchors: Float[np.ndarray, "A 4"]
    path: Float[np.ndarray, "knots 3"]
    scales: Float[np.ndarray, " A"]
    densities: Float[np.ndarray, " W"]
    cost: float = np.inf


@dataclass(frozen=True, eq=False)
class Prior:
    """The normal density of the unknowns (U,) before any range, by mean and precision; those not `free` are known."""

    mean: Float[np.ndarray, " U"]
    precision: Float[np.ndarray, "U U"]
    free: Bool[np.ndarray, " U"]


class Equations(NamedTuple):
    """All n ranges at a solution: residuals (n,), m, their weights, and derivatives by anchors and by paths. `factor`:
    of the paths' information. `slopes` (M, U) and `step` (M,): how far paths move with anchors, and without. `system`
    (U, U), `gradient` (U,): the information of anchors with the paths eliminated, without the prior."""

    residuals: np.ndarray
    weights: np.ndarray
    partial: np.ndarray
    along: sparse.csr_array
    factor: SuperLU
    slopes: np.ndarray
    step: np.ndarray
    system: np.ndarray
    gradient: np.ndarray


def robust_weights(residuals: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """The weights with which residuals of these scales count as normal ones."""
    return (DOF + 1.0) / (DOF * scales**2 + residuals**2)


def errors(walks: Walks, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """How much longer the ranges (n,), m, are than distances and delays; the directions (n, 3) of tags from anchors."""
    anchors = solution.anchors[walks.anchor]
    offset = walks.positions(solution.path) - anchors[:, :3]
    distance = np.linalg.norm(offset, axis=1)
    return walks.values - distance - anchors[:, 3], offset / np.maximum(distance, 1e-9)[:, None]


def equations(walks: Walks, solution: Solution, damping: float = 0.0, expected: bool = False) -> Equations:
    """The equations at a solution; `damping`: the share by which the diagonal of the paths' information grows.
    `expected`: with the weights that errors of the solution's scales have on average."""
    (residuals, units), scales = errors(walks, solution), solution.scales[walks.anchor]
    weights = FISHER / scales**2 if expected else robust_weights(residuals, scales)
    rows, (bending, walk) = np.arange(len(units)), walks.bending
    wide = np.zeros((len(rows), *solution.anchors.shape))
    wide[rows, walks.anchor] = np.column_stack([-units, np.ones(len(rows))])
    partial = wide.reshape(len(rows), -1)
    away = sparse.csr_array((units.ravel(), np.arange(units.size), np.arange(0, units.size + 1, 3)))
    along = away @ walks.spread
    rough = bending.multiply(1.0 / solution.densities[walk]) @ bending.T
    weighted = sparse.csr_array(along.T.multiply(weights))
    information = weighted @ along + rough
    information = information + sparse.diags_array(damping * information.diagonal() + RIDGE)
    # Banded: no order has less fill.
    options = {"permc_spec": "NATURAL", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    factor = splu(sparse.csc_array(information), **options)
    cross, slope = weighted @ partial, weighted @ residuals - rough @ solution.path.ravel()[walks.free]
    slopes, own = factor.solve(cross), partial.T * weights
    system, gradient = own @ partial - cross.T @ slopes, own @ residuals - slopes.T @ slope
    return Equations(residuals, weights, partial, along, factor, slopes, factor.solve(slope), system, gradient)


def cost_of(walks: Walks, solution: Solution, prior: Prior) -> float:
    """The negative log density of ranges, paths and anchors, with the noise levels of the solution."""
    away, scales = solution.anchors.ravel() - prior.mean, solution.scales[walks.anchor]
    bending, walk = walks.bending
    densities, bends = solution.densities[walk], bending.T @ solution.path.ravel()[walks.free]
    ranges = (DOF + 1.0) * np.log1p((errors(walks, solution)[0] / scales) ** 2 / DOF) + 2.0 * np.log(scales)
    paths = bends**2 / densities + np.log(densities)
    return 0.5 * float(away @ prior.precision @ away + ranges.sum() + paths.sum())


def solved(walks: Walks, start: Solution, prior: Prior, steps: int = STEPS, levels: bool = True) -> Solution:
    """The solution of least cost near a start, with the noise levels fitted."""
    solution, damping, cost = start, 1e-3, cost_of(walks, start, prior)
    for _ in range(steps):
        moved = _stepped(walks, solution, prior, damping)
        while (new := cost_of(walks, moved, prior)) > cost + 1e-9 * abs(cost) and damping < 1e8:
            damping *= 10.0
            moved = _stepped(walks, solution, prior, damping)
        if damping >= 1e8:
            break
        before, solution, damping = solution, moved, max(damping / 5.0, 1e-9)
        if levels:
            solution = _levelled(walks, moved)
            new = cost_of(walks, solution, prior)
        cost = new
        change = np.abs(np.log(solution.scales / before.scales)).max()
        if max(np.abs(moved.anchors - before.anchors).max(), 1e-3 * change) < CONVERGED:
            break
    # Half the log determinant of the paths' information makes the cost marginal.
    return replace(solution, cost=cost + 0.5 * float(np.log(equations(walks, solution).factor.U.diagonal()).sum()))


def _stepped(walks: Walks, solution: Solution, prior: Prior, damping: float) -> Solution:
    """The solution after a damped step of Gauss and Newton."""
    found, free, move = equations(walks, solution, damping), prior.free, np.zeros(prior.free.shape)
    gradient = found.gradient + prior.precision @ (prior.mean - solution.anchors.ravel())
    block = (found.system + prior.precision)[np.ix_(free, free)]
    move[free] = np.linalg.solve(block + np.diag(damping * np.diag(block) + 1e-9), gradient[free])
    path = solution.path.copy()
    path.ravel()[walks.free] += found.step - found.slopes @ move
    return replace(solution, anchors=solution.anchors + move.reshape(-1, 4), path=path)


def _levelled(walks: Walks, solution: Solution) -> Solution:
    """The solution with noise levels of greater marginal likelihood."""
    found, random, (bending, walk) = equations(walks, solution), np.random.default_rng(0), walks.bending
    # Draws from the density of the paths at these anchors.
    noise = np.sqrt(found.weights)[:, None] * random.standard_normal((len(walks.walk), PROBES))
    rough = bending.multiply(solution.densities[walk] ** -0.5).tocsr()
    drawn = found.factor.solve(found.along.T @ noise + rough @ random.standard_normal((len(walk), PROBES)))
    leverage = found.weights * ((found.along @ drawn) ** 2).mean(axis=1)
    squares = np.bincount(walks.anchor, found.weights * found.residuals**2, len(solution.scales))
    # Four unknowns of each anchor are fitted to its ranges, too.
    numbers = np.bincount(walks.anchor, 1.0 - np.minimum(leverage, 1.0), len(solution.scales)) - 4.0
    scales = np.maximum(solution.scales * np.sqrt(squares / np.maximum(numbers, 1.0)), LEAST_SCALE)
    bends, unseen = (bending.T @ solution.path.ravel()[walks.free]) ** 2, ((rough.T @ drawn) ** 2).mean(axis=1)
    size, bent, free = (np.bincount(walk, of) for of in (bends, None, 1.0 - unseen))
    densities = np.clip(size / np.maximum(free, 0.05 * bent), 1e-4, 1e3)
    return replace(solution, scales=np.where(squares > 0, scales, solution.scales), densities=densities)


def design_effect(walks: Walks, solution: Solution, free: Bool[np.ndarray, " U"]) -> float:
    """By how much the scatter of the scores exceeds that of independent errors; at least 1. Errors last: scores are
    summed over pieces of time and over cubes, each of one anchor (Cameron and Miller 2015), and the largest scatter
    counts. Paths take up the errors that all anchors could share with a motion."""
    found = equations(walks, solution)
    values, vectors = np.linalg.eigh(found.system[np.ix_(free, free)])
    kept = values > 1e-6 * values[-1]
    whiten, p = vectors[:, kept] / np.sqrt(values[kept]), kept.sum()
    scores = (found.partial - found.along @ found.slopes) * (found.weights * found.residuals)[:, None]
    score, effects, each = scores[:, free] @ whiten, [], [walks.times[walks.walk == k] for k in range(len(walks.names))]
    begins = np.cumsum([0.0, *(np.ptp(times) + max(LENGTHS) for times in each)])
    times = np.concatenate([times - times[0] + began for times, began in zip(each, begins, strict=False)])
    spots = walks.positions(solution.path)
    for keys in [times[:, None] // length for length in LENGTHS] + [spots // size for size in SIZES]:
        code = np.unique(np.column_stack([keys, walks.anchor]), axis=0, return_inverse=True)[1].ravel()
        sums, groups = np.stack([np.bincount(code, column) for column in score.T]), code.max() + 1
        effects.append((sums**2).sum() / p * groups / max(groups - p, 0.2 * groups))
    seen = len(np.unique([walks.walk, walks.anchor], axis=1).T) / len(each)
    return max(1.0, max(effects) / FISHER * seen / max(seen - 2.0 - np.isnan(walks.heights).mean(), 1.0))
