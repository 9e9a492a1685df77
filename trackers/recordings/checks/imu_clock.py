"""The clock and the vertical of an IMU against those of ranges, without truth: where its motion fits theirs best.

In each of some windows the acceleration, turned level by the turn rates and twice integrated, explains the ranges but
for a heading and a polynomial of time, which holds start, tilt and biases. The delay is that with the smallest squares
of errors of all windows. Errors that last count less: squares are in units of the variance of their derivative with
respect to the delay, from its sums over blocks of time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.polynomial import chebyshev

from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.checks.imu import (
    GAP_S,
    LEAST_DELAY_S,
    LONGEST_DELAY_S,
    MOST_ROWS,
    integral,
    late_in_words,
    lowest,
)
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, QUATERNION, layout

MOST_TAGS = 2
"""Tags whose IMU is compared with their ranges."""

WINDOW_S, HOP_S, LEAST_WINDOWS, MOST_WINDOWS = 6.0, 3.0, 6, 12
"""Length of the windows, s, the least time from one to the next, and how many there are."""

MOST_RANGES, GOLDEN = 1000, 0.618034
"""Ranges of a window that are used, and the step that spreads them over all anchors, whatever their turn."""

DEGREES, OPEN_DEGREE = (0, 0, 1, 2, 3, 5, 7, 7, 7, 7), 4
"""Degrees of the polynomial through ranges in each step of its fit, and of that which the IMU leaves open."""

CONSTANT_M, NOISE_M, GYRO, PUSH = 0.3, 0.01, 0.02, 0.3
"""Standard deviations of an anchor's constant error and least of ranges, m, of a gyro's bias, rad/s, and of mean
accelerations, m/s²."""

LEAST_PUSH = 5.0
"""Mean specific force, m/s², below which an accelerometer leaves gravity out and does not tell what is level."""

BLOCK_S, PUSH_S = 1.0, 3.0
"""Time after which errors of ranges, and mean accelerations, are independent, s."""

STEP_S = 0.1
DELAYS = STEP_S * np.arange(-round(LONGEST_DELAY_S / STEP_S), round(LONGEST_DELAY_S / STEP_S) + 1)

CERTAIN, APART_S = 5.0**2, 0.35
"""Squares, in units of their variance, by which a delay has to fit better than others so far apart, than no delay and
than no motion: five standard deviations."""

UPSIDE_DOWN = np.array([1.0, -1.0, -1.0])
"""The factors on x, y and z of half a turn round x."""

TURNS = 2 * np.pi * np.arange(72)[:, None] / 72


def check_imu_clock(recording: RecordingFolder) -> list[CheckResult]:
    """A warning where an IMU comes late or early against the ranges, an error where z of the anchors points down.

    `check_imu` tells the clock of a true attitude.
    """
    tables = recording.tables
    known, own = (name in tables and set(QUATERNION) <= set(tables[name].columns) for name in ("truth", "imu"))
    if "imu" not in tables or "ranges" not in tables or own:
        return []
    pairs = {tag: list(windows(recording, tag)) for tag in recording.rows("imu").tags[:MOST_TAGS]}
    parts = {tag: [up for up, _ in each] for tag, each in pairs.items()}
    if any(_fits_better([down for _, down in each], parts[tag]) for tag, each in pairs.items()):
        message = "z points down: the motion of the IMU fits the ranges only with the anchors turned half round x"
        return [CheckResult("error", "rig.toml", f"{message}; negate y and z of all positions, as of truth and fixes")]
    delays = [(tag, delay_of(up)) for tag, up in parts.items() if not known]
    return [
        CheckResult("warning", "imu", f"tag {tag}: {late_in_words(delay, 'the motion in the ranges', 1)}")
        for tag, delay in delays
        if delay is not None and abs(delay) >= 2 * LEAST_DELAY_S
    ]


def _fits_better(parts: Sequence[Window], others: Sequence[Window]) -> bool:
    """Whether an IMU with a delay that is known explains of ranges for certain more than of the other windows at any.

    A path through ranges alone may fit better with either side up where anchors have several heights.
    """
    if delay_of(parts) is None:
        return False
    gains, rivals = (np.sum([one.still - one.squares for one in some], axis=0) for some in (parts, others))
    best = int(np.argmax(gains))
    return bool(gains[best] - max(rivals.max(), 0.0) > CERTAIN * _variance(parts, best))


class Window(NamedTuple):
    """Errors of n ranges, in standard deviations, if the IMU comes late by each of D delays.

    `times` (n,) s. `turning` (n, D): derivatives of the errors with respect to the heading. `squares` (D,): of the
    errors and of the anchors' constants. `still`: the same without an IMU.
    """

    times: Float[np.ndarray, " n"]
    errors: Float[np.ndarray, "n D"]
    turning: Float[np.ndarray, "n D"]
    squares: Float[np.ndarray, " D"]
    still: float


def delay_of(parts: Sequence[Window]) -> float | None:
    """Seconds by which an IMU comes late, 0 where it may not; None where windows do not tell or their halves differ."""
    if len(parts) < LEAST_WINDOWS:
        return None
    squares = np.stack([one.squares for one in parts])
    total, half = squares.sum(axis=0), len(parts) // 2
    best = int(np.argmin(total))
    apart = [abs(int(np.argmin(half_of.sum(axis=0))) - best) for half_of in (squares[:half], squares[half:])]
    if not 0 < best < len(DELAYS) - 1 or STEP_S * max(apart) > 2.5 * LEAST_DELAY_S:
        return None
    certain = CERTAIN * _variance(parts, best)
    others = total[np.abs(DELAYS - DELAYS[best]) > APART_S]
    if min(others.min(), sum(one.still for one in parts)) - total[best] < certain:
        return None
    if total[np.abs(DELAYS) < 1.5 * LEAST_DELAY_S].min() - total[best] < certain:
        return 0.0
    return float(DELAYS[best] + STEP_S * lowest(*total[best - 1 : best + 2]))


def _variance(parts: Sequence[Window], best: int) -> float:
    """The variance of the squares' derivative by that of independent errors of one standard deviation; at least 1."""
    scores, information = [], 0.0
    for one in parts:
        slope, turning = (one.errors[:, best + 1] - one.errors[:, best - 1]) / (2 * STEP_S), one.turning[:, best]
        slope = slope - turning * (slope @ turning) / max(turning @ turning, 1e-12)
        scores.append(one.errors[:, best] * slope)
        information += float(slope @ slope)
    times = np.concatenate([one.times for one in parts])
    block = np.unique(np.floor(times / BLOCK_S), return_inverse=True)[1]
    return max(float(np.sum(np.bincount(block, np.concatenate(scores)) ** 2)) / max(information, 1e-12), 1.0)


def windows(recording: RecordingFolder, tag: str) -> Iterator[tuple[Window, Window]]:
    """The windows of a tag's IMU, with the ranges of all tags on its body: as the rig is, and turned half round x."""
    rig, rows, ranges = recording.rig, recording.rows("imu"), recording.rows("ranges")
    of_tag = slice(*rows.starts[rows.tags.index(tag) :][:2])
    x = rows.floats(layout("imu", recording.tables["imu"].columns).values)[of_tag]
    whole = np.flatnonzero(np.isfinite(x).all(axis=1))
    t, first = np.unique(rows.times[of_tag][whole], return_index=True)
    t, x = t[:MOST_ROWS], x[whole[first[:MOST_ROWS]]]
    offsets = {name: np.asarray(one.offset, float) for name, one in rig.tags.items() if one.offset is not None}
    body = rig.on_body_of(tag) or (tag,)
    carried = np.array([name in body for name in ranges.tags], bool)
    measured = KINDS["ranges"].measured(rig, ranges)
    used = np.flatnonzero(ranges.of_each(carried) & np.isfinite(measured.values[:, 0]))
    if min(len(t), len(used)) < 10:
        return
    used = used[np.argsort(ranges.times[used], kind="stable")]
    at, anchor, values = ranges.times[used], measured.sensors.number[used, 0], measured.values[used, 0]
    on = ranges.of_each(np.array([offsets.get(name, np.zeros(3)) for name in ranges.tags]))[used]
    height = rig.tags[tag].height if tag in rig.tags else None
    attitude = _attitudes(t, x[:, 3:] - _gyro_bias(t, x))
    force = np.einsum("nij,nj->ni", attitude, x[:, :3])
    signals = np.concatenate([integral(t, integral(t, force - force.mean(axis=0)))[:, :, None], attitude], axis=2)
    start, end = max(at[0], t[0] + LONGEST_DELAY_S), min(at[-1], t[-1] - LONGEST_DELAY_S) - WINDOW_S
    for begin in np.linspace(start, end, int(np.clip((end - start) // HOP_S + 1, 0, MOST_WINDOWS))):
        low, high = np.searchsorted(at, [begin, begin + WINDOW_S])
        part = low + np.flatnonzero(GOLDEN * np.arange(high - low) % 1.0 * (high - low) < MOST_RANGES)
        seen, number = np.unique(anchor[part], return_inverse=True)
        i, j = np.searchsorted(t, [begin - LONGEST_DELAY_S, begin + WINDOW_S + LONGEST_DELAY_S])
        near = slice(max(i - 1, 0), j + 1)
        if len(seen) < 3 or len(part) < 3 * (DEGREES[-1] + 1) + 2 * len(seen) or np.diff(t[near]).max() > GAP_S:
            continue
        up = force[near].mean(axis=0)
        size = np.linalg.norm(up)
        if size < LEAST_PUSH:
            continue
        side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        level = np.stack([side / np.linalg.norm(side), np.cross(up, side) / np.linalg.norm(side) / size, up / size])
        turned = np.einsum("ij,njk->ikn", level, signals[near])
        delayed = at[part, None] + DELAYS
        moved, *axes = (
            np.stack([np.interp(delayed, t[near], c) for c in turned[:, k]], axis=2)
            for k in range(4 if on[part].any() else 1)
        )
        basis = chebyshev.chebvander(2 * (at[part] - begin) / WINDOW_S - 1, DEGREES[-1])
        # The start is orders of magnitude larger than what is compared.
        moved = _left(basis[:, : OPEN_DEGREE + 1], moved.reshape(len(part), -1)).reshape(moved.shape) * (9.81 / size)
        moved = moved + sum(axis * on[part, k, None, None] for k, axis in enumerate(axes))
        places = measured.sensors.places[seen]
        up, down = (
            _window(at[part], basis[:, : OPEN_DEGREE + 1], number, _path(basis, number, values[part], *frame), moved)
            for frame in ((places, height), (places * UPSIDE_DOWN, None if height is None else -height))
        )
        yield up, down


class Path(NamedTuple):
    """Directions `rays` (n, 3) of a path from the anchors of ranges, zero along z if its height is known.

    `along` (n,): what the ranges tell of the place along the rays, m. `weights` (n,): one by their standard deviations.
    """

    rays: Float[np.ndarray, "n 3"]
    along: Float[np.ndarray, " n"]
    weights: Float[np.ndarray, " n"]


def _path(
    basis: np.ndarray, anchor: Int[np.ndarray, " n"], ranges: np.ndarray, places: np.ndarray, height: float | None
) -> Path:
    """A polynomial through ranges to `places` (G, 3), by Gauss-Newton steps from below the anchors."""
    free, path, constants = np.array([1.0, 1.0, height is None]), np.zeros((basis.shape[1], 3)), np.zeros(len(places))
    path[0] = places.mean(axis=0) - [0.0, 0.0, 1.0]
    path[0, 2] = path[0, 2] if height is None else height
    for degree in DEGREES:
        p, used = basis @ path, 3 * (degree + 1)
        away = p - places[anchor]
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-3)
        rays, errors = away / distance[:, None] * free, ranges - distance - constants[anchor]
        scale = max(1.4826 * float(np.median(np.abs(errors))), NOISE_M)
        weights = 1 / (1 + (errors / (2 * scale)) ** 2)
        J = np.concatenate([_products(basis[:, : degree + 1], rays), np.eye(len(places))[anchor]], axis=1)
        x = np.concatenate([np.zeros(3), path.ravel()[3:used], constants])
        prior = np.concatenate([np.repeat(1.0 + np.arange(degree + 1), 3) ** 2, np.full(len(places), CONSTANT_M**-2)])
        normal = _crossed(J, J * weights[:, None]) / scale**2 + np.diag(prior)
        step = np.linalg.solve(normal, (weights * errors) @ J / scale**2 - prior * x)
        path[: degree + 1] += step[:used].reshape(-1, 3)
        constants += step[used:]
    return Path(rays, ranges - distance + np.einsum("ni,ni->n", rays, p), np.sqrt(weights) / scale)


def _window(
    times: np.ndarray, basis: np.ndarray, anchor: np.ndarray, path: Path, moved: Float[np.ndarray, "n D 3"]
) -> Window:
    """The errors with the best polynomial, constants of anchors and heading, if an IMU has `moved` so at each delay."""
    count, rays, y = int(anchor.max()) + 1, path.rays * path.weights[:, None], (path.along * path.weights)[:, None]
    (x_ray, y_ray, z_ray), (x, y_moved, z) = rays.T[:, :, None], np.moveaxis(moved, 2, 0)
    columns = np.concatenate([y, y - z_ray * z, x_ray * x + y_ray * y_moved, y_ray * x - x_ray * y_moved], axis=1)
    unknown = np.concatenate([_products(basis, rays), np.eye(count)[anchor] * path.weights[:, None]], axis=1)
    prior = np.eye(unknown.shape[1])[-count:] / CONSTANT_M
    columns = np.concatenate([columns, np.zeros((count, columns.shape[1]))])
    columns = _left(np.concatenate([unknown, prior]), columns)
    left, a, b = np.split(columns[:, 1:], 3, axis=1)
    aa, ab, bb, ay, by = (np.einsum("nd,nd->d", *two) for two in ((a, a), (a, b), (b, b), (a, left), (b, left)))
    c, s = np.cos(TURNS), np.sin(TURNS)
    losses = c * c * aa + 2 * c * s * ab + s * s * bb - 2 * (c * ay + s * by)
    row = np.argmin(losses, axis=0)
    beside = (losses[(row + k) % len(TURNS), np.arange(len(row))] for k in (-1, 0, 1))
    heading = TURNS[row, 0] + TURNS[1, 0] * lowest(*beside)
    c, s = np.cos(heading), np.sin(heading)
    errors, still = left - c * a - s * b, float(columns[:, 0] @ columns[:, 0])
    return Window(times, errors[:-count], (s * a - c * b)[:-count], np.einsum("nd,nd->d", errors, errors), still)


def _left(columns: Float[np.ndarray, "n k"], y: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    """What is left of `y` without its least-squares fits by the columns, which may depend on each other."""
    normal = _crossed(columns, columns)
    normal += 1e-9 * np.trace(normal) * np.eye(len(normal))
    return np.asarray(y - np.einsum("ni,im->nm", columns, np.linalg.solve(normal, _crossed(columns, y))))


def _crossed(x: Float[np.ndarray, "n k"], y: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "k m"]:
    # The threads of matrix products and of QR wait for each other longer than products of this size take.
    return np.asarray(np.einsum("nk,nm->km", x, y))


def _products(basis: Float[np.ndarray, "n k"], rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3*k"]:
    return (basis[:, :, None] * rays[:, None]).reshape(len(rays), -1)


def _gyro_bias(t: Float[np.ndarray, " N"], x: Float[np.ndarray, "N 6"]) -> Float[np.ndarray, " 3"]:
    """The constant error of turn rates without which gravity keeps its direction; zero where gaps hide it."""
    bias = np.zeros(3)
    if np.diff(t).max() > GAP_S:
        return bias
    block = np.unique(np.floor((t - t[0]) / PUSH_S), return_inverse=True)[1]
    for _ in range(4):
        turned = _attitudes(t, x[:, 3:] - bias)
        drift = integral(t, turned.reshape(-1, 9))
        every = np.concatenate([np.einsum("nij,nj->ni", turned, x[:, :3]), drift], axis=1)
        means = np.stack([np.bincount(block, c) for c in every.T], axis=1) / np.bincount(block)[:, None]
        force, drift = means[:, :3], means[:, 3:].reshape(-1, 3, 3)
        fallen = np.swapaxes(np.cross(np.swapaxes(drift, 1, 2), force.mean(axis=0)), 1, 2)
        J = np.concatenate([np.tile(np.eye(3), (len(force), 1, 1)), fallen], axis=2)
        prior = PUSH / GYRO * np.eye(6)[3:]
        side = np.concatenate([force.ravel(), -prior[:, 3:] @ bias])
        bias = bias + np.linalg.lstsq(np.concatenate([J.reshape(-1, 6), prior]), side, rcond=None)[0][3:]
    return bias


def _attitudes(t: Float[np.ndarray, " N"], rates: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 3"]:
    """Rotations from body axes to those of the first row, by turn rates."""
    turn = (rates[1:] + rates[:-1]) / 2 * np.diff(t)[:, None]
    half = np.linalg.norm(turn, axis=1, keepdims=True) / 2
    steps = np.concatenate([np.cos(half), turn * np.sinc(half / np.pi) / 2], axis=1)
    w, x, y, z = 1.0, 0.0, 0.0, 0.0
    quaternions = [(w, x, y, z)]
    for a, b, c, d in steps.tolist():
        w, x, y, z = (
            w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a,
        )  # fmt: skip
        quaternions.append((w, x, y, z))
    q = np.array(quaternions)
    return rotation_matrices(q / np.linalg.norm(q, axis=1, keepdims=True))
