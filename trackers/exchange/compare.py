"""A trajectory compared with the true one: aligned, associated by time, absolute and relative pose errors, speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from trackwright.trackers.core.data.seconds import HOLE_S, span
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange.alignment import Alignment, Similarity, alignment
from trackwright.trackers.exchange.pose_errors import (
    Statistics,
    Step,
    absolute_errors,
    associate,
    relative_errors,
    statistics,
)
from trackwright.trackers.exchange.poses import PoseTrajectory
from trackwright.trackers.exchange.time_offset import estimate_offset

SPEED_WINDOW_S = 0.5
"""Speeds are distances over this time, centred."""


@dataclass(frozen=True, eq=False, repr=False)
class TrajectoryErrors:
    """Errors of a trajectory against the truth, as `compare_trajectories` gives them.

    `pairs`: poses with a true one, of `possible`, the length of the shorter trajectory. `planar`: whether a height is
    unknown, so that errors are horizontal. `time_offset`, s, and `similarity` were applied to the estimate; `aligned`
    is all of it. `ape_m`, `rpe_m`: statistics of the absolute errors, and of the relative ones by step; `ape_rad`,
    `rpe_rad`: likewise of the angles, None or empty without attitudes. `speed_mps`: of estimated minus true horizontal
    speed over 0.5 s, with `bias` their mean; None where no such interval lies in both.
    """

    name: str
    pairs: int
    possible: int
    planar: bool
    time_offset: float
    tolerance: float
    similarity: Similarity
    aligned: PoseTrajectory
    ape_m: Statistics
    ape_rad: Statistics | None
    rpe_m: Mapping[str, Statistics]
    rpe_rad: Mapping[str, Statistics]
    speed_mps: Statistics | None

    def to_dict(self) -> dict[str, Any]:
        """All of it in plain numbers, for JSON; the angles in rad."""
        names = ("pairs", "possible", "planar", "ape_m", "ape_rad", "rpe_m", "rpe_rad", "speed_mps")
        map_of = {"rotation": self.similarity.rotation, "translation_m": self.similarity.translation}
        return {
            "time_offset_s": self.time_offset,
            "time_tolerance_s": self.tolerance,
            "alignment": map_of | {"scale": self.similarity.scale},
        } | {name: getattr(self, name) for name in names}

    def __repr__(self) -> str:
        relative = ", ".join(f"RPE {step} {found['rmse']:.4g} m" for step, found in self.rpe_m.items())
        return f"<TrajectoryErrors of {self.name!r}, {self.pairs} poses: APE {self.ape_m['rmse']:.4g} m, {relative}>"


def compare_trajectories(
    estimate: PoseTrajectory,
    truth: PoseTrajectory,
    align: Alignment = "none",
    time_offset: float | Literal["auto"] = 0.0,
    tolerance: float = 0.01,
    rpe: Sequence[str] = ("1m", "1s"),
    all_pairs: bool = False,
) -> TrajectoryErrors:
    """The errors of an estimated trajectory, with poses associated by time as evo does it.

    `align`: see `alignment`; it is fitted to the associated poses. `time_offset`: s, added to the times of the
    estimate; "auto" estimates it. `tolerance`: s, the largest distance in time of two associated poses. `rpe`: steps of
    the relative errors, as 1m, 1s or 10f (rows); a step longer than the trajectory has no error. `all_pairs`: relative
    errors from every pose. Raises UnusableInput where nothing is associated or the alignment is not determined.
    """
    steps = [Step.of(text) for text in rpe]
    if not tolerance >= 0:
        raise UnusableInput(f"a tolerance of {tolerance:g} s; expected a time of zero or more")
    offset = estimate_offset(estimate, truth, align) if time_offset == "auto" else float(time_offset)
    own_rows, true_rows = associate(estimate, truth, tolerance, offset)
    if not len(own_rows):
        raise UnusableInput(
            f"{estimate.name}: no pose lies within {tolerance:g} s of a true pose: estimates from "
            f"{span(estimate.times[0] + offset, estimate.times[-1] + offset)}, truth from "
            f"{span(truth.times[0], truth.times[-1])}; {_way_to_pairs(estimate, truth, offset)}"
        )
    similarity = alignment(align, estimate.at_rows(own_rows), truth.at_rows(true_rows))
    aligned = replace(similarity.trajectory(estimate), times=estimate.times + offset)
    planar = not (np.isfinite(estimate.positions).all() and np.isfinite(truth.positions).all())
    own, true = (_flat(t) if planar else t for t in (aligned.at_rows(own_rows), truth.at_rows(true_rows)))
    distances, angles = absolute_errors(own, true)
    relative = {str(step): _relative(own, true, step, all_pairs) for step in steps}
    found = {step: errors for step, errors in relative.items() if errors is not None}
    return TrajectoryErrors(
        name=estimate.name,
        pairs=len(own_rows),
        possible=min(len(estimate), len(truth)),
        planar=planar,
        time_offset=offset,
        tolerance=tolerance,
        similarity=similarity,
        aligned=aligned,
        ape_m=statistics(distances),
        ape_rad=None if angles is None else statistics(angles),
        rpe_m={step: statistics(errors[0]) for step, errors in found.items()},
        rpe_rad={step: statistics(errors[1]) for step, errors in found.items() if errors[1] is not None},
        speed_mps=_speed_errors(aligned, truth, own.times),
    )


def _way_to_pairs(estimate: PoseTrajectory, truth: PoseTrajectory, offset: float) -> str:
    """The option with which poses are associated: a tolerance where both overlap in time, else an offset."""
    begin, end = estimate.times[[0, -1]] + offset
    if end < truth.times[0] or begin > truth.times[-1]:
        together = round(truth.times[0] - estimate.times[0], 6)
        return f"give a --time-offset: with {together:.16g} both begin together"
    own, true = associate(estimate, truth, np.inf, offset)
    apart = np.median(np.abs(estimate.times[own] + offset - truth.times[true]))
    return f"give a larger --time-tolerance: half of the poses have a true one within {apart:.3g} s"


def _flat(trajectory: PoseTrajectory) -> PoseTrajectory:
    """The trajectory at height zero."""
    return replace(trajectory, positions=np.column_stack([trajectory.positions[:, :2], np.zeros(len(trajectory))]))


def _relative(
    own: PoseTrajectory, true: PoseTrajectory, step: Step, all_pairs: bool
) -> tuple[np.ndarray, np.ndarray | None] | None:
    try:
        return relative_errors(own, true, step, all_pairs)
    except UnusableInput:
        return None


def _speed_errors(own: PoseTrajectory, true: PoseTrajectory, times: np.ndarray) -> Statistics | None:
    differences = _speeds(own, times) - _speeds(true, times)
    known = differences[np.isfinite(differences)]
    return statistics(np.abs(known)) | {"bias": float(known.mean())} if len(known) else None


def _speeds(poses: PoseTrajectory, times: np.ndarray) -> np.ndarray:
    """Horizontal speeds (n,), m/s, over `SPEED_WINDOW_S` round each time; NaN at the ends and round holes."""
    known, rows = np.unique(poses.times, return_index=True)
    ends = times[:, None] + np.array([-0.5, 0.5]) * SPEED_WINDOW_S
    places = [np.interp(ends, known, poses.positions[rows, k], np.nan, np.nan) for k in (0, 1)]
    speeds = np.hypot(*(place[:, 1] - place[:, 0] for place in places)) / SPEED_WINDOW_S
    after = np.clip(np.searchsorted(known, ends), 1, max(len(known) - 1, 1))
    if len(known) > 1:
        speeds[((known[after] - known[after - 1]) > HOLE_S).any(axis=1)] = np.nan
    return speeds
