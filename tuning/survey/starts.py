"""Starts of a survey without any position: distance geometry on ranges of one walk, brought to common times.

With an anchor at the origin, the differences of squared ranges d_ij² − d_i1² of times i and anchors j are linear in the
tag's positions: centred over time they are −2(x_i − x̄)·p_j, of rank 3, or 2 for a walk in a plane, whose height above
an anchor is a constant of it. Their singular vectors are positions up to an affine map, which d_i1² = |x_i|² determines
by linear least squares (Crocco, Del Bue and Murino 2012). Wild ranges and delays are met by many draws of times.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter

from trackwright.tuning.survey.solving import DOF, LEAST_SCALE, Prior, Solution, Walks, robust_weights, solved

DRAWS, KEPT, REFINED = 150, 4, 3
"""Draws of times, of each walk and rank, how many of the best are tried, and how many of those are refined."""

EPOCHS, DRAWN, NEAR = 120, 30, 0.5
"""Times of a walk, how many make a draw, and the largest time, s, from such a time to a range to an anchor."""

DELAY, SCALE, DENSITY, IGNORED = 0.3, 0.2, 0.3, 1e6
"""First noise levels: of the common delay and of ranges, m, of paths, m²/s³, of ranges to anchors not found yet, m."""


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


def seen_from(walks: Walks, solution: Solution, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The positions (n, 3) of the tags, m, when they were these distances (n,), m, from anchor `k`."""
    own = walks.anchor == k
    return walks.positions(solution.path)[own], walks.values[own] - solution.anchors[k, 3]


def likelier(walks: Walks, solution: Solution, k: int, place: np.ndarray) -> float:
    """By how much the log-likelihood of the ranges to anchor `k` grows with it at this place, m."""
    positions, distances = seen_from(walks, solution, k)
    errors = (distances - np.linalg.norm(positions - x, axis=1) for x in (solution.anchors[k, :3], place))
    here, there = (0.5 * (DOF + 1.0) * np.log1p((e / solution.scales[k]) ** 2 / DOF).sum() for e in errors)
    return float(here - there)


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


def polished(walks: Walks, start: Solution, prior: Prior, random: np.random.Generator) -> Solution:
    """The solution near a start, with anchors that stand in a local minimum of their own moved to a better one."""
    solution = solved(walks, start, prior)
    anchors = solution.anchors.copy()
    for k in np.flatnonzero(prior.free.reshape(-1, 4)[:, :3].all(axis=1)).tolist():
        place = resected(*seen_from(walks, solution, k), random)
        if likelier(walks, solution, k, place) > 2.0 and np.linalg.norm(place - anchors[k, :3]) > 0.2:
            anchors[k, :3] = place
    moved = (anchors != solution.anchors).any()
    better = solved(walks, replace(solution, anchors=anchors), prior) if moved else solution
    return better if better.cost < solution.cost else solution


def multistart(walks: Walks, known: np.ndarray, prior: Prior, random: np.random.Generator) -> list[Solution]:
    """The best solutions from many starts, of least cost first; `known` (A, 3), m, is one more, where all are there."""
    # A walk of known height gives the vertical.
    longest = np.lexsort([-np.bincount(walks.walk), np.isnan(walks.heights)])[:2].tolist()
    starts = [(k, places) for k in longest for places in distance_geometry(walks.only(k), len(known), random)]
    if np.isfinite(known).all():
        starts.append((longest[0], known))
    whole = (completed(walks, places, first, random) for first, places in starts)
    tried = sorted((solved(walks, start, prior, 10) for start in whole if start is not None), key=lambda s: s.cost)
    refined = (polished(walks, start, prior, random) for start in tried[:REFINED])
    return sorted(refined, key=lambda s: s.cost)
