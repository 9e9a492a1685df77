"""Starts of a survey of stations: rays to the tags from given ones, whose rotations are drawn, and the others on them.

A rotation of one station and a height of the tag give the path, as the points where its rays meet that height. The path
gives the rotation of any station at a known place in closed form (Wahba 1965; Kabsch 1976), and that of one at
an unknown place for each place that is tried. Rays of several stations then give a better path, in turn.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from trackwright.tuning.survey.bearings import BearingWalk

EPOCHS, NEAR = 60, 0.75
"""Times of a walk, and the largest time, s, to the next bearings of a station on either side of such a time."""

DRAWS, REFINED, TURNS = 800, 20, 12
"""Rotations of the first station that are drawn, how many of the best are refined, and in how many turns."""

TILT = 0.15
"""Standard deviation of the tilt of stations that are about level, rad."""

HEIGHTS = 0.3, 2.5
"""Distances of an unknown height of the tag from the station's, m, that are drawn above and below."""

FARTHEST = 40.0
"""Length, m, beyond which a ray has not met the height of a tag."""

ROUGHLY = 0.15
"""Scale of errors of directions, rad, in the search."""

PLACES, SHRINKS, MARGIN = 400, 5, 5.0
"""Places of a station that are tried, how often closer together, and how far, m, outside of what is known."""


def directions(walk: BearingWalk, count: int) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k S 3"]]:
    """Times, s, of a walk, and unit vectors to the tag in the array frames of `count` stations; NaN where none is near.

    Azimuths are interpolated by their sines and cosines; elevations that a station lacks count as zero.
    """
    times = np.linspace(walk.times[0], walk.times[-1], EPOCHS + 2)[1:-1]
    found = np.full((len(times), count, 3), np.nan)
    for k in range(count):
        azimuth, elevation = (_interpolated(walk, 2 * k + angle, times) for angle in (0, 1))
        if azimuth is not None:
            up = np.zeros(len(times)) if elevation is None else np.arctan2(elevation[:, 0], elevation[:, 1])
            flat = azimuth / np.linalg.norm(azimuth, axis=1, keepdims=True)
            found[:, k] = np.stack([flat[:, 0] * np.cos(up), np.sin(up), flat[:, 1] * np.cos(up)], axis=1)
    return times, found


def _interpolated(walk: BearingWalk, level: int, times: np.ndarray) -> np.ndarray | None:
    """Sine and cosine (k, 2) of an angle of a station at these times; NaN where none is near, None for none."""
    own = np.flatnonzero(walk.levels[:, 0] == level)
    if len(own) < 5:
        return None
    values = np.unwrap(walk.values[own])
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, 1, mode="edge"), 3)
    at = walk.times[own]
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    near = (times - at[after - 1] <= NEAR) & (at[after] - times <= NEAR) & (times >= at[0])
    angle = np.where(near, np.interp(times, at, np.median(windows, axis=1)), np.nan)
    return np.stack([np.sin(angle), np.cos(angle)], axis=1)


def turned_onto(
    local: Float[np.ndarray, "k 3"], world: Float[np.ndarray, "*c k 3"], weights: Float[np.ndarray, "*c k"]
) -> Float[np.ndarray, "*c 3 3"]:
    """The rotations, array frame to world frame, that turn directions nearest to others; weights may be zero."""
    product = np.swapaxes(world * weights[..., None], -1, -2) @ np.nan_to_num(local)
    left, _, right = np.linalg.svd(product)
    proper = np.sign(np.linalg.det(left @ right))
    left[..., 2] *= proper[..., None]
    return left @ right


def intersected(
    places: Float[np.ndarray, "S 3"], rays: Float[np.ndarray, "c k S 3"], heights: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "c k 3"]:
    """The points, m, nearest to rays (world frame) from stations, at heights that are known; NaN for no ray.

    The centre of the stations counts a little, for rays that do not meet.
    """
    seen = np.isfinite(rays[..., :1])
    across = np.where(seen[..., None], np.eye(3) - rays[..., :, None] * rays[..., None, :], 0.0)
    system = across.sum(axis=-3) + 1e-3 * np.eye(3)
    right = np.einsum("cksij,sj->cki", across, places) + 1e-3 * places.mean(axis=0)
    known = np.isfinite(heights)
    system[:, known, 2, 2] += 1e4
    right[:, known, 2] += 1e4 * heights[known]
    points = np.linalg.solve(system, right[..., None])[..., 0]
    points[~seen.any(axis=(-1, -2))] = np.nan
    return points


def misses(
    points: Float[np.ndarray, "c k 3"],
    place: Float[np.ndarray, "*p 3"],
    turns: Float[np.ndarray, "*t 3 3"],
    local: Float[np.ndarray, "k 3"],
) -> tuple[Float[np.ndarray, "c k 3"], Float[np.ndarray, "c k"]]:
    """Directions from a station to points, and the lengths of what the measured ones lack; infinite for none."""
    offset = points - place[..., None, :]
    ahead = offset / np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-9)
    return np.nan_to_num(ahead), np.nan_to_num(
        np.linalg.norm(ahead - local @ np.swapaxes(turns, -1, -2), axis=-1), nan=np.inf
    )


def weights_of(lengths: Float[np.ndarray, "*c k"]) -> Float[np.ndarray, "*c k"]:
    """Cauchy's weights of misses; zero for infinite ones."""
    return 1.0 / (1.0 + (lengths / ROUGHLY) ** 2)


def cost_of_misses(lengths: Float[np.ndarray, "*c k"]) -> Float[np.ndarray, "*c"]:
    """The sum of Cauchy's cost; a direction that nothing meets costs as one at a right angle."""
    return np.log1p((np.minimum(lengths, np.sqrt(2.0)) / ROUGHLY) ** 2).sum(axis=-1)


def level_rotations(random: np.random.Generator) -> Float[np.ndarray, "c 3 3"]:
    """Rotations of stations that look to all sides and are about level, array frame to world frame."""
    about = Rotation.from_euler("z", random.uniform(0.0, 2.0 * np.pi, (DRAWS, 1))).as_matrix()
    tilts = Rotation.from_rotvec(TILT * random.standard_normal((DRAWS, 3))).as_matrix()
    # The array's x axis is left of its boresight z, and y points up.
    return about @ np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]) @ tilts


def any_rotations(random: np.random.Generator) -> Float[np.ndarray, "c 3 3"]:
    """Rotations of stations that are mounted in any way."""
    return Rotation.random(DRAWS, random).as_matrix()


def rotations_found(
    places: Float[np.ndarray, "S 3"], local: Float[np.ndarray, "k S 3"], heights: Float[np.ndarray, " k"],
    drawn: Float[np.ndarray, "draws 3 3"], random: np.random.Generator,
) -> tuple[Float[np.ndarray, "c S 3 3"], Float[np.ndarray, "c k 3"]]:  # fmt: skip
    """Rotations of stations at known places, and points of the tag, m, that fit directions; the best first.

    `drawn`: rotations that are tried of the station that is seen most.
    """
    first = int(np.argmax(np.isfinite(local[..., 0]).sum(axis=0)))
    rays = np.einsum("cij,kj->cki", drawn, local[:, first])
    away = random.choice([-1.0, 1.0], len(drawn), p=[0.8, 0.2]) * random.uniform(*HEIGHTS, len(drawn))
    drop = np.where(np.isfinite(heights), heights - places[first, 2], away[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        length = drop / rays[..., 2]
    points = places[first] + np.where((length > 0.0) & (length < FARTHEST), length, np.nan)[..., None] * rays
    turns, costs = _turned(points, places, local)
    for _ in range(TURNS):
        best = np.argsort(costs)[:REFINED]
        points = intersected(places, np.einsum("csij,ksj->cksi", turns[best], local), heights)
        turns, costs = _turned(points, places, local)
    best = np.argsort(costs)
    return turns[best], points[best]


def _turned(
    points: Float[np.ndarray, "c k 3"], places: Float[np.ndarray, "S 3"], local: Float[np.ndarray, "k S 3"]
) -> tuple[Float[np.ndarray, "c S 3 3"], Float[np.ndarray, " c"]]:
    """The rotations of stations to points of the tag, and what they cost."""
    turns, costs = np.zeros((len(points), len(places), 3, 3)), np.zeros(len(points))
    for k, place in enumerate(places):
        turns[:, k], lengths = _facing(points, place, local[:, k])
        costs += cost_of_misses(lengths[:, np.isfinite(local[:, k, 0])])
    return turns, costs


def _facing(
    points: Float[np.ndarray, "c k 3"], place: Float[np.ndarray, "*p 3"], local: Float[np.ndarray, "k 3"]
) -> tuple[Float[np.ndarray, "c 3 3"], Float[np.ndarray, "c k"]]:
    """The rotations of a station that sees points in these directions, robustly, and the lengths of the misses."""
    ahead, _ = misses(points, place, np.eye(3), local)
    weights = (np.isfinite(points[..., 0]) & np.isfinite(local[:, 0])).astype(float)
    for _ in range(2):
        turns = turned_onto(local, ahead, weights)
        lengths = misses(points, place, turns, local)[1]
        weights = weights_of(lengths)
    return turns, lengths


def placed(
    points: Float[np.ndarray, "k 3"], local: Float[np.ndarray, "k 3"], random: np.random.Generator
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """The place, m, and the rotation of a station that sees the points of a tag in these directions."""
    seen = np.isfinite(points[:, 0]) & np.isfinite(local[:, 0])
    low, high = points[seen].min(axis=0) - MARGIN, points[seen].max(axis=0) + MARGIN
    for _ in range(SHRINKS):
        tried = random.uniform(low, high, (PLACES, 3))
        turns, lengths = _facing(np.broadcast_to(points[seen], (PLACES, seen.sum(), 3)), tried, local[seen])
        best = int(np.argmin(cost_of_misses(lengths)))
        size = 0.25 * (high - low)
        low, high = tried[best] - size, tried[best] + size
    return tried[best], turns[best]


def path_between(
    walk: BearingWalk, times: Float[np.ndarray, " k"], points: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "knots d"]:
    """The coefficients of the path of a walk through points, m, at times; NaN where there is none."""
    known = np.isfinite(points[:, 0])
    at = np.column_stack([np.interp(walk.times, times[known], column) for column in points[known].T])
    return walk.fitted(at)
