"""On which side of a walk anchors stand, and how well they are determined: their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.core.data.consistency import NORMAL
from trackwright.tuning.survey.frames import aligned, tags
from trackwright.tuning.survey.solving import Prior, Solution, information, solved
from trackwright.tuning.survey.starts import descended, misfit, ranges_to
from trackwright.tuning.survey.walks import LEVEL, Walk, common_height

UNLIKELY = 4.0
"""Log-likelihood ratio from which a mirror image is excluded."""

LIFT = 1.0
"""Height over a walk, m, from which an anchor at its height is tried again."""


def off_level(walks: Sequence[Walk], solution: Solution, prior: Prior) -> Solution:
    """The better of the solution and that from a start with the anchors at the walk's height above it.

    At that height the derivative by the height is zero: a fit stays there, whether or not it is best.
    """
    height, anchors = common_height(walks), solution.anchors.copy()
    level = prior.free[2::4] & (np.abs(anchors[:, 2] - (np.inf if height is None else height)) < LEVEL)
    anchors[level, 2] += LIFT
    starts = [solution, replace(solution, anchors=anchors)][: 1 + level.any()]
    return min((solved(walks, start, prior) for start in starts), key=lambda s: s.cost)


def sided(
    walks: Sequence[Walk], solution: Solution, known: np.ndarray | None, free: Bool[np.ndarray, "A 4"], effect: float
) -> tuple[Solution, Bool[np.ndarray, " A"]]:
    """The solution with anchors on the likely side of the walk's plane, and of which the other side fits as well.

    That side is where the rig has an anchor, `known` (A, 3), NaN where it does not, and otherwise above. Anchors whose
    heights are not `free` have no other side.
    """
    at = tags(walks, solution)
    centre = at.mean(axis=0)
    normal = np.linalg.svd(at[:: max(1, len(at) // 2000)] - centre, full_matrices=False)[2][-1]
    anchors, mirrored = solution.anchors.copy(), np.zeros(len(solution.anchors), bool)
    for k in np.flatnonzero(free[:, 2]).tolist():
        anchor = solution.anchors[k]
        positions, ranges = ranges_to(walks, solution, k)
        offset = (anchor[:3] - centre) @ normal
        image = descended(anchor[None, :3] - 2.0 * offset * normal, positions, ranges, anchor[3])[0]
        if ((image - centre) @ normal) * offset >= 0.0:
            continue
        worse = misfit(image, positions, ranges - anchor[3], solution.scales[k])
        worse -= misfit(anchor[:3], positions, ranges - anchor[3], solution.scales[k])
        if worse / effect >= UNLIKELY:
            continue
        other, mirrored[k] = image[2] > anchor[2], True
        if known is not None and np.isfinite(known[k, 2]):
            side = np.abs(known[k, 2] - [anchor[2], image[2]])
            other, mirrored[k] = side[1] < side[0], abs(known[k, 2] - centre[2]) < side.min()
        if other:
            anchors[k, :3] = np.where(free[k, :3], image, anchor[:3])
    return replace(solution, anchors=anchors), mirrored


def covariance_of(walks: Sequence[Walk], solution: Solution, prior: Prior, effect: float) -> Float[np.ndarray, "U U"]:
    """The covariance of what is free."""
    free = np.flatnonzero(prior.free)
    height, lifted = common_height(walks), solution.anchors.copy()
    if height is not None:
        # Ranges see the square of a height over the walk, whose derivative by that height vanishes at zero.
        over = lifted[:, 2] - height
        sizes = np.maximum(np.abs(over), LEVEL)
        lifted[:, 2] = height + np.copysign(sizes, over)
    precision = information(walks, replace(solution, anchors=lifted)) / effect + prior.precision
    covariance = np.zeros_like(precision)
    # A standard deviation of a kilometre for what nothing determines.
    covariance[np.ix_(free, free)] = np.linalg.inv(precision[np.ix_(free, free)] + 1e-6 * np.eye(len(free)))
    if height is not None:
        for k in np.flatnonzero((prior.free & (np.diag(prior.precision) == 0.0)).reshape(-1, 4)[:, 2]):
            # The interval is the root of that of the square.
            row, deviation = 4 * k + 2, np.sqrt(covariance[4 * k + 2, 4 * k + 2])
            square = over[k] ** 2 + 2.0 * sizes[k] * NORMAL * deviation * np.array([-1.0, 1.0])
            wider = np.abs(np.sqrt(np.maximum(square, 0.0)) - abs(over[k])).max() / (NORMAL * deviation)
            covariance[row, :] *= wider
            covariance[:, row] *= wider
    return covariance


def between(minima: Sequence[Solution], effect: float, flat: bool) -> Float[np.ndarray, " U"]:
    """The variances, m², of the unknowns by the distances between minima of the cost that are about equally likely."""
    best, d = minima[0].anchors, 2 if flat else 3
    variances = np.zeros_like(best)
    for other in minima[1:]:
        if (other.cost - minima[0].cost) / effect < UNLIKELY:
            moves = aligned(other.anchors[:, :3], best[:, :3], d)
            places = [other.anchors[:, :3] @ turn.T + shift for turn, shift in moves]
            away = min((place - best[:, :3] for place in places), key=lambda x: float((x[:, :d] ** 2).sum()))
            # A known height of tags leaves images above and below, which `mirrored` states.
            away[:, d:] = 0.0
            variances[:, :d] = np.maximum(variances[:, :d], (away**2).sum(axis=1)[:, None])
            variances[:, 3] = np.maximum(variances[:, 3], (other.anchors[:, 3] - best[:, 3]) ** 2)
    return variances.ravel()
