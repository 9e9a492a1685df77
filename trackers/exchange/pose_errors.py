"""Errors of a trajectory against the true one as evo defines them: alignment, time offset, association, APE and RPE."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from trackwright.trackers.core.data.seconds import HOLE_S, span
from trackwright.trackers.core.errors import UnusableInput, require
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.exchange.trajectories import PoseTrajectory, Similarity

Alignment = Literal["none", "se2", "se3", "sim3", "scale", "origin"]
Statistics = dict[str, float]
ALIKE = 0.3  # the least correlation of aligned positions with the true ones from which an alignment is taken
WINDOW_S, GRID_S, LONGEST_S = 0.5, 0.05, 10_000.0  # of centred speeds, their grid for a time offset, the longest one


def alignment(kind: Alignment, estimate: PoseTrajectory, truth: PoseTrajectory) -> Similarity:
    """The map of least squares from poses to true ones, row k to row k (Umeyama 1991); or UnusableInput.

    `se2`: in the plane; `scale`: the scale of `sim3` alone; `origin`: the first pose on the first true pose.
    """
    require(kind in get_args(Alignment), "align", kind, f"one of {', '.join(get_args(Alignment))}")
    x, y, rotation, translation = estimate.positions, truth.positions, np.eye(3), np.zeros(3)
    axes, n = (2 if kind == "se2" else 3), len(x)
    if kind == "none":
        return Similarity(rotation, translation, flat=True)
    if axes == 3 and (unknown := [t.name for t in (estimate, truth) if not np.isfinite(t.positions).all()]):
        raise UnusableInput(f"{unknown[0]}: has no height; expected x, y, z for --align {kind}; use --align se2")
    if kind == "origin":
        if estimate.quaternions is not None and truth.quaternions is not None:
            rotation = rotation_matrices(truth.quaternions[0]) @ rotation_matrices(estimate.quaternions[0]).T
        return Similarity(rotation, y[0] - rotation @ x[0])
    x, y = x[:, :axes], y[:, :axes]
    from_x, from_y = x - x.mean(axis=0), y - y.mean(axis=0)
    u, d, v = np.linalg.svd(from_y.T @ from_x / n)
    signs = np.ones(axes)
    signs[-1] = -1.0 if np.linalg.det(u) * np.linalg.det(v) < 0 else 1.0
    # A tag at rest turns as the noise of its positions does, which does not follow the truth.
    still = n * (d * signs).sum() <= ALIKE * np.linalg.norm(from_x) * np.linalg.norm(from_y)
    if still or np.count_nonzero(d > np.finfo(float).eps) < axes - 1:
        found = f"{estimate.name}: its {n} poses lie on a line, or do not move with the truth"
        fix = "use --align none, or origin where heights are known"
        raise UnusableInput(f"{found}, so that --align {kind} finds no rotation; expected motion; {fix}")
    scale = float((d * signs).sum() / ((from_x**2).sum() / n)) if kind in ("sim3", "scale") else 1.0
    if kind != "scale":
        rotation[:axes, :axes] = (u * signs) @ v
        translation[:axes] = y.mean(axis=0) - scale * rotation[:axes, :axes] @ x.mean(axis=0)
    return Similarity(rotation, translation, scale, flat=kind == "se2")


def estimate_offset(estimate: PoseTrajectory, truth: PoseTrajectory, align: Alignment = "none") -> float:
    """The time, s, to add to the times of an estimate so that it fits the truth best, to 0.1 ms.

    First the lag at which horizontal speeds correlate best; then, within 0.5 s of it, the offset of the least distance
    between the aligned estimate and the interpolated truth. Raises UnusableInput where no correlation reaches 0.5.
    """
    from scipy.optimize import minimize_scalar
    from scipy.signal import correlate, correlation_lags

    lasts = [float(t.times[-1] - t.times[0]) for t in (estimate, truth)]
    if min(lasts) < 4 * WINDOW_S or max(lasts) > LONGEST_S:
        expected = f"expected 2 to {LONGEST_S:,.0f} s; give --time-offset in seconds"
        raise UnusableInput(f"{estimate.name}: {lasts[0]:.3g} s, and {lasts[1]:.3g} s of truth; {expected}")
    grids = [np.arange(t.times[0], t.times[-1] - WINDOW_S, GRID_S) + WINDOW_S / 2 for t in (estimate, truth)]
    # Rounding may put the ends of the windows beyond the trajectory's; without means, sums lose fewer digits.
    v, w = (np.nan_to_num(_speeds(t, grid)) for t, grid in zip((estimate, truth), grids, strict=True))
    v, w, one, true_one = v - v.mean(), w - w.mean(), np.ones_like(v), np.ones_like(w)
    of = ((one, true_one), (v, true_one), (one, w), (v, w), (v * v, true_one), (one, w * w))
    n, *sums = (correlate(b, a, method="fft") for a, b in of)
    mean_v, mean_w, product, square_v, square_w = (each / n for each in sums)
    variances = (square_v - mean_v**2) * (square_w - mean_w**2)
    r = (product - mean_v * mean_w) / np.sqrt(np.maximum(variances, 1e-18))
    r[np.round(n) < min(len(v), len(w)) / 2] = 0.0
    if r.max() < 0.5:
        found = f"{estimate.name}: no time offset fits: speeds correlate with the true ones by {r.max():.2f}"
        raise UnusableInput(f"{found}; expected 0.5 or more, from changes of speed; give --time-offset in seconds")
    coarse = grids[1][0] - grids[0][0] + correlation_lags(len(w), len(v))[r.argmax()] * GRID_S
    estimate = estimate.at_rows(np.unique(np.linspace(0, len(estimate) - 1, 5000).astype(int)))

    def distance(offset: float) -> float:
        times = estimate.times + offset
        rows = np.flatnonzero((times >= truth.times[0]) & (times <= truth.times[-1]))
        if len(rows) < max(3, 0.25 * min(len(estimate), len(truth))):
            return math.inf
        part, true = estimate.at_rows(rows), PoseTrajectory(times[rows], _places(truth, times[rows]), None, truth.name)
        # The first pose alone would follow the noise of one row.
        moved = alignment("none" if align == "origin" else align, part, true).points(part.positions)
        return float(np.sqrt(np.mean(np.nansum((moved - true.positions) ** 2, axis=1))))

    # The distance has one minimum near the right offset, but small ripples where poses enter and leave the overlap.
    grid = coarse + np.linspace(-0.5, 0.5, 41)
    best = int(np.argmin([distance(offset) for offset in grid]))
    bounds = (grid[max(best - 1, 0)], grid[min(best + 1, 40)])
    return float(minimize_scalar(distance, bounds=bounds, method="bounded", options={"xatol": 5e-5}).x)


def _places(poses: PoseTrajectory, times: np.ndarray) -> np.ndarray:
    """The interpolated positions (n, 3), m, at times (n,), s; NaN before the first and after the last."""
    known, rows = np.unique(poses.times, return_index=True)
    return np.stack([np.interp(times, known, axis, np.nan, np.nan) for axis in poses.positions[rows].T], axis=-1)


def _speeds(poses: PoseTrajectory, times: np.ndarray) -> np.ndarray:
    """Horizontal speeds (n,), m/s, over `WINDOW_S` round each time; NaN at the ends."""
    before, after = (_places(poses, times + way * WINDOW_S / 2)[:, :2] for way in (-1, 1))
    return np.linalg.norm(after - before, axis=1) / WINDOW_S


def step_of(text: str) -> tuple[str, float, str]:
    """The name, size and unit of a step as `1m` (along the path), `0.5s` or `10f` (rows); else raises UnusableInput."""
    match = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*([msf])", text.strip())
    if match is None or float(match[1]) == 0 or (match[2] == "f" and float(match[1]) % 1):
        raise UnusableInput(f"--rpe {text!r}; expected a step such as 1m, 0.5s or 10f (rows), above zero")
    return f"{float(match[1]):g}{match[2]}", float(match[1]), match[2]


def associate(
    estimate: PoseTrajectory, truth: PoseTrajectory, tolerance: float = 0.01, offset: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The rows that belong together: for each pose of the shorter, the nearest of the longer within `tolerance`, s."""
    longer = len(estimate) > len(truth)
    short, long = (truth, estimate) if longer else (estimate, truth)
    nearest, apart = _nearest(long.times + (offset if longer else -offset), short.times)
    kept = np.flatnonzero(apart <= tolerance)
    return (nearest[kept], kept) if longer else (kept, nearest[kept])


def _nearest(ordered: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The row of the nearest of sorted numbers to each wanted one, the first of equal ones; and how far it is."""
    after = np.searchsorted(ordered, wanted)
    rows = np.clip(np.stack([after - 1, after]), 0, len(ordered) - 1)
    rows = np.searchsorted(ordered, ordered[rows])
    apart = np.abs(ordered[rows] - wanted)
    return np.where(apart[0] <= apart[1], rows[0], rows[1]), apart.min(axis=0)


def _pairs(poses: PoseTrajectory, size: float, unit: str, all_pairs: bool) -> tuple[np.ndarray, np.ndarray]:
    """First and last rows of the relative errors: each from the end of the one before, or from every pose."""
    metres, seconds = np.linalg.norm(np.diff(poses.positions, axis=0), axis=1), np.diff(poses.times)
    lengths = {"m": metres, "s": seconds, "f": np.ones(len(seconds))}[unit]
    if all_pairs:
        along = np.append(0.0, np.cumsum(lengths))
        last, apart = _nearest(along, along[:-1] + size)
        first = np.flatnonzero(apart <= (0.0 if unit == "f" else size * 0.1))
        return first, last[first]
    # Ten times 0.1 s, rounded, are a second.
    ends, since, wanted = [0], 0.0, size * (1 - 1e-9) if unit == "s" else size
    for row, length in enumerate(lengths.tolist(), 1):
        since += length
        if since >= wanted:
            ends.append(row)
            since = 0.0
    return np.array(ends[:-1], int), np.array(ends[1:], int)


def statistics(errors: np.ndarray) -> Statistics:
    """The statistics of errors (n,), n > 0, under the names that evo gives them."""
    squares = float(np.sum(errors**2))
    named = {name: float(getattr(np, name)(errors)) for name in ("mean", "median", "std", "min", "max")}
    return {"n": len(errors), "rmse": math.sqrt(squares / len(errors))} | named | {"sse": squares}


def _speed_errors(estimated: PoseTrajectory, true: PoseTrajectory, times: np.ndarray) -> Statistics | None:
    """Of estimated less true speeds, with their mean `bias`; intervals that touch a hole are left out."""
    errors = _speeds(estimated, times) - _speeds(true, times)
    for known in (np.unique(estimated.times), np.unique(true.times)):
        # By the rows between which each end lies; before and after all there is no gap.
        gaps = np.concatenate([[0.0], np.diff(known), [0.0]])
        ends = np.searchsorted(known, times[:, None] + np.array([-0.5, 0.5]) * WINDOW_S)
        errors[(gaps[ends] > HOLE_S).any(axis=1)] = np.nan
    errors = errors[np.isfinite(errors)]
    return statistics(np.abs(errors)) | {"bias": float(errors.mean())} if len(errors) else None


@dataclass(frozen=True, eq=False)
class TrajectoryErrors:
    """Statistics of absolute errors (`ape`), of relative ones by step (`rpe`), and of horizontal speeds over 0.5 s.

    `pairs`: poses with a true one, of `possible`, the length of the shorter trajectory. `planar`: a height is unknown,
    so that errors are horizontal. `time_offset`, s, and `similarity` lead from the estimate to `aligned`.
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
        names, s = ("pairs", "possible", "planar", "ape_m", "ape_rad", "rpe_m", "rpe_rad", "speed_mps"), self.similarity
        moved = {"rotation": s.rotation, "translation_m": s.translation, "scale": s.scale}
        times = {"time_offset_s": self.time_offset, "time_tolerance_s": self.tolerance, "alignment": moved}
        return times | {name: getattr(self, name) for name in names}


def compare_trajectories(
    estimate: PoseTrajectory,
    truth: PoseTrajectory,
    align: Alignment = "none",
    time_offset: float | Literal["auto"] = 0.0,
    tolerance: float = 0.01,
    rpe: Sequence[str] = ("1m", "1s"),
    all_pairs: bool = False,
) -> TrajectoryErrors:
    """The errors of an estimated trajectory, as evo defines them: of poses at most `tolerance`, s, apart.

    `align`: see `alignment`. `time_offset`: s, added to the times of the estimate; "auto" estimates it. `rpe`: steps as
    1m, 1s or 10f (rows). `all_pairs`: from every pose, over steps that fit to a tenth. Relative errors are of
    displacements in the frame of the truth, with attitudes in the body's. Raises UnusableInput where nothing fits.
    """
    steps = [step_of(text) for text in rpe]
    require(tolerance >= 0, "tolerance", tolerance, "a time of zero or more, s")
    offset = estimate_offset(estimate, truth, align) if time_offset == "auto" else float(time_offset)
    rows, true_rows = associate(estimate, truth, tolerance, offset)
    if not len(rows):
        (first, last), (begin, end) = estimate.times[[0, -1]] + offset, truth.times[[0, -1]]
        apart = np.median(_nearest(truth.times, estimate.times + offset)[1])
        found = f"no pose lies within {tolerance:g} s of a true pose: estimates from {span(first, last)}"
        begins = f"a --time-offset: with {round(begin - estimate.times[0], 6):.16g} both begin together"
        fix = f"{begins}; or a larger --time-tolerance: half of the poses have a true one within {apart:.3g} s"
        raise UnusableInput(f"{estimate.name}: {found}, truth from {span(begin, end)}; give {fix}")
    similarity = alignment(align, estimate.at_rows(rows), truth.at_rows(true_rows))
    aligned = replace(similarity.trajectory(estimate), times=estimate.times + offset)
    planar = not (np.isfinite(estimate.positions).all() and np.isfinite(truth.positions).all())
    pair = [aligned.at_rows(rows), truth.at_rows(true_rows)]
    if planar:
        pair = [replace(t, positions=np.nan_to_num(t.positions) * [1, 1, 0]) for t in pair]
    given = [t.quaternions for t in pair if t.quaternions is not None]
    turns = [Rotation.from_quat(q, scalar_first=True) for q in given] if len(given) == 2 else []
    rpe_m, rpe_rad = dict[str, Statistics](), dict[str, Statistics]()
    for step, size, unit in steps:
        first, last = _pairs(pair[0], size, unit, all_pairs)
        if not len(first):
            continue
        moved = [t.positions[last] - t.positions[first] for t in pair]
        if turns:
            moved = [turn[first].inv().apply(way) for turn, way in zip(turns, moved, strict=True)]
            estimated, true = (turn[first].inv() * turn[last] for turn in turns)
            rpe_rad[step] = statistics((true.inv() * estimated).magnitude())
        rpe_m[step] = statistics(np.linalg.norm(moved[0] - moved[1], axis=1))
    return TrajectoryErrors(
        estimate.name, len(rows), min(len(estimate), len(truth)), planar, offset, tolerance, similarity, aligned,
        ape_m=statistics(np.linalg.norm(pair[0].positions - pair[1].positions, axis=1)),
        ape_rad=statistics((turns[0].inv() * turns[1]).magnitude()) if turns else None,
        rpe_m=rpe_m, rpe_rad=rpe_rad, speed_mps=_speed_errors(aligned, truth, pair[0].times),
    )  # fmt: skip
