"""The frame of surveyed anchors, on which side of the walks they stand, and how well they are determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.core.errors import UnusableInput
from trackwright.tuning.survey.solving import Prior, Solution, equations
from trackwright.tuning.survey.starts import descended, likelier, seen_from
from trackwright.tuning.survey.walks import LEVEL, Walks

EXACT, ASIDE, UNLIKELY = 1e-3, 0.1, 4.0
"""Deviation of exact positions, m; a frame's least height over base; ratio of log-likelihoods that excludes a place."""


def aligned(points: np.ndarray, onto: np.ndarray, d: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The rotation or reflection (3, 3) and shift (3,) of d coordinates of points (k, 3) onto others (Kabsch 1976), two
    of a plane."""
    a, b = points[:, :d], onto[:, :d]
    left, sizes, right = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    moves = []
    for sign in (1.0, -1.0) if sizes[-1] < 1e-2 * sizes[0] else (1.0,):
        turn, shift = np.eye(3), np.zeros(3)
        turn[:d, :d] = (left * np.append(np.ones(d - 1), sign) @ right).T
        shift[:d] = b.mean(axis=0) - turn[:d, :d] @ a.mean(axis=0)
        moves.append((turn, shift))
    return moves


def triangle(names: Sequence[str], frame: Sequence[str], anchors: np.ndarray, d: int) -> tuple[list[int], np.ndarray]:
    """The anchors of the frame, those named, or the first two and the next aside, and their places (3, 3) in it, m."""
    a, b = (names.index(name) for name in (frame or names)[:2])
    length = np.linalg.norm((anchors[b] - anchors[a])[:d])
    for c in [names.index(frame[2])] if frame else range(2, len(names)):
        ahead = (anchors[c] - anchors[a])[:d] @ (anchors[b] - anchors[a])[:d] / length
        aside = np.sqrt(max(((anchors[c] - anchors[a])[:d] ** 2).sum() - ahead**2, 0.0))
        if aside > ASIDE * length:
            return [a, b, c], np.array([[0.0, 0.0, 0.0], [length, 0.0, 0.0], [ahead, aside, 0.0]])
    words = ", ".join(frame or names)
    raise UnusableInput(f"{words}: stand in a line; expected three anchors that do not; give others as --frame")


def framed(
    walks: Walks, solution: Solution, prior: Prior, names: Sequence[str], known: np.ndarray,
    given: Sequence[str], sigma: float, frame: Sequence[str],
) -> tuple[Solution, Prior, list[str]]:  # fmt: skip
    """The solution among the given anchors or in the frame of three, the prior with what that fixes, and assumptions.
    `known` (A, 3): positions, m, of the given ones, of standard deviation `sigma`, m."""
    flat, anchors = bool(np.isfinite(walks.heights).any()), solution.anchors[:, :3]
    d, free, mean, precision = 2 if flat else 3, prior.free.reshape(-1, 4).copy(), prior.mean.copy(), prior.precision
    target, notes = known.copy(), []
    if given:
        chosen = [names.index(name) for name in given]
        places = known[chosen]
        if len(places) < 3 or np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] < 0.1:
            words = "leave a rotation about their line; expected three that are not in one; give more"
            raise UnusableInput(f"given {','.join(given)}: {words}")
        free[chosen, :3] = sigma >= EXACT
        stated = np.isin(np.arange(len(mean)) // 4, chosen) & (np.arange(len(mean)) % 4 < 3)
        mean[stated], precision = places.ravel(), precision + np.diag(stated / max(sigma, EXACT) ** 2)
    else:
        chosen, places = triangle(names, frame, anchors, d)
        target[chosen] = places
        for k, first in zip(chosen, range(3), strict=True):
            free[k, first:d] = False
        if not flat:
            notes.append("the mirror image of all, z as -z, fits as well; tags are assumed below the frame's anchors")
        if not frame:
            words = ", ".join(names[k] for k in chosen)
            notes.append(f"frame: {words}: origin, x axis, and to the left of it; --given or --frame choose another")
    placed = []
    for turn, shift in aligned(anchors[chosen], target[chosen], d):
        moved = solution.anchors.copy()
        moved[:, :3] = np.where(free[:, :3], anchors @ turn.T + shift, target)
        placed.append(replace(solution, anchors=moved, path=solution.path @ turn.T + shift))
    # Of mirror images, that with the tags below the anchors.
    best = min(placed, key=lambda s: walks.positions(s.path)[:, 2].mean())
    return best, Prior(mean, precision, free.ravel()), notes


def sided(
    walks: Walks, solution: Solution, known: np.ndarray, free: Bool[np.ndarray, "A 4"], effect: float
) -> tuple[Solution, Bool[np.ndarray, " A"]]:
    """The solution with anchors on the likely side of the walk's plane, that of `known` (A, 3), else above, and for
    which the other side fits as well. Anchors whose heights are not `free` have no other side."""
    at = walks.positions(solution.path)
    centre = at.mean(axis=0)
    normal = np.linalg.svd(at[:: max(1, len(at) // 2000)] - centre, full_matrices=False)[2][-1]
    anchors, mirrored = solution.anchors.copy(), np.zeros(len(solution.anchors), bool)
    for k in np.flatnonzero(free[:, 2]).tolist():
        anchor = solution.anchors[k, :3]
        offset = (anchor - centre) @ normal
        image = descended(anchor[None] - 2.0 * offset * normal, *seen_from(walks, solution, k))[0]
        if ((image - centre) @ normal) * offset >= 0.0 or likelier(walks, solution, k, image) <= -UNLIKELY * effect:
            continue
        other, mirrored[k] = image[2] > anchor[2], True
        if np.isfinite(known[k, 2]):
            side = np.abs(known[k, 2] - [anchor[2], image[2]])
            other, mirrored[k] = side[1] < side[0], abs(known[k, 2] - centre[2]) < side.min()
        if other:
            anchors[k, :3] = np.where(free[k, :3], image, anchor)
    return replace(solution, anchors=anchors), mirrored


def covariance_of(walks: Walks, solution: Solution, prior: Prior, effect: float) -> Float[np.ndarray, "U U"]:
    """The covariance of what is free."""
    free, height, anchors = np.flatnonzero(prior.free), walks.heights[0], solution.anchors.copy()
    if (walks.heights == height).all():
        # Ranges see the square of a height over the walk, whose derivative by that height vanishes at zero.
        over = anchors[:, 2] - height
        anchors[:, 2] = height + np.copysign(np.maximum(np.abs(over), LEVEL), over)
    system = equations(walks, replace(solution, anchors=anchors), expected=True).system
    covariance = np.zeros_like(system)
    # A standard deviation of a kilometre for what nothing determines.
    precision = (system / effect + prior.precision)[np.ix_(free, free)] + 1e-6 * np.eye(len(free))
    covariance[np.ix_(free, free)] = np.linalg.inv(precision)
    return covariance


def between(minima: Sequence[Solution], effect: float, d: int) -> Float[np.ndarray, " U"]:
    """The variances, m², of the unknowns by the distances between minima of the cost that are about equally likely.
    `d`: the coordinates of the frame; images above and below a known height of tags `mirrored` states."""
    best, variances = minima[0].anchors, np.zeros_like(minima[0].anchors)
    for other in (x.anchors for x in minima if (x.cost - minima[0].cost) / effect < UNLIKELY):
        moves = aligned(other[:, :3], best[:, :3], d)
        aways = [(other[:, :3] @ turn.T + shift - best[:, :3])[:, :d] for turn, shift in moves]
        squares = min(((away**2).sum(axis=1) for away in aways), key=lambda x: float(x.sum()))
        variances[:, :d] = np.maximum(variances[:, :d], squares[:, None])
        variances[:, 3] = np.maximum(variances[:, 3], (other[:, 3] - best[:, 3]) ** 2)
    return variances.ravel()
