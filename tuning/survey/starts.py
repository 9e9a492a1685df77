"""Starts of a survey without any position: distance geometry on ranges of one walk, brought to common times.

With an anchor at the origin, the differences of squared ranges d_ij² − d_i1² of times i and anchors j are linear in the
tag's positions: centred over time they are −2(x_i − x̄)·p_j, of rank 3, or 2 for a walk in a plane, whose height above
an anchor is a constant of it. Their singular vectors are positions up to an affine map, which d_i1² = |x_i|² determines
by linear least squares (Crocco, Del Bue and Murino 2012). Wild ranges and delays are met by many draws of times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from trackwright.tuning.survey.solving import DOF, Prior, Solution, robust_weights, solved
from trackwright.tuning.survey.walks import LEAST_SCALE, Walk

DRAWS, KEPT = 150, 4
"""Draws of times, of each walk and rank, and how many of the best are refined."""

EPOCHS, DRAWN = 120, 30
"""Times of a walk with a range to each anchor, and how many make a draw."""

NEAR = 0.75
"""Largest time, s, to the next range to an anchor on either side of such a time."""

DELAY = 0.3
"""Standard deviation of the delay, m, common to all anchors, that is drawn."""

FLAT = 0.3
"""Largest third extent of anchors, as a share of their second one, with which they count as in one plane."""

FIRST_SCALE, FIRST_DENSITY = 0.2, 0.3
"""Noise levels with which the search begins: m, and m²/s³."""

_RESECTIONS, _RESECTED, _DESCENT = 12, 100, 20
_ROUNDS, _FEW, _REFINED = 3, 10, 3


def epochs(walk: Walk, count: int) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k A"]]:
    """Times, s, of a walk, and the ranges, m, to `count` anchors at each, interpolated; NaN where none is near."""
    times = np.linspace(walk.times[0], walk.times[-1], EPOCHS + 2)[1:-1]
    ranges = np.full((len(times), count), np.nan)
    for k in range(count):
        own = np.flatnonzero(walk.anchor == k)
        if len(own) < 5:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(walk.values[own], 1, mode="edge"), 3)
        at = walk.times[own]
        after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
        near = (times - at[after - 1] <= NEAR) & (at[after] - times <= NEAR) & (times >= at[0])
        ranges[near, k] = np.interp(times, at, np.median(windows, axis=1))[near]
    return times, ranges


def factorised(
    squares: Float[np.ndarray, "k A"], rank: int
) -> tuple[Float[np.ndarray, "k d"], Float[np.ndarray, "A d"], Float[np.ndarray, " A"]] | None:
    """Positions of tag and anchors, and the squared heights of the anchors over the walk, from squared ranges.

    The first anchor is at the origin. None where the ranges do not determine them.
    """
    differences = squares[:, 1:] - squares[:, :1]
    means = differences.mean(axis=0)
    left, values, right = np.linalg.svd(differences - means, full_matrices=False)
    if values[rank - 1] < 1e-6 * values[0]:
        return None
    left, right = left[:, :rank] * values[:rank], right[:rank].T
    upper = np.triu_indices(rank)
    quadratic = (left[:, :, None] * left[:, None, :] * (2.0 - np.eye(rank)))[:, upper[0], upper[1]]
    terms = np.linalg.lstsq(np.column_stack([quadratic, 2.0 * left, np.ones(len(left))]), squares[:, 0], rcond=None)[0]
    metric = np.zeros((rank, rank))
    metric[upper] = terms[: len(upper[0])]
    metric = metric + metric.T - np.diag(np.diag(metric))
    eigenvalues, vectors = np.linalg.eigh(metric)
    if eigenvalues[-1] <= 0:
        return None
    root = np.sqrt(np.maximum(eigenvalues, 1e-3 * eigenvalues[-1]))
    stretch = (root * vectors).T
    linear, constant = terms[len(upper[0]) : -1], terms[-1]
    centre = np.linalg.solve(stretch.T, linear)
    tags = left @ stretch.T + centre
    anchors = np.vstack([np.zeros(rank), -0.5 * np.linalg.solve(stretch.T, right.T).T])
    heights = np.append(0.0, means - (anchors[1:] ** 2).sum(axis=1) + 2.0 * anchors[1:] @ centre)
    return tags, anchors, heights + constant - centre @ centre


def distance_geometry(walk: Walk, count: int, random: np.random.Generator) -> Iterator[np.ndarray]:
    """Anchors (count, 3), m, NaN where not found, from the ranges of a walk alone; the best draws first."""
    _, ranges = epochs(walk, count)
    seen = np.isfinite(ranges)
    # The anchors that have most of the times in common with the one seen most.
    chosen = [int(np.argmax(seen.sum(axis=0)))]
    while len(chosen) < count:
        common = seen[:, chosen].all(axis=1)
        gains = np.where(np.isin(np.arange(count), chosen), -1, (seen & common[:, None]).sum(axis=0))
        if gains.max() < max(DRAWN // 2, 0.3 * common.sum()):
            break
        chosen.append(int(np.argmax(gains)))
    whole = ranges[seen[:, chosen].all(axis=1)][:, chosen]
    if len(whole) < 12:
        return
    for rank in (2, 3) if walk.height is None else (2,):
        if len(chosen) <= rank:
            continue
        found = []
        for _ in range(DRAWS):
            order = random.permutation(len(chosen))
            rows = random.permutation(len(whole))[: min(DRAWN, max(len(whole) // 2, 12))]
            shift = DELAY * random.standard_normal()
            fit = factorised((np.maximum(whole[rows][:, order] - shift, 0.01)) ** 2, rank)
            if fit is None:
                continue
            tags, anchors, heights = fit
            vertical = np.sqrt(np.maximum(heights, 0.0)) if rank == 2 else np.zeros(len(chosen))
            distances = np.sqrt(((tags[:, None] - anchors) ** 2).sum(axis=2) + vertical**2)
            error = float(np.median(np.abs(whole[rows][:, order] - shift - distances)))
            places = np.full((count, 3), np.nan)
            places[np.array(chosen)[order], :rank] = anchors
            if rank == 2:
                places[np.array(chosen)[order], 2] = vertical + (walk.height or 0.0)
            found.append((error, places))
        yield from (places for _, places in sorted(found, key=lambda pair: pair[0])[:KEPT])


def located(walk: Walk, anchors: Float[np.ndarray, "A 4"], scale: float) -> np.ndarray:
    """The coefficients of the path of a walk among known anchors."""
    count = len(anchors)
    times, ranges = epochs(walk, count)
    positions = np.array([_multilaterated(r, anchors[:, :3], walk.height) for r in ranges])
    found = np.isfinite(positions[:, 0])
    if not found.any():
        positions[:], found[:] = anchors[np.unique(walk.anchor), :3].mean(axis=0), True
    at = np.column_stack([np.interp(walk.times, times[found], column) for column in positions[found].T])
    prior = Prior(np.zeros(4 * count), np.zeros((4 * count, 4 * count)), np.zeros(4 * count, bool))
    start = Solution(anchors, [walk.fitted(at)], np.full(count, scale), np.full(1, FIRST_DENSITY))
    return solved([walk], start, prior, steps=15, levels=False).paths[0]


def _multilaterated(ranges: np.ndarray, anchors: np.ndarray, height: float | None) -> np.ndarray:
    """The position (3,), m, from one epoch of ranges (A,), m, NaN where they are too few: linear in its square."""
    seen = np.isfinite(ranges)
    if seen.sum() < 3:
        return np.full(3, np.nan)
    places, squares = anchors[seen], ranges[seen] ** 2
    if height is not None:
        places, squares = places[:, :2], squares - (places[:, 2] - height) ** 2
    centre = places.mean(axis=0)
    offset = places - centre
    _, sizes, axes = np.linalg.svd(offset, full_matrices=False)
    # Anchors in a plane leave the distance from it to the length of the ranges.
    kept = sizes > (FLAT * sizes[1] if height is None and len(sizes) > 2 else 0.0)
    kept &= np.arange(len(sizes)) < seen.sum() - 1
    along = offset @ axes[kept].T
    excess = (offset**2).sum(axis=1) - squares
    inside = np.linalg.lstsq(along, 0.5 * (excess - excess.mean()), rcond=None)[0]
    position = centre + inside @ axes[kept]
    if height is not None:
        return np.append(position, height)
    beyond = float(np.mean(squares - ((places - position) ** 2).sum(axis=1)))
    normal = np.cross(axes[0], axes[1]) if kept.sum() == 2 else np.zeros(3)
    return position - normal * np.sign(normal[2]) * np.sqrt(max(beyond, 0.0))


def descended(
    places: Float[np.ndarray, "s 3"], positions: Float[np.ndarray, "n 3"], ranges: Float[np.ndarray, " n"], delay: float
) -> Float[np.ndarray, "s 3"]:
    """Positions of an anchor, m, with these ranges to a tag at known positions, near each of some starts."""
    size = float(np.median(ranges))
    for _ in range(_DESCENT):
        offset = places[:, None] - positions
        distance = np.maximum(np.sqrt((offset**2).sum(axis=2)), 1e-6)
        residuals = ranges - delay - distance
        scale = np.maximum(1.5 * np.median(np.abs(residuals), axis=1, keepdims=True), LEAST_SCALE)
        weighted = offset / distance[:, :, None] * robust_weights(residuals, scale)[:, :, None]
        system = np.einsum("sni,snj->sij", weighted, offset / distance[:, :, None])
        system += 1e-4 * np.trace(system, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        move = np.linalg.solve(system, np.einsum("sni,sn->si", weighted, residuals)[:, :, None])[:, :, 0]
        places = places + move * np.minimum(1.0, size / np.maximum(np.abs(move).max(axis=1, keepdims=True), 1e-9))
    return places


def resected(
    positions: Float[np.ndarray, "n 3"], ranges: Float[np.ndarray, " n"], delay: float, random: np.random.Generator
) -> Float[np.ndarray, " 3"]:
    """The position of an anchor, m, with these ranges to a tag at known positions: the best from random starts."""
    every = max(1, len(ranges) // _RESECTED)
    positions, ranges = positions[::every], ranges[::every]
    starts = positions.mean(axis=0) + float(np.median(ranges)) * random.standard_normal((_RESECTIONS, 3))
    places = descended(starts, positions, ranges, delay)
    errors = ranges - delay - np.sqrt(((places[:, None] - positions) ** 2).sum(axis=2))
    return places[np.argmin(np.median(np.abs(errors), axis=1))]


def misfit(place: np.ndarray, positions: np.ndarray, distances: np.ndarray, scale: float) -> float:
    """The negative log-likelihood, up to a constant, of distances (n,), m, from a place (3,) to positions (n, 3)."""
    errors = distances - np.sqrt(((positions - place) ** 2).sum(axis=1))
    return 0.5 * (DOF + 1.0) * float(np.log1p((errors / scale) ** 2 / DOF).sum())


def ranges_to(walks: Sequence[Walk], solution: Solution, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The positions (n, 3) of the tags, m, when they measured the ranges (n,), m, to anchor `k`."""
    own = [walk.anchor == k for walk in walks]
    positions = [w.positions(path)[rows] for w, path, rows in zip(walks, solution.paths, own, strict=True)]
    return np.concatenate(positions), np.concatenate([w.values[rows] for w, rows in zip(walks, own, strict=True)])


def completed(
    walks: Sequence[Walk], places: Float[np.ndarray, "A 3"], first: int, random: np.random.Generator
) -> Solution | None:
    """A start with all anchors and paths, from the anchors that the walk number `first` gave; None where some lack."""
    anchors = np.column_stack([places, np.zeros(len(places))])
    paths: list[np.ndarray | None] = [None] * len(walks)
    order = sorted(range(len(walks)), key=lambda k: k != first)
    while order:
        known = np.isfinite(anchors[:, 0])
        ready = [k for k in order if known[np.unique(walks[k].anchor)].sum() >= 3]
        if not ready:
            return None
        k = ready[0]
        order.remove(k)
        walk = walks[k]
        use = known[walk.anchor]
        numbers = np.flatnonzero(known)
        anchor = np.searchsorted(numbers, walk.anchor[use])
        part = replace(walk, times=walk.times[use], values=walk.values[use], anchor=anchor)
        path = located(part, anchors[known], FIRST_SCALE)
        positions = walk.positions(walk.fitted(_at(part, path, walk.times)))
        paths[k] = walk.fitted(positions)
        for new in np.setdiff1d(np.unique(walk.anchor), numbers):
            rows = walk.anchor == new
            anchors[new, :3] = resected(positions[rows], walk.values[rows], 0.0, random)
            anchors[new, 3] = 0.0
    if not np.isfinite(anchors).all():
        return None
    levels = np.full(len(anchors), FIRST_SCALE), np.full(len(walks), FIRST_DENSITY)
    return Solution(anchors, [path for path in paths if path is not None], *levels)


def _at(part: Walk, path: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The positions of a path at other times, m."""
    positions = part.positions(path)
    return np.column_stack([np.interp(times, part.times, column) for column in positions.T])


def polished(walks: Sequence[Walk], solution: Solution, prior: Prior, random: np.random.Generator) -> Solution:
    """The solution, with anchors that stand in a local minimum of their own moved to a better one."""
    for _ in range(_ROUNDS):
        anchors = solution.anchors.copy()
        for k in np.flatnonzero(prior.free.reshape(-1, 4)[:, :3].all(axis=1)).tolist():
            positions, ranges = ranges_to(walks, solution, k)
            place, scale = resected(positions, ranges, anchors[k, 3], random), solution.scales[k]
            gain = misfit(anchors[k, :3], positions, ranges - anchors[k, 3], scale)
            gain -= misfit(place, positions, ranges - anchors[k, 3], scale)
            if gain > 2.0 and np.linalg.norm(place - anchors[k, :3]) > 0.2:
                anchors[k, :3] = place
        if (anchors == solution.anchors).all():
            break
        better = solved(walks, replace(solution, anchors=anchors), prior)
        if better.cost >= solution.cost:
            break
        solution = better
    return solution


def multistart(
    walks: Sequence[Walk], known: Float[np.ndarray, "A 3"], prior: Prior, random: np.random.Generator
) -> list[Solution]:
    """The best solutions from many starts, in any frame, that of least cost first; none where there is no start.

    `known`: positions, m, that are one more start where all are there.
    """
    # A walk of known height gives the vertical.
    longest = sorted(range(len(walks)), key=lambda k: (walks[k].height is None, -len(walks[k].values)))[:2]
    starts = [(first, places) for first in longest for places in distance_geometry(walks[first], len(known), random)]
    if np.isfinite(known).all():
        starts.append((longest[0], known))
    whole = (completed(walks, places, first, random) for first, places in starts)
    tried = sorted((solved(walks, start, prior, _FEW) for start in whole if start is not None), key=lambda s: s.cost)
    refined = (polished(walks, solved(walks, start, prior), prior, random) for start in tried[:_REFINED])
    return sorted(refined, key=lambda s: s.cost)
