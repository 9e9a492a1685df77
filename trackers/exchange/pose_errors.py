"""Errors of a trajectory against the true one as evo defines them: alignment, time offset, association, APE and RPE."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from trackwright.trackers.core.data.seconds import HOLE_S, span
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.exchange.trajectories import PoseTrajectory, Similarity

Alignment = Literal["none", "se2", "se3", "sim3", "scale", "origin"]

Statistics = dict[str, float]
"""Number, root mean square, mean, median, standard deviation, least, largest, and sum of squares of an error."""

SPEED_WINDOW_S = 0.5
"""Speeds are distances over this time, centred."""

_STEP = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*(m|s|f)")

# The search for a time offset: steps of the grid and half of its fine part, s, and what is refused.
_GRID_S = 0.05
_SEARCHED_S = 0.5
_LEAST_CORRELATION = 0.5
_LEAST_OVERLAP = 0.5
_MOST_STEPS = 200_000
_FITTED = 5000
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


def alignment(kind: Alignment, estimate: PoseTrajectory, truth: PoseTrajectory) -> Similarity:
    """The map that takes the poses of an estimate to those of the truth; row k of one belongs to row k of the other.

    `se3`: rotation and translation of least squares of the positions; `sim3`: with a scale; `scale`: that scale alone,
    about the origin; `se2`: rotation about the vertical axis and translation in x and y; `origin`: the first pose on
    the first true pose. Of Umeyama 1991. Raises UnusableInput where the positions do not determine the rotation.
    """
    if kind not in get_args(Alignment):
        raise UnusableInput(f"align = {kind!r}; expected one of {', '.join(get_args(Alignment))}")
    if kind == "none":
        return Similarity(np.eye(3), np.zeros(3), flat=True)
    if kind == "se2":
        turn, shift, _ = _umeyama(estimate.positions[:, :2], truth.positions[:, :2], estimate.name, kind)
        rotation, translation = np.eye(3), np.zeros(3)
        rotation[:2, :2], translation[:2] = turn, shift
        return Similarity(rotation, translation, flat=True)
    unknown = [t.name for t in (estimate, truth) if not np.isfinite(t.positions).all()]
    if unknown:
        raise UnusableInput(f"{unknown[0]}: has no height; expected x, y, z for --align {kind}; use --align se2")
    if kind == "origin":
        return _origin(estimate, truth)
    rotation, translation, scale = _umeyama(estimate.positions, truth.positions, estimate.name, kind)
    if kind == "scale":
        return Similarity(np.eye(3), np.zeros(3), scale)
    return Similarity(rotation, translation, scale if kind == "sim3" else 1.0)


def _origin(estimate: PoseTrajectory, truth: PoseTrajectory) -> Similarity:
    rotation = np.eye(3)
    if estimate.quaternions is not None and truth.quaternions is not None:
        estimated, true = rotation_matrices(estimate.quaternions[:1])[0], rotation_matrices(truth.quaternions[:1])[0]
        rotation = true @ estimated.T
    return Similarity(rotation, truth.positions[0] - rotation @ estimate.positions[0])


def _umeyama(x: np.ndarray, y: np.ndarray, name: str, kind: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation R, translation t and scale c with the least Σ |y − (c R x + t)|²; t is of scale 1 unless `sim3`.

    Umeyama 1991, equations (34) to (43); x, y (n, m).
    """
    n, m = x.shape
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    variance = float(((x - mean_x) ** 2).sum() / n)
    covariance = (y - mean_y).T @ (x - mean_x) / n
    u, d, v = np.linalg.svd(covariance)
    if np.count_nonzero(d > np.finfo(float).eps) < m - 1:
        fix = "" if kind == "se2" else "; use --align se2, or --align none"
        raise UnusableInput(
            f"{name}: its {n} poses with truth lie on a line or at a point, which leaves the rotation of "
            f"--align {kind} undetermined; expected motion in {'a plane' if m == 3 else 'x and y'}{fix}"
        )
    signs = np.ones(m)
    signs[-1] = -1.0 if np.linalg.det(u) * np.linalg.det(v) < 0 else 1.0
    rotation = (u * signs) @ v
    scale = float((d * signs).sum() / variance)
    applied = scale if kind == "sim3" else 1.0
    return rotation, mean_y - applied * rotation @ mean_x, scale


def estimate_offset(estimate: PoseTrajectory, truth: PoseTrajectory, align: Alignment = "none") -> float:
    """The time, s, to add to the times of an estimate so that it fits the truth best.

    First the lag at which the horizontal speeds over 0.5 s are most correlated, over all lags at which at least half of
    the shorter trajectory overlaps; then, within 0.5 s of it, the offset of the least root mean square distance
    between the aligned estimate and the interpolated truth. Raises UnusableInput where no correlation reaches 0.5, as
    without changes of speed.
    """
    coarse = _by_speed(estimate, truth)
    estimate = estimate.at_rows(np.unique(np.linspace(0, len(estimate) - 1, _FITTED).astype(int)))
    low, high = coarse - _SEARCHED_S, coarse + _SEARCHED_S
    # The distance has one minimum near the right offset, but small ripples where poses enter and leave the overlap.
    grid = np.linspace(low, high, 41)
    values = [_distance(estimate, truth, offset, align) for offset in grid]
    k = int(np.argmin(values))
    return _golden(estimate, truth, align, grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)])


def _by_speed(estimate: PoseTrajectory, truth: PoseTrajectory) -> float:
    spans = [t.times[-1] - t.times[0] for t in (estimate, truth)]
    if min(spans) < 4 * SPEED_WINDOW_S:
        raise UnusableInput(
            f"{estimate.name}: {min(spans):.3g} s are too short to estimate a time offset; expected at least "
            f"{4 * SPEED_WINDOW_S:g} s of both; give --time-offset in seconds"
        )
    if max(spans) / _GRID_S > _MOST_STEPS:
        raise UnusableInput(f"{estimate.name}: {max(spans):.0f} s are too long to estimate a time offset; give it")
    starts, speeds = zip(*(_grid_speeds(t) for t in (estimate, truth)), strict=True)
    lags, correlations = _correlations(*speeds)
    if not len(lags) or not correlations.max() >= _LEAST_CORRELATION:
        best = f"{correlations.max():.2f}" if len(lags) else "undefined"
        raise UnusableInput(
            f"{estimate.name}: no time offset fits: the best correlation of its speed with the true speed is {best}, "
            f"expected at least {_LEAST_CORRELATION}; motion with changes of speed is needed; give --time-offset"
        )
    return float(starts[1] - starts[0] + lags[int(correlations.argmax())] * _GRID_S)


def _grid_speeds(poses: PoseTrajectory) -> tuple[float, np.ndarray]:
    """Begin, s, and horizontal speeds (k,), m/s, every `_GRID_S`, over windows of `SPEED_WINDOW_S`."""
    times, rows = np.unique(poses.times, return_index=True)
    grid = np.arange(times[0], times[-1], _GRID_S)
    places = np.stack([np.interp(grid, times, poses.positions[rows, k]) for k in (0, 1)], axis=1)
    window = round(SPEED_WINDOW_S / _GRID_S)
    return float(grid[0]), np.linalg.norm(places[window:] - places[:-window], axis=1) / SPEED_WINDOW_S


def _correlations(estimated: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lags, in steps, at which enough overlaps, and the correlation of estimated[k] with true[k + lag] at each."""
    size = 1 << (len(estimated) + len(true) - 1).bit_length()

    def sums(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        # Element `lag` is the sum over k of a[k] b[k + lag]; negative lags stand at the end.
        return np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)

    # Without their means the sums below lose fewer digits.
    estimated, true = estimated - estimated.mean(), true - true.mean()
    ones = np.ones(len(estimated)), np.ones(len(true))
    count = np.round(sums(*ones))
    lags = np.concatenate([np.arange(size // 2), np.arange(-(size // 2), 0)])
    enough = count >= max(_LEAST_OVERLAP * min(len(estimated), len(true)), 2)
    n = np.where(enough, count, 1.0)
    mean_estimated, mean_true = sums(estimated, ones[1]) / n, sums(ones[0], true) / n
    covariance = sums(estimated, true) / n - mean_estimated * mean_true
    variance_estimated = sums(estimated**2, ones[1]) / n - mean_estimated**2
    variance_true = sums(ones[0], true**2) / n - mean_true**2
    product = variance_estimated * variance_true
    kept = enough & (variance_estimated > 1e-9) & (variance_true > 1e-9)
    return lags[kept], covariance[kept] / np.sqrt(product[kept])


def _distance(estimate: PoseTrajectory, truth: PoseTrajectory, offset: float, align: Alignment) -> float:
    """The root mean square distance, m, of the estimate at this offset, aligned; infinite with little overlap."""
    times = estimate.times + offset
    rows = np.flatnonzero((times >= truth.times[0]) & (times <= truth.times[-1]))
    if len(rows) < max(3, 0.25 * min(len(estimate), len(truth))):
        return math.inf
    known, first = np.unique(truth.times, return_index=True)
    places = np.stack([np.interp(times[rows], known, truth.positions[first, k]) for k in range(3)], axis=1)
    estimated, true = estimate.at_rows(rows), PoseTrajectory(times[rows], places, None, truth.name)
    # The first pose alone would follow the noise of one row.
    moved = alignment("none" if align == "origin" else align, estimated, true).points(estimated.positions)
    return float(np.sqrt(np.mean(np.nansum((moved - places) ** 2, axis=1))))


def _golden(estimate: PoseTrajectory, truth: PoseTrajectory, align: Alignment, low: float, high: float) -> float:
    """The offset of the least distance between `low` and `high`, to 0.1 ms, by golden sections."""
    a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_a, at_b = (_distance(estimate, truth, x, align) for x in (a, b))
    while high - low > 1e-4:
        if at_a <= at_b:
            high, b, at_b = b, a, at_a
            a = high - _GOLDEN * (high - low)
            at_a = _distance(estimate, truth, a, align)
        else:
            low, a, at_a = a, b, at_b
            b = low + _GOLDEN * (high - low)
            at_b = _distance(estimate, truth, b, align)
    return (low + high) / 2


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
    nearest, apart = _nearest(long.times + (offset if longer else -offset), short.times)
    kept = np.flatnonzero(apart <= tolerance)
    return (nearest[kept], kept) if longer else (kept, nearest[kept])


def _nearest(sorted_: np.ndarray, wanted: np.ndarray, least: np.ndarray | int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Of sorted numbers (n,), from row `least` on, the nearest to each wanted one (k,), and how far away it is.

    Of equal ones the first is meant, of equally near ones the smaller.
    """
    after = np.searchsorted(sorted_, wanted, side="left")
    candidates = np.clip(np.stack([after - 1, after]), least, len(sorted_) - 1)
    candidates = np.maximum(np.searchsorted(sorted_, sorted_[candidates], side="left"), least)
    apart = np.abs(sorted_[candidates] - wanted)
    return np.where(apart[0] <= apart[1], candidates[0], candidates[1]), apart.min(axis=0)


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
    distances = np.linalg.norm(estimate.positions - truth.positions, axis=1)
    if estimate.quaternions is None or truth.quaternions is None:
        return distances, None
    estimated, true = rotation_matrices(estimate.quaternions), rotation_matrices(truth.quaternions)
    return distances, _angles_of(np.einsum("nji,njk->nik", estimated, true))


def relative_errors(
    estimate: PoseTrajectory, truth: PoseTrajectory, step: Step, all_pairs: bool = False
) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Errors of the relative poses over a step: distances (k,), m, and angles (k,), rad, none without both attitudes.

    Without both attitudes the displacements are compared in the world frame, else in the body frames of their first
    poses. `all_pairs`: from every pose, and not from the end of the pair before; then a pair may miss the step by a
    tenth. None if the trajectory has no pair.
    """
    first, last = _pairs(estimate, step, all_pairs)
    if not len(first):
        return None
    moved = [t.positions[last] - t.positions[first] for t in (estimate, truth)]
    if estimate.quaternions is None or truth.quaternions is None:
        return np.linalg.norm(moved[0] - moved[1], axis=1), None
    turns = []
    for k, quaternions in enumerate((estimate.quaternions, truth.quaternions)):
        rotations = rotation_matrices(quaternions)
        moved[k] = np.einsum("nji,nj->ni", rotations[first], moved[k])
        turns.append(np.einsum("nji,njk->nik", rotations[first], rotations[last]))
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
    last, apart = _nearest(along, along[:-1] + size, rows + 1)
    kept = apart <= size * 0.1
    return rows[kept], last[kept]


def _angles_of(rotations: np.ndarray) -> np.ndarray:
    """The angles (n,), rad, of rotation matrices (n, 3, 3); exact for small angles and near half a turn."""
    skew = rotations - rotations.transpose(0, 2, 1)
    sine = np.linalg.norm(np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1), axis=1)
    return np.arctan2(sine, np.trace(rotations, axis1=1, axis2=2) - 1.0)


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
        relative = ", ".join(f"RPE {step} {errors['rmse']:.4g} m" for step, errors in self.rpe_m.items())
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
    rows, true_rows = associate(estimate, truth, tolerance, offset)
    if not len(rows):
        raise UnusableInput(
            f"{estimate.name}: no pose lies within {tolerance:g} s of a true pose: estimates from "
            f"{span(estimate.times[0] + offset, estimate.times[-1] + offset)}, truth from "
            f"{span(truth.times[0], truth.times[-1])}; {_way_to_pairs(estimate, truth, offset)}"
        )
    similarity = alignment(align, estimate.at_rows(rows), truth.at_rows(true_rows))
    aligned = replace(similarity.trajectory(estimate), times=estimate.times + offset)
    planar = not (np.isfinite(estimate.positions).all() and np.isfinite(truth.positions).all())
    estimated, true = aligned.at_rows(rows), truth.at_rows(true_rows)
    if planar:
        is_height = [False, False, True]
        estimated, true = (replace(t, positions=np.where(is_height, 0.0, t.positions)) for t in (estimated, true))
    distances, angles = absolute_errors(estimated, true)
    relative = {str(step): relative_errors(estimated, true, step, all_pairs) for step in steps}
    by_step = {step: errors for step, errors in relative.items() if errors is not None}
    return TrajectoryErrors(
        name=estimate.name,
        pairs=len(rows),
        possible=min(len(estimate), len(truth)),
        planar=planar,
        time_offset=offset,
        tolerance=tolerance,
        similarity=similarity,
        aligned=aligned,
        ape_m=statistics(distances),
        ape_rad=None if angles is None else statistics(angles),
        rpe_m={step: statistics(errors[0]) for step, errors in by_step.items()},
        rpe_rad={step: statistics(errors[1]) for step, errors in by_step.items() if errors[1] is not None},
        speed_mps=_speed_errors(aligned, truth, estimated.times),
    )


def _way_to_pairs(estimate: PoseTrajectory, truth: PoseTrajectory, offset: float) -> str:
    """The option with which poses are associated: a tolerance where both overlap in time, else an offset."""
    begin, end = estimate.times[[0, -1]] + offset
    if end < truth.times[0] or begin > truth.times[-1]:
        together = round(truth.times[0] - estimate.times[0], 6)
        return f"give a --time-offset: with {together:.16g} both begin together"
    rows, true_rows = associate(estimate, truth, np.inf, offset)
    apart = np.median(np.abs(estimate.times[rows] + offset - truth.times[true_rows]))
    return f"give a larger --time-tolerance: half of the poses have a true one within {apart:.3g} s"


def _speed_errors(estimated: PoseTrajectory, true: PoseTrajectory, times: np.ndarray) -> Statistics | None:
    differences = _speeds(estimated, times) - _speeds(true, times)
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
