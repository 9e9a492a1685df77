"""The most probable anchors and paths for ranges with errors of Student's t.

Levenberg–Marquardt on all of them at once: the banded information of the paths is factorised and eliminated, which
leaves four unknowns an anchor. Scales of errors and densities of accelerations are those of the greatest marginal
likelihood, linearised (MacKay 1992): random probes count the directions that the ranges determine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float
from scipy.sparse.linalg import SuperLU, splu

from trackwright.tuning.survey.walks import LEAST_SCALE, Walk

DOF = 4.0  # degrees of freedom of Student's t of the errors
FISHER = (DOF + 1.0) / (DOF + 3.0)
"""The information of a range with errors of Student's t, in that of a normal one of the same scale."""

LENGTHS, SIZES = (1.0, 2.0, 4.0, 8.0, 16.0), (1.0, 2.0)
"""Pieces of time, s, and edges of cubes, m, over which errors may be the same."""

PROBES, STEPS, CONVERGED = 12, 60, 1e-4
RIDGE = 1e-6  # information, m⁻², of each coefficient of a path: for directions that no range determines


@dataclass(frozen=True, eq=False)
class Solution:
    """Positions and delays of anchors, m, the coefficients (knots, d) of each walk's path, m, scales of errors, m,
    densities of accelerations, m²/s³, and `cost`: the negative log-likelihood, marginal over the paths, linearised."""

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


def equations(walks: Sequence[Walk], solution: Solution, damping: float = 0.0, expected: bool = False) -> Equations:
    """The equations at a solution; `damping`: the share by which the diagonal of the paths' information grows.
    `expected`: with the weights that errors of the solution's scales have on average."""
    parts = [walk.linearised(solution.anchors, path) for walk, path in zip(walks, solution.paths, strict=True)]
    residuals, partial = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    scales = solution.scales[anchors_of(walks)]
    weights = FISHER / scales**2 if expected else robust_weights(residuals, scales)
    along = sparse.csr_array(sparse.block_diag([part[2] for part in parts]))
    rough = sparse.block_diag([w.bending @ w.bending.T / q for w, q in zip(walks, solution.densities, strict=True)])
    weighted = sparse.csr_array(along.T.multiply(weights))
    information = weighted @ along + rough
    information = information + sparse.diags_array(damping * information.diagonal() + RIDGE)
    # Banded: no order has less fill.
    options = {"permc_spec": "NATURAL", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    factor = splu(sparse.csc_array(information), **options)
    path = np.concatenate([path.ravel() for path in solution.paths])
    cross, slope = weighted @ partial, weighted @ residuals - rough @ path
    slopes, own = factor.solve(cross), partial.T * weights
    system, gradient = own @ partial - cross.T @ slopes, own @ residuals - slopes.T @ slope
    return Equations(residuals, weights, partial, along, factor, slopes, factor.solve(slope), system, gradient)


def anchors_of(walks: Sequence[Walk]) -> np.ndarray:
    """The numbers of the anchors of all ranges."""
    return np.concatenate([walk.anchor for walk in walks])


def tags(walks: Sequence[Walk], solution: Solution) -> Float[np.ndarray, "n 3"]:
    """The positions of the tags, m, in all walks."""
    return np.concatenate([walk.positions(path) for walk, path in zip(walks, solution.paths, strict=True)])


def split(solution: Solution, vector: np.ndarray) -> list[np.ndarray]:
    """The parts (knots, d) of each path in a vector (M,), or of many in (M, k) with k behind."""
    parts = np.split(vector, np.cumsum([path.size for path in solution.paths])[:-1])
    return [part.reshape(*path.shape, *part.shape[1:]) for part, path in zip(parts, solution.paths, strict=True)]


def cost_of(walks: Sequence[Walk], solution: Solution, prior: Prior) -> float:
    """The negative log density of ranges, paths and anchors, with the noise levels of the solution."""
    away = solution.anchors.ravel() - prior.mean
    cost = 0.5 * away @ prior.precision @ away
    for walk, path, density in zip(walks, solution.paths, solution.densities, strict=True):
        residuals, scales = walk.residuals(solution.anchors, path), solution.scales[walk.anchor]
        cost += 0.5 * (DOF + 1.0) * np.log1p((residuals / scales) ** 2 / DOF).sum() + np.log(scales).sum()
        bends = ((walk.bending.T @ path.ravel()) ** 2).sum() / density
        cost += 0.5 * (bends + (path.shape[0] - 2) * path.shape[1] * np.log(density))
    return float(cost)


def solved(walks: Sequence[Walk], start: Solution, prior: Prior, steps: int = STEPS, levels: bool = True) -> Solution:
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


def _stepped(walks: Sequence[Walk], solution: Solution, prior: Prior, damping: float) -> Solution:
    """The solution after a damped step of Gauss and Newton."""
    found, free, move = equations(walks, solution, damping), prior.free, np.zeros(prior.free.shape)
    gradient = found.gradient + prior.precision @ (prior.mean - solution.anchors.ravel())
    block = (found.system + prior.precision)[np.ix_(free, free)]
    move[free] = np.linalg.solve(block + np.diag(damping * np.diag(block) + 1e-9), gradient[free])
    steps = zip(solution.paths, split(solution, found.step - found.slopes @ move), strict=True)
    anchors = solution.anchors + move.reshape(-1, 4)
    return replace(solution, anchors=anchors, paths=[path + step for path, step in steps])


def _levelled(walks: Sequence[Walk], solution: Solution) -> Solution:
    """The solution with noise levels of greater marginal likelihood."""
    found, random, number = equations(walks, solution), np.random.default_rng(0), anchors_of(walks)
    # Draws from the density of the paths at these anchors.
    noise = found.along.T @ (np.sqrt(found.weights)[:, None] * random.standard_normal((len(number), PROBES)))
    bending = [walk.bending / np.sqrt(q) for walk, q in zip(walks, solution.densities, strict=True)]
    shaken = np.concatenate([b @ random.standard_normal((b.shape[1], PROBES)) for b in bending])
    drawn = found.factor.solve(noise + shaken)
    leverage = found.weights * ((found.along @ drawn) ** 2).mean(axis=1)
    squares = np.bincount(number, found.weights * found.residuals**2, len(solution.scales))
    # Four unknowns of each anchor are fitted to its ranges, too.
    numbers = np.bincount(number, 1.0 - np.minimum(leverage, 1.0), len(solution.scales)) - 4.0
    scales = np.maximum(solution.scales * np.sqrt(squares / np.maximum(numbers, 1.0)), LEAST_SCALE)
    densities = []
    for walk, path, draws, part in zip(walks, solution.paths, split(solution, drawn), bending, strict=True):
        bends, bent = ((walk.bending.T @ path.ravel()) ** 2).sum(), path.size - 2 * path.shape[1]
        unseen = ((part.T @ draws.reshape(path.size, -1)) ** 2).sum() / PROBES
        densities.append(bends / max(bent - unseen, 0.05 * bent))
    scales = np.where(squares > 0, scales, solution.scales)
    return replace(solution, scales=scales, densities=np.clip(densities, 1e-4, 1e3))


def design_effect(walks: Sequence[Walk], solution: Solution, free: Bool[np.ndarray, " U"]) -> float:
    """By how much the scatter of the scores exceeds that of independent errors; at least 1. Errors last: scores are
    summed over pieces of time and over cubes, each of one anchor (Cameron and Miller 2015), and the largest scatter
    counts. Paths take up the errors that all anchors could share with a motion."""
    found = equations(walks, solution)
    values, vectors = np.linalg.eigh(found.system[np.ix_(free, free)])
    kept = values > 1e-6 * values[-1]
    whiten, p = vectors[:, kept] / np.sqrt(values[kept]), kept.sum()
    scores = (found.partial - found.along @ found.slopes) * (found.weights * found.residuals)[:, None]
    score, number = scores[:, free] @ whiten, anchors_of(walks)
    begins = np.cumsum([0.0, *(np.ptp(walk.times) + max(LENGTHS) for walk in walks)])
    times = np.concatenate([w.times - w.times[0] + began for w, began in zip(walks, begins, strict=False)])
    spots = tags(walks, solution)
    effects = []
    for keys in [times[:, None] // length for length in LENGTHS] + [spots // size for size in SIZES]:
        code = np.unique(np.column_stack([keys, number]), axis=0, return_inverse=True)[1].ravel()
        sums, groups = np.stack([np.bincount(code, column) for column in score.T]), code.max() + 1
        effects.append((sums**2).sum() / p * groups / max(groups - p, 0.2 * groups))
    seen = np.mean([len(np.unique(walk.anchor)) for walk in walks])
    taken = np.mean([walk.dimensions for walk in walks])
    return max(1.0, max(effects) / FISHER * seen / max(seen - taken, 1.0))
