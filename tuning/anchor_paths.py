"""The most probable anchors and paths for ranges with errors of Student's t.

Levenberg–Marquardt on all of them at once: the banded information of the paths is factorised and eliminated, which
leaves four unknowns an anchor. Scales of errors and densities of accelerations have the greatest marginal
likelihood, linearised (MacKay 1992): random probes count the directions that the ranges determine.

A path is a cubic spline with knots every `STEP` s. Its prior density, exp(−½∫|x''|²dt / q), is of white
acceleration of spectral density q, m²/s³. Each range depends on four neighbouring coefficients: matrices are banded.

Starts come without any position, by distance geometry on ranges of one walk, brought to common times. With an anchor at
the origin, the differences of squared ranges d_ij² − d_i1² of times i and anchors j are linear in the tag's positions:
centred over time they are −2(x_i − x̄)·p_j, of rank 3, or 2 for a walk in a plane, whose height above an anchor is a
constant of it. Their singular vectors are positions up to an affine map, which d_i1² = |x_i|² determines by linear
least squares (Crocco, Del Bue and Murino 2012). Wild ranges and delays are met by many draws of times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int
from scipy.interpolate import BSpline
from scipy.ndimage import median_filter
from scipy.sparse.linalg import splu, spsolve

from trackwright.trackers.recordings.folder import RecordingFolder

DOF = 4.0  # degrees of freedom of Student's t of the errors
FISHER = (DOF + 1.0) / (DOF + 3.0)  # information of a range with such errors, by a normal one's of the same scale
LENGTHS, SIZES = (1.0, 2.0, 4.0, 8.0, 16.0), (1.0, 2.0)  # pieces of time, s, and edges of cubes, m, of equal errors
STEP, AVERAGE, GAP = 0.25, 0.1, 5.0  # s: between knots of a path, of averages of ranges, after which a path begins anew
LEAST_SCALE, FEWEST = 0.01, 20  # least scale of errors, m; ranges of a walk

PROBES, STEPS, CONVERGED = 12, 60, 1e-4
RIDGE = 1e-6  # information, m⁻², of each coefficient of a path: for directions that no range determines


DRAWS, KEPT, REFINED = 150, 4, 3  # draws of times of a walk and rank, how many of the best are tried, how many refined
EPOCHS, DRAWN, NEAR = 120, 30, 0.5  # times of a walk, how many make a draw, most time, s, from one to a range

DELAY, SCALE, DENSITY, IGNORED = 0.3, 0.2, 0.3, 1e6
"""First noise levels: of the common delay and of ranges, m, of paths, m²/s³, of ranges to anchors not found yet, m."""


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
    """All n ranges at a solution: residuals (n,), m, their weights, and derivatives by anchors and by paths; `factor`:
    of the paths' information.

    `damping`: the share by which the diagonal of the paths' information grows. `expected`: with the weights that errors
    of the solution's scales have on average."""

    def __init__(self, walks: Walks, solution: Solution, damping: float = 0.0, expected: bool = False):
        (self.residuals, units), scales = walks.errors(solution), solution.scales[walks.anchor]
        self._walks, self._solution, self._units = walks, solution, units
        self.weights = FISHER / scales**2 if expected else robust_weights(self.residuals, scales)
        away = sparse.csr_array((units.ravel(), np.arange(units.size), np.arange(0, units.size + 1, 3)))
        self.along, (bending, walk) = away @ walks.spread, walks.bending
        self._rough = bending.multiply(1.0 / solution.densities[walk]) @ bending.T
        self._weighted = sparse.csr_array(self.along.T.multiply(self.weights))
        information = self._weighted @ self.along + self._rough
        information = information + sparse.diags_array(damping * information.diagonal() + RIDGE)
        # Banded: no order has less fill.
        self.factor = splu(sparse.csc_array(information), "NATURAL", 0.0, options={"SymmetricMode": True})

    @cached_property
    def partial(self) -> Float[np.ndarray, "n U"]:
        """The derivatives of the ranges by the anchors."""
        own, each = np.column_stack([-self._units, np.ones(len(self._units))]), np.eye(len(self._solution.anchors))
        return (own[:, None] * each[self._walks.anchor, :, None]).reshape(len(own), -1)

    @cached_property
    def slope(self) -> Float[np.ndarray, " M"]:
        """The gradient by the paths."""
        return self._weighted @ self.residuals - self._rough @ self._solution.path

    @cached_property
    def slopes(self) -> Float[np.ndarray, "M U"]:
        """How far paths move with anchors."""
        return self.factor.solve(self._weighted @ self.partial)

    @cached_property
    def system(self) -> Float[np.ndarray, "U U"]:
        """The information of anchors with the paths eliminated, without the prior."""
        return (self.partial.T * self.weights) @ self.partial - (self._weighted @ self.partial).T @ self.slopes


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
    gradient = (found.partial.T * found.weights) @ found.residuals - found.slopes.T @ found.slope
    gradient += prior.precision @ (prior.mean - solution.anchors.ravel())
    block = (found.system + prior.precision)[np.ix_(free, free)]
    move[free] = np.linalg.solve(block + np.diag(damping * np.diag(block) + 1e-9), gradient[free])
    path = solution.path + found.factor.solve(found.slope) - found.slopes @ move
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
    inside, system = np.ix_(prior.free, prior.free), Equations(walks, solution, expected=True).system
    covariance = np.zeros_like(system)
    # A standard deviation of a kilometre for what nothing determines.
    covariance[inside] = np.linalg.inv((system / effect + prior.precision)[inside] + 1e-6 * np.eye(prior.free.sum()))
    return covariance


def epochs(walk: Walks, count: int) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k A"]]:
    """Times, s, of a walk, and the ranges, m, to `count` anchors at each, interpolated; NaN where none is near."""
    times = np.linspace(walk.times[0], walk.times[-1], EPOCHS + 2)[1:-1]
    ranges = np.full((len(times), count), np.nan)
    for k in np.unique(walk.anchor):
        at, values = (of[walk.anchor == k] for of in (walk.times, walk.values))
        near = np.abs(times[:, None] - at).min(axis=1) <= NEAR
        ranges[near, k] = np.interp(times[near], at, median_filter(values, 3, mode="nearest"))
    return times, ranges


def factorised(squares: Float[np.ndarray, "k A"], rank: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (k, rank) of tag and (A, rank) of anchors, the first at the origin, and their squared heights (A,)."""
    differences = squares[:, 1:] - squares[:, :1]
    means = differences.mean(axis=0)
    left, values, right = np.linalg.svd(differences - means, full_matrices=False)
    left, right = left[:, :rank] * values[:rank], right[:rank].T
    i, j = np.triu_indices(rank)
    columns = [left[:, i] * left[:, j] * np.where(i == j, 1.0, 2.0), 2.0 * left, np.ones(len(left))]
    terms = np.linalg.lstsq(np.column_stack(columns), squares[:, 0], rcond=None)[0]
    metric = np.zeros((rank, rank))
    metric[i, j] = metric[j, i] = terms[: len(i)]
    sizes, vectors = np.linalg.eigh(metric)
    stretch = (np.sqrt(np.maximum(sizes, 1e-3 * np.abs(sizes).max() + 1e-12)) * vectors).T
    centre = np.linalg.solve(stretch.T, terms[len(i) : -1])
    anchors = np.vstack([np.zeros(rank), -0.5 * np.linalg.solve(stretch.T, right.T).T])
    heights = np.append(0.0, means - (anchors[1:] ** 2).sum(axis=1) + 2.0 * anchors[1:] @ centre)
    return left @ stretch.T + centre, anchors, heights + terms[-1] - centre @ centre


def distance_geometry(walk: Walks, count: int, random: np.random.Generator) -> Iterator[np.ndarray]:
    """Anchors (count, 3), m, NaN where not found, from the ranges of a walk alone; the best draws first."""
    _, ranges = epochs(walk, count)
    seen, chosen, common = np.isfinite(ranges), np.zeros(0, int), np.ones(EPOCHS, bool)
    # The anchors that have most of the times in common with the one seen most.
    for k in np.argsort(-seen.sum(axis=0), kind="stable"):
        if not len(chosen) or (common & seen[:, k]).sum() >= max(DRAWN // 2, 0.3 * common.sum()):
            chosen, common = np.append(chosen, k), common & seen[:, k]
    whole = ranges[common]
    for rank in (2, 3) if np.isnan(walk.heights[0]) else (2,):
        found = []
        for _ in range(DRAWS if len(chosen) > rank and len(whole) >= 12 else 0):
            order = random.permutation(chosen)
            rows = random.permutation(len(whole))[: min(DRAWN, max(len(whole) // 2, 12))]
            drawn = np.maximum(whole[rows][:, order] - DELAY * random.standard_normal(), 0.1)
            tags, anchors, heights = factorised(drawn**2, rank)
            vertical = np.sqrt(np.maximum(heights, 0.0)) if rank == 2 else 0.0 * heights
            distances = np.sqrt(((tags[:, None] - anchors) ** 2).sum(axis=2) + vertical**2)
            places = np.full((count, 3), np.nan)
            places[order] = np.column_stack([anchors, vertical + np.nan_to_num(walk.heights[0])])[:, :3]
            found.append((float(np.median(np.abs(drawn - distances))), places))
        yield from (places for _, places in sorted(found, key=lambda pair: pair[0])[:KEPT])


def descended(places: np.ndarray, positions: np.ndarray, ranges: np.ndarray, axes: int = 3) -> np.ndarray:
    """Places (s, 3) near these with ranges (n,) or (s, n), NaN: none, to positions (n, 3), m; moved along `axes`."""
    size, moving = float(np.nanmedian(ranges)), np.arange(3) < axes
    for _ in range(20):
        offset = places[:, None] - positions
        distance = np.maximum(np.linalg.norm(offset, axis=2), 1e-6)
        residuals, units = ranges - distance, offset / distance[:, :, None] * moving
        scale = np.maximum(1.5 * np.nanmedian(np.abs(residuals), axis=1, keepdims=True), LEAST_SCALE)
        weighted = np.swapaxes(units * np.nan_to_num(robust_weights(residuals, scale))[:, :, None], 1, 2)
        system = weighted @ units
        system += 1e-4 * np.trace(system, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        move = np.linalg.solve(system, weighted @ np.nan_to_num(residuals)[:, :, None])[:, :, 0]
        places = places + move * np.minimum(1.0, size / np.maximum(np.abs(move).max(axis=1, keepdims=True), 1e-9))
    return places


def located(walk: Walks, anchors: Float[np.ndarray, "A 4"]) -> np.ndarray:
    """The coefficients of the path of a walk among anchors, NaN for those not known."""
    known, (times, ranges) = np.isfinite(anchors[:, 0]), epochs(walk, len(anchors))
    seen = np.isfinite(ranges[:, known]).sum(axis=1)
    rows = seen >= min(3, seen.max())
    # Aside of all planes in which anchors may be, so that all times are on one side, and below.
    start, axes = anchors[known, :3].mean(axis=0) + np.array([0.3, 0.5, -1.0]), 3
    if np.isfinite(walk.heights[0]):
        start[2], axes = walk.heights[0], 2
    places = descended(np.tile(start, (rows.sum(), 1)), anchors[known, :3], ranges[rows][:, known], axes)
    at = np.column_stack([np.interp(walk.times, times[rows], column) for column in places.T])
    prior = Prior(np.zeros(anchors.size), np.zeros((anchors.size, anchors.size)), np.zeros(anchors.size, bool))
    begun = Solution(np.nan_to_num(anchors), walk.fitted(at), np.where(known, SCALE, IGNORED), np.full(1, DENSITY))
    return solved(walk, begun, prior, steps=15, levels=False).path


def resected(positions: np.ndarray, ranges: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """The place (3,) of an anchor with ranges (n,), m, to a tag at positions (n, 3): the best from random starts."""
    positions, ranges = (of[:: max(1, len(ranges) // 100)] for of in (positions, ranges))
    starts = positions.mean(axis=0) + float(np.median(ranges)) * random.standard_normal((12, 3))
    places = descended(starts, positions, ranges)
    errors = ranges - np.linalg.norm(places[:, None] - positions, axis=2)
    return places[np.argmin(np.median(np.abs(errors), axis=1))]


def completed(walks: Walks, places: np.ndarray, first: int, random: np.random.Generator) -> Solution | None:
    """A start with all anchors and paths, from places (A, 3) that walk number `first` gave; None where some lack."""
    anchors, paths = np.column_stack([places, np.zeros(len(places))]), dict[int, np.ndarray]()
    each = [walks.only(k) for k in range(len(walks.names))]
    while ready := [
        k for k, x in enumerate(each) if k not in paths and np.isfinite(anchors[np.unique(x.anchor), 0]).sum() >= 3
    ]:
        k = first if first in ready else ready[0]
        walk, paths[k] = each[k], located(each[k], anchors)
        for new in np.unique(walk.anchor[np.isnan(anchors[walk.anchor, 0])]):
            own = walk.anchor == new
            anchors[new, :3] = resected(walk.positions(paths[k])[own], walk.values[own], random)
    if len(paths) < len(each):
        return None
    levels = np.full(len(anchors), SCALE), np.full(len(each), DENSITY)
    return Solution(anchors, np.concatenate([paths[k] for k in range(len(each))]), *levels)


def multistart(walks: Walks, known: np.ndarray, prior: Prior, random: np.random.Generator) -> list[Solution]:
    """The best solutions from many starts, of least cost first; `known` (A, 3), m, is one more, where all are there."""
    # A walk of known height gives the vertical.
    longest = np.lexsort([-np.bincount(walks.walk), np.isnan(walks.heights)])[:2].tolist()
    starts = [(k, places) for k in longest for places in distance_geometry(walks.only(k), len(known), random)]
    if np.isfinite(known).all():
        starts.append((longest[0], known))
    whole = (completed(walks, places, first, random) for first, places in starts)
    tried = sorted((solved(walks, start, prior, 10) for start in whole if start is not None), key=lambda s: s.cost)
    return sorted((solved(walks, start, prior) for start in tried[:REFINED]), key=lambda s: s.cost)
