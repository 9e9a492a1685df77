"""Frames of surveyed anchors: that of given ones, and one that three of them define."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.errors import UnusableInput
from trackwright.tuning.survey.solving import Prior, Solution
from trackwright.tuning.survey.walks import Walk

EXACT = 1e-3
"""Standard deviation, m, below which a given position counts as exact."""

ASIDE = 0.1
"""Least distance of a frame's third anchor from the line through the others, as a share of their distance."""


def require_frame(places: np.ndarray, given: Sequence[str]) -> None:
    """Raises UnusableInput where given positions leave a rotation or a mirror image over the floor."""
    if len(places) < 3 or np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] < 0.1:
        words = "leave a rotation about their line; expected three that are not in one; give more"
        raise UnusableInput(f"given {','.join(given)}: {words}")


def _moved(walks: Sequence[Walk], solution: Solution, turn: np.ndarray, shift: np.ndarray) -> Solution:
    """The solution turned, or mirrored, by a matrix (3, 3) and shifted (3,)."""
    anchors = np.column_stack([solution.anchors[:, :3] @ turn.T + shift, solution.anchors[:, 3]])
    paths = [path @ turn[: w.dimensions, : w.dimensions].T + shift[: w.dimensions]
             for w, path in zip(walks, solution.paths, strict=True)]  # fmt: skip
    return replace(solution, anchors=anchors, paths=paths)


def aligned(points: np.ndarray, onto: np.ndarray, d: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The rotation or reflection (3, 3) and shift (3,) of d coordinates of points (k, 3) onto others (Kabsch 1976).

    Two of them where the points are in a plane, which its mirror image fits as well.
    """
    a, b = points[:, :d], onto[:, :d]
    left, sizes, right = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    moves = []
    for sign in (1.0, -1.0) if sizes[-1] < 1e-2 * sizes[0] else (1.0,):
        turn, shift = np.eye(3), np.zeros(3)
        turn[:d, :d] = (left * np.append(np.ones(d - 1), sign) @ right).T
        shift[:d] = b.mean(axis=0) - turn[:d, :d] @ a.mean(axis=0)
        moves.append((turn, shift))
    return moves


def onto(
    walks: Sequence[Walk],
    solution: Solution,
    known: np.ndarray,
    fixed: Sequence[int],
    sigma: float,
    flat: bool,
    prior: Prior,
) -> tuple[Solution, Prior]:
    """The solution among the given anchors, and their prior density beside that of delays, exact ones fixed."""
    mean, precision, free = prior.mean.copy(), prior.precision.copy(), prior.free.copy()
    moves = aligned(solution.anchors[fixed, :3], known[fixed], 2 if flat else 3)
    # Of mirror images, that with the tags below the given anchors.
    placed = min((_moved(walks, solution, *move) for move in moves), key=lambda s: tags(walks, s)[:, 2].mean())
    anchors = placed.anchors.copy()
    for k in fixed:
        at = slice(4 * k, 4 * k + 3)
        mean[at] = known[k]
        if sigma < EXACT:
            free[at], anchors[k, :3] = False, known[k]
        else:
            precision[at, at] = np.eye(3) / sigma**2
    return replace(placed, anchors=anchors), Prior(mean, precision, free)


def tags(walks: Sequence[Walk], solution: Solution) -> Float[np.ndarray, "n 3"]:
    """The positions of the tags, m, in all walks."""
    return np.concatenate([walk.positions(path) for walk, path in zip(walks, solution.paths, strict=True)])


def axes(names: Sequence[str], frame: Sequence[str], anchors: np.ndarray, d: int) -> list[int]:
    """The anchors of the frame: those named, or the first two and the next one aside; refused in a line."""
    thirds = [names.index(frame[2])] if frame else range(2, len(names))
    a, b = (names.index(name) for name in (frame or names)[:2])
    ahead = (anchors[b] - anchors[a])[:d]
    for c in thirds:
        aside = (anchors[c] - anchors[a])[:d]
        off = np.linalg.norm(aside - ahead * (aside @ ahead) / (ahead @ ahead))
        if off > ASIDE * np.linalg.norm(ahead):
            return [a, b, c]
    words = ", ".join(frame or names)
    raise UnusableInput(f"{words}: stand in a line; expected three anchors that do not; give others as --frame")


def frame_of(
    anchors: Float[np.ndarray, "3 3"], tags: Float[np.ndarray, "n 3"], flat: bool
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
    """The rotation or reflection and the shift into the frame of three anchors, m, with tags below them.

    The first is the origin, the second on the x axis, the third to its left. `flat`: heights stay; otherwise the three
    have height 0.
    """
    d = 2 if flat else 3
    origin = anchors[0]
    ahead, aside = ((point - origin)[:d] for point in anchors[1:])
    x = ahead / np.linalg.norm(ahead)
    y = aside - x * (aside @ x)
    y /= np.linalg.norm(y)
    turn, shift = np.eye(3), np.zeros(3)
    turn[:d, :d] = np.stack([x, y] if flat else [x, y, np.cross(x, y)])
    if not flat and ((tags - origin) @ turn[2]).mean() > 0:
        turn[2] *= -1.0
    shift[:d] = -turn[:d, :d] @ origin[:d]
    return turn, shift


def framed(
    walks: Sequence[Walk], solution: Solution, names: Sequence[str], frame: Sequence[str], flat: bool, prior: Prior
) -> tuple[Solution, Prior, list[str]]:
    """The solution in the frame of three anchors, the prior with the coordinates that it fixes, and assumptions."""
    chosen = axes(names, frame, solution.anchors[:, :3], 2 if flat else 3)
    turn, shift = frame_of(solution.anchors[chosen, :3], tags(walks, solution), flat)
    free = prior.free.copy().reshape(-1, 4)
    for k, first, last in zip(chosen, (0, 1, 2), (2, 2, 2) if flat else (3, 3, 3), strict=True):
        free[k, first:last] = False
    moved = _moved(walks, solution, turn, shift)
    notes = []
    if not flat:
        notes.append("the mirror image of all, z as -z, fits as well; tags are assumed below the frame's anchors")
    if not frame:
        words = ", ".join(names[k] for k in chosen)
        notes.append(f"frame: {words}: origin, x axis, and to the left of it; --given or --frame choose another")
    return replace(moved, anchors=np.where(free, moved.anchors, 0.0)), replace(prior, free=free.ravel()), notes
