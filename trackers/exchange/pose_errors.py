"""Association of two trajectories by time, and their absolute and relative pose errors as evo defines them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.exchange.poses import PoseTrajectory

Statistics = dict[str, float]
"""Number, root mean square, mean, median, standard deviation, least, largest, and sum of squares of an error."""

_STEP = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*(m|s|f)")


@dataclass(frozen=True)
class Step:
    """The distance between the two poses of a relative error: `size` m along the path (`m`), s (`s`) or rows (`f`)."""

    size: float
    unit: Literal["m", "s", "f"]

    @classmethod
    def of(cls, text: str) -> Step:
        """The step in a text such as `1m`, `0.5s` or `10f`; raises UnusableInput for any other."""
        match = _STEP.fullmatch(text.strip())
        size = float(match[1]) if match else 0.0
        if match is None or size <= 0 or (match[2] == "f" and not size.is_integer()):
            raise UnusableInput(f"--rpe {text!r}; expected a step such as 1m, 0.5s or 10f (rows), above zero")
        return cls(size, match[2])  # type: ignore[arg-type]

    def __str__(self) -> str:
        return f"{self.size:g}{self.unit}"


def associate(
    estimate: PoseTrajectory, truth: PoseTrajectory, tolerance: float = 0.01, offset: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The rows of estimate and truth that belong together: for each pose of the shorter, the nearest of the longer.

    Pairs further apart than `tolerance`, s, are left out; `offset`, s, is added to the times of the estimate. As evo,
    to the rounding. A pose of the longer may be in two pairs, and of equally near ones the earlier is taken.
    """
    longer = len(estimate) > len(truth)
    short, long = (truth, estimate) if longer else (estimate, truth)
    times = long.times + (offset if longer else -offset)
    after = np.searchsorted(times, short.times, side="left")
    candidates = np.clip(np.stack([after - 1, after]), 0, len(times) - 1)
    # Of poses at one time the first is meant.
    candidates = np.searchsorted(times, times[candidates], side="left")
    apart = np.abs(times[candidates] - short.times)
    nearest = np.where(apart[0] <= apart[1], candidates[0], candidates[1])
    kept = np.flatnonzero(apart.min(axis=0) <= tolerance)
    pairs = kept, nearest[kept]
    return (pairs[1], pairs[0]) if longer else pairs


def statistics(errors: np.ndarray) -> Statistics:
    """The statistics of errors (n,), n > 0, under the names that evo gives them."""
    squares = float(np.sum(errors**2))
    return {
        "n": len(errors),
        "rmse": math.sqrt(squares / len(errors)),
        "mean": float(np.mean(errors)),
        "median": float(np.median(errors)),
        "std": float(np.std(errors)),
        "min": float(np.min(errors)),
        "max": float(np.max(errors)),
        "sse": squares,
    }


def absolute_errors(estimate: PoseTrajectory, truth: PoseTrajectory) -> tuple[np.ndarray, np.ndarray | None]:
    """Distances (n,), m, and angles (n,), rad, between poses row by row; no angles without both attitudes."""
    return np.linalg.norm(estimate.positions - truth.positions, axis=1), _angles(estimate, truth)


def relative_errors(
    estimate: PoseTrajectory, truth: PoseTrajectory, step: Step, all_pairs: bool = False
) -> tuple[np.ndarray, np.ndarray | None]:
    """Errors of the relative poses over a step: distances (k,), m, and angles (k,), rad, none without both attitudes.

    Without both attitudes the displacements are compared in the world frame, else in the body frames of their first
    poses. `all_pairs`: from every pose, and not from the end of the pair before; then a pair may miss the step by a
    tenth. Raises UnusableInput if the trajectory has no pair.
    """
    first, last = _pairs(estimate, step, all_pairs)
    if not len(first):
        raise UnusableInput(
            f"{estimate.name}: no two of {len(estimate)} poses with truth are {step} apart; give a smaller --rpe"
        )
    moved = [t.positions[last] - t.positions[first] for t in (estimate, truth)]
    if estimate.quaternions is None or truth.quaternions is None:
        return np.linalg.norm(moved[0] - moved[1], axis=1), None
    turns = []
    for k, quaternions in enumerate((estimate.quaternions, truth.quaternions)):
        own = rotation_matrices(quaternions)
        moved[k] = np.einsum("nji,nj->ni", own[first], moved[k])
        turns.append(np.einsum("nji,njk->nik", own[first], own[last]))
    between = np.einsum("nji,njk->nik", turns[1], turns[0])
    return np.linalg.norm(moved[0] - moved[1], axis=1), _angles_of(between)


def _pairs(poses: PoseTrajectory, step: Step, all_pairs: bool) -> tuple[np.ndarray, np.ndarray]:
    """First and last rows of the pairs."""
    n = len(poses)
    if step.unit == "f":
        rows = int(step.size)
        first = np.arange(0, max(n - rows, 0), 1 if all_pairs else rows)
        return first, first + rows
    moved = np.linalg.norm(np.diff(poses.positions, axis=0), axis=1)
    lengths = moved if step.unit == "m" else np.diff(poses.times)
    if all_pairs:
        return _all_pairs(np.concatenate([[0.0], np.cumsum(lengths)]), step.size)
    # Sums of times are rounded: ten steps of 0.1 s are a second.
    wanted = step.size if step.unit == "m" else step.size * (1 - 1e-9)
    ends, since = [0], 0.0
    for row, length in enumerate(lengths.tolist(), 1):
        since += length
        if since >= wanted:
            ends.append(row)
            since = 0.0
    return np.array(ends[:-1], int), np.array(ends[1:], int)


def _all_pairs(along: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """From every row the later one whose distance along the trajectory is nearest to `size`, within a tenth of it."""
    rows = np.arange(len(along) - 1)
    after = np.searchsorted(along, along[:-1] + size, side="left")
    candidates = np.clip(np.stack([after - 1, after]), rows + 1, len(along) - 1)
    # Of rows at one place the first is meant.
    candidates = np.maximum(np.searchsorted(along, along[candidates], side="left"), rows + 1)
    apart = np.abs(along[candidates] - along[:-1] - size)
    last = np.where(apart[0] <= apart[1], candidates[0], candidates[1])
    kept = apart.min(axis=0) <= size * 0.1
    return rows[kept], last[kept]


def _angles(estimate: PoseTrajectory, truth: PoseTrajectory) -> np.ndarray | None:
    if estimate.quaternions is None or truth.quaternions is None:
        return None
    own, true = rotation_matrices(estimate.quaternions), rotation_matrices(truth.quaternions)
    return _angles_of(np.einsum("nji,njk->nik", own, true))


def _angles_of(rotations: np.ndarray) -> np.ndarray:
    """The angles (n,), rad, of rotation matrices (n, 3, 3); exact for small angles and near half a turn."""
    skew = rotations - rotations.transpose(0, 2, 1)
    sine = np.linalg.norm(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1), axis=1)
    return np.arctan2(sine, np.trace(rotations, axis1=1, axis2=2) - 1.0)
