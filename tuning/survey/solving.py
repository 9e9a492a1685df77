"""The most probable anchors and paths for ranges with errors of Student's t.

Levenberg–Marquardt on all of them at once: the banded information of the paths is factorised and eliminated, which
leaves four unknowns an anchor. Scales of errors and densities of accelerations have the greatest marginal
likelihood, linearised (MacKay 1992): random probes count the directions that the ranges determine.

A path is a cubic spline with knots every `STEP` s. Its prior density, exp(−½∫|x''|²dt / q), is of white
acceleration of spectral density q, m²/s³. Each range depends on four neighbouring coefficients: matrices are banded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int
from scipy.interpolate import BSpline
from scipy.sparse.linalg import splu, spsolve

from trackwright.trackers.recordings.folder import RecordingFolder

DOF = 4.0  # degrees of freedom of Student's t of the errors
FISHER = (DOF + 1.0) / (DOF + 3.0)
"""The information of a range with errors of Student's t, in units of a normal one's of the same scale."""

LENGTHS, SIZES = (1.0, 2.0, 4.0, 8.0, 16.0), (1.0, 2.0)
"""Pieces of time, s, and edges of cubes, m, over which errors may be the same."""

STEP, AVERAGE, GAP = 0.25, 0.1, 5.0
"""Times, s: between knots of a path, over which ranges to an anchor are averaged, after which a path begins anew."""

LEVEL, LEAST_SCALE, FEWEST = 0.1, 0.01, 20
"""Distance, m, at which an anchor counts as at the height of a walk; least scale of errors, m; ranges of a walk."""

PROBES, STEPS, CONVERGED = 12, 60, 1e-4
RIDGE = 1e-6  # information, m⁻², of each coefficient of a path: for directions that no range determines


@dataclass(frozen=True, eq=False)
class Walks:
    """n ranges on W walks between gaps: the numbers of `walk` and `anchor`, `times`, s, each walk long after the one
    before it, and `values`, m (n,); whose walks these are, and the known `heights` of their tags, m, NaN: estimated.
    Paths have coefficients (M,), m: three of each knot, but none of known heights."""

    names: Sequence[str]
    heights: Float[np.ndarray, " W"]
    walk: Int[np.ndarray, " n"]
    anchor: Int[np.ndarray, " n"]
    times: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]

    def only(self, k: int) -> Walks:
        """Walk number `k` alone."""
        own = self.walk == k
        rows = (column[own] for column in (self.anchor, self.times, self.values))
        return Walks(self.names[k : k + 1], self.heights[k : k + 1], 0 * self.walk[own], *rows)

    @cached_property
    def _spline(self) -> tuple[sparse.csr_array, Int[np.ndarray, " knots"]]:
        """The weights (n, knots) of the coefficients of a coordinate at the times of the ranges; the walks of knots."""
        begins = np.searchsorted(self.walk, np.arange(len(self.heights)))
        at = (self.times - self.times[begins][self.walk]) / STEP
        knots = np.repeat(np.arange(len(begins)), np.maximum.reduceat(at.astype(int), begins) + 4)
        at += np.searchsorted(knots, self.walk)
        return BSpline.design_matrix(at, np.arange(-3.0, len(knots) + 1.0), 3), knots

    @cached_property
    def free(self) -> Bool[np.ndarray, " coordinates"]:
        """Which of the coordinates (knots, 3) are estimated, in one row: M of them, all but known heights."""
        return np.isnan(np.pad(self.heights[self._spline[1], None], ((0, 0), (2, 0)), constant_values=np.nan)).ravel()

    @cached_property
    def spread(self) -> sparse.csr_array:
        """The derivatives (3n, M) of positions by the coefficients."""
        return sparse.csr_array(sparse.kron(self._spline[0], sparse.eye_array(3), "csc")[:, self.free])

    @cached_property
    def bending(self) -> tuple[sparse.csr_array, Int[np.ndarray, " bends"]]:
        """The matrix (M, bends) by which, transposed, the square of the coefficients is ∫|x''|²dt; the bends' walks."""
        walk = np.repeat(self._spline[1], 3)
        second = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, -3, -6], shape=(len(walk), len(walk) - 6))
        inside = self.free[:-6] & (walk[:-6] == walk[6:])
        return sparse.csr_array(second.tocsr()[self.free][:, inside] / STEP**1.5), walk[:-6][inside]

    def positions(self, path: Float[np.ndarray, " M"]) -> Float[np.ndarray, "n 3"]:
        """The positions of the tags, m, at the times of the ranges."""
        return (self.spread @ path).reshape(-1, 3) + np.nan_to_num(self.heights)[self.walk, None] * [0.0, 0.0, 1.0]

    def errors(self, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
        """How much longer ranges (n,), m, are than distances and delays; the directions (n, 3) of tags from anchors."""
        anchors = solution.anchors[self.anchor]
        offset = self.positions(solution.path) - anchors[:, :3]
        distance = np.linalg.norm(offset, axis=1)
        return self.values - distance - anchors[:, 3], offset / np.maximum(distance, 1e-9)[:, None]

    def fitted(self, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " M"]:
        """The coefficients of smooth paths near these positions at the times of the ranges."""
        bending = self.bending[0]
        # A little of the identity for knots without ranges beside them.
        system = self.spread.T @ self.spread + bending @ bending.T + 1e-9 * sparse.eye_array(bending.shape[0])
        return spsolve(sparse.csc_array(system), self.spread.T @ positions.ravel())


def walks_of(folders: Sequence[RecordingFolder], anchors: Sequence[str], height: float | None) -> Walks:
    """The walks of all tags to anchors of these ids; `height`: of all tags, m, else those in rigs."""
    names, heights, pieces = list[str](), list[float](), [np.empty((0, 4))]
    for folder in folders:
        rows = folder.rows("ranges", AVERAGE)
        table = np.column_stack([rows.codes("anchor", anchors), rows.times, rows.floats(["range_m"])[:, 0]])
        for tag, of_tag in zip(rows.tags, np.split(table, rows.starts[1:-1]), strict=True):
            known = folder.rig.tags[tag].height if height is None and tag in folder.rig.tags else height
            ranged = of_tag[of_tag[:, 2] > 0.0]
            for piece in np.split(ranged, np.flatnonzero(np.diff(ranged[:, 1]) > GAP) + 1):
                if len(piece) >= FEWEST:
                    piece[:, 1] += (pieces[-1][-1, 2] + max(LENGTHS) if names else 0.0) - piece[0, 1]
                    pieces.append(np.insert(piece, 0, len(names), axis=1))
                    names.append(f"tag {tag} of {folder.name}")
                    heights.append(np.nan if known is None else known)
    walk, anchor, times, values = np.concatenate(pieces).T
    return Walks(names, np.array(heights), walk.astype(int), anchor.astype(int), times, values)


@dataclass(frozen=True, eq=False)
class Solution:
    """Positions and delays of anchors, m, the coefficients of all paths, m, scales of errors, m, densities of
    accelerations, m²/s³, and `cost`: the negative log-likelihood, marginal over the paths, linearised."""

    anchors: Float[np.ndarray, "A 4"]
    path: Float[np.ndarray, " M"]
    scales: Float[np.ndarray, " A"]
    densities: Float[np.ndarray, " W"]
    cost: float = np.inf


@dataclass(frozen=True, eq=False)
class Prior:
    """The normal density of the unknowns (U,) before any range, by mean and precision; those not `free` are known."""

    mean: Float[np.ndarray, " U"]
    precision: Float[np.ndarray, "U U"]
    free: Bool[np.ndarray, " U"]


def robust_weights(residuals: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """The weights with which residuals of these scales count as normal ones."""
    return (DOF + 1.0) / (DOF * scales**2 + residuals**2)


class Equations:
    """All n ranges at a solution: residuals (n,), m, their weights, and derivatives by anchors and by paths. `factor`:
    of the paths' information. `slopes` (M, U) and `step` (M,): how far paths move with anchors, and without. `system`
    (U, U), `gradient` (U,): the information of anchors with the paths eliminated, without the prior.

    `damping`: the share by which the diagonal of the paths' information grows. `expected`: with the weights that errors
    of the solution's scales have on average."""

    def __init__(self, walks: Walks, solution: Solution, damping: float = 0.0, expected: bool = False):
        (self.residuals, units), scales = walks.errors(solution), solution.scales[walks.anchor]
        self.weights = FISHER / scales**2 if expected else robust_weights(self.residuals, scales)
        own = (
            np.column_stack([-units, np.ones(len(units))])[:, None]
            * np.eye(len(solution.anchors))[walks.anchor, :, None]
        )
        self.partial = own.reshape(len(units), -1)
        away = sparse.csr_array((units.ravel(), np.arange(units.size), np.arange(0, units.size + 1, 3)))
        self.along, (bending, walk) = away @ walks.spread, walks.bending
        rough = bending.multiply(1.0 / solution.densities[walk]) @ bending.T
        weighted = sparse.csr_array(self.along.T.multiply(self.weights))
        information = weighted @ self.along + rough
        information = information + sparse.diags_array(damping * information.diagonal() + RIDGE)
        # Banded: no order has less fill.
        self.factor = splu(sparse.csc_array(information), "NATURAL", 0.0, options={"SymmetricMode": True})
        cross, scaled = weighted @ self.partial, self.partial.T * self.weights
        slope = weighted @ self.residuals - rough @ solution.path
        self.slopes, self.step = self.factor.solve(cross), self.factor.solve(slope)
        self.system = scaled @ self.partial - cross.T @ self.slopes
        self.gradient = scaled @ self.residuals - self.slopes.T @ slope


def cost_of(walks: Walks, solution: Solution, prior: Prior) -> float:
    """The negative log density of ranges, paths and anchors, with the noise levels of the solution."""
    away, scales = solution.anchors.ravel() - prior.mean, solution.scales[walks.anchor]
    bending, walk = walks.bending
    densities, bends = solution.densities[walk], bending.T @ solution.path
    ranges = (DOF + 1.0) * np.log1p((walks.errors(solution)[0] / scales) ** 2 / DOF) + 2.0 * np.log(scales)
    paths = bends**2 / densities + np.log(densities)
    return 0.5 * float(away @ prior.precision @ away + ranges.sum() + paths.sum())


def solved(walks: Walks, start: Solution, prior: Prior, steps: int = STEPS, levels: bool = True) -> Solution:
    """The solution of least cost near a start, with the noise levels fitted."""
    solution, damping, cost = start, 1e-3, cost_of(walks, start, prior)
    for _ in range(steps):
        limit = cost + 1e-9 * abs(cost)
        while damping < 1e8 and cost_of(walks, moved := _stepped(walks, solution, prior, damping), prior) > limit:
            damping *= 10.0
        if damping >= 1e8:
            break
        before, solution = solution, _levelled(walks, moved) if levels else moved
        damping, cost = max(damping / 5.0, 1e-9), cost_of(walks, solution, prior)
        change = np.abs(np.log(solution.scales / before.scales)).max()
        if max(np.abs(moved.anchors - before.anchors).max(), 1e-3 * change) < CONVERGED:
            break
    # Half the log determinant of the paths' information makes the cost marginal.
    return replace(solution, cost=cost + 0.5 * float(np.log(Equations(walks, solution).factor.U.diagonal()).sum()))


def _stepped(walks: Walks, solution: Solution, prior: Prior, damping: float) -> Solution:
    """The solution after a damped step of Gauss and Newton."""
    found, free, move = Equations(walks, solution, damping), prior.free, np.zeros(prior.free.shape)
    gradient = found.gradient + prior.precision @ (prior.mean - solution.anchors.ravel())
    block = (found.system + prior.precision)[np.ix_(free, free)]
    move[free] = np.linalg.solve(block + np.diag(damping * np.diag(block) + 1e-9), gradient[free])
    path = solution.path + found.step - found.slopes @ move
    return replace(solution, anchors=solution.anchors + move.reshape(-1, 4), path=path)


def _levelled(walks: Walks, solution: Solution) -> Solution:
    """The solution with noise levels of greater marginal likelihood."""
    found, random, (bending, walk) = Equations(walks, solution), np.random.default_rng(0), walks.bending
    # Draws from the density of the paths at these anchors.
    noise = np.sqrt(found.weights)[:, None] * random.standard_normal((len(walks.walk), PROBES))
    rough = bending.multiply(solution.densities[walk] ** -0.5).tocsr()
    drawn = found.factor.solve(found.along.T @ noise + rough @ random.standard_normal((len(walk), PROBES)))
    leverage = found.weights * ((found.along @ drawn) ** 2).mean(axis=1)
    squares = np.bincount(walks.anchor, found.weights * found.residuals**2, len(solution.scales))
    # Four unknowns of each anchor are fitted to its ranges, too.
    numbers = np.bincount(walks.anchor, 1.0 - np.minimum(leverage, 1.0), len(solution.scales)) - 4.0
    scales = np.maximum(solution.scales * np.sqrt(squares / np.maximum(numbers, 1.0)), LEAST_SCALE)
    bends, unseen = (bending.T @ solution.path) ** 2, ((rough.T @ drawn) ** 2).mean(axis=1)
    size, bent, free = (np.bincount(walk, of) for of in (bends, None, 1.0 - unseen))
    densities = np.clip(size / np.maximum(free, 0.05 * bent), 1e-4, 1e3)
    return replace(solution, scales=np.where(squares > 0, scales, solution.scales), densities=densities)


def design_effect(walks: Walks, solution: Solution, free: Bool[np.ndarray, " U"]) -> float:
    """By how much the scatter of the scores exceeds independent errors'; at least 1. Errors last: scores are
    summed over pieces of time and over cubes, each of one anchor (Cameron and Miller 2015), and the largest scatter
    counts. Paths take up the errors that all anchors could share with a motion."""
    found = Equations(walks, solution)
    values, vectors = np.linalg.eigh(found.system[np.ix_(free, free)])
    kept = values > 1e-6 * values[-1]
    whiten, p = vectors[:, kept] / np.sqrt(values[kept]), kept.sum()
    scores = (found.partial - found.along @ found.slopes) * (found.weights * found.residuals)[:, None]
    score, effects, spots = scores[:, free] @ whiten, [], walks.positions(solution.path)
    for keys in [walks.times[:, None] // length for length in LENGTHS] + [spots // size for size in SIZES]:
        code = np.unique(np.column_stack([keys, walks.anchor]), axis=0, return_inverse=True)[1].ravel()
        sums, groups = np.stack([np.bincount(code, column) for column in score.T]), code.max() + 1
        effects.append((sums**2).sum() / p * groups / max(groups - p, 0.2 * groups))
    seen = len(np.unique([walks.walk, walks.anchor], axis=1).T) / len(walks.names)
    return max(1.0, max(effects) / FISHER * seen / max(seen - 2.0 - np.isnan(walks.heights).mean(), 1.0))


def covariance_of(walks: Walks, solution: Solution, prior: Prior, effect: float) -> Float[np.ndarray, "U U"]:
    """The covariance of what is free."""
    inside, height, anchors = np.ix_(prior.free, prior.free), walks.heights[0], solution.anchors.copy()
    if (walks.heights == height).all():
        # Ranges see the square of a height over the walk, whose derivative by that height vanishes at zero.
        over = anchors[:, 2] - height
        anchors[:, 2] = height + np.copysign(np.maximum(np.abs(over), LEVEL), over)
    system = Equations(walks, replace(solution, anchors=anchors), expected=True).system
    covariance = np.zeros_like(system)
    # A standard deviation of a kilometre for what nothing determines.
    covariance[inside] = np.linalg.inv((system / effect + prior.precision)[inside] + 1e-6 * np.eye(prior.free.sum()))
    return covariance
