"""Trolleys with several ranging tags, upright and in the direction of their way, with odometry of their wheels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from trackwright.sim.corruptions import Corruption, Times, corrupted
from trackwright.sim.imu import white_density
from trackwright.sim.keys import Keys, in_blocks, stream, trajectory_ids, trajectory_keys, uniforms
from trackwright.sim.paths import hand_motion
from trackwright.sim.ranging import distances_to
from trackwright.sim.tables import AXES, ArrayRows, folder_of
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.folder import RecordingFolder

OFFSETS = np.array([[0.0, 0.0, 0.0], [0.5, 0.25, 0.0], [0.5, -0.25, 0.0]])
"""Places of the tags on a trolley, m, ahead and to the left of the middle of its axle."""

CENTRE, RADIUS, WANDER, SPEED = np.array([2.5, 2.5, 1.0]), 1.2, np.array([0.5, 0.5, 0.0]), 0.5
"""Of the trolleys' rounds in the chamber, m and m/s; the height is the tags'."""


def rounds(keys: Keys, times: Times) -> Float[np.ndarray, "n T 3"]:
    """Paths (n, T, 3), m, round the middle of the chamber at about 0.5 m/s, either way.

    A smooth random motion is added, a fifth as fast, so that a trolley neither stops nor turns on the spot.
    """
    start, way = uniforms(stream(keys, "round"), (2,)).astype(float).T[..., None]
    angle = 2 * np.pi * start + np.where(way < 0.5, -1.0, 1.0) * (SPEED / RADIUS) * times
    circle = RADIUS * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    return circle + hand_motion(keys, times, np.stack([CENTRE - WANDER, CENTRE + WANDER]), speed=SPEED / 5)


@dataclass(frozen=True)
class SimulatedBodies:
    """Ranges of the tags of n trolleys at T times, and odometry, with truth.

    `positions` (n, T, tags, 3) m; `headings` (n, T) rad; `ranges` (n, T, tags, A) m, where `seen`; `odometry`
    (n, T − 1, 2): forward speed, m/s, and turning rate, rad/s, of each time until the next, None without wheels.
    """

    times: Times
    positions: Float[np.ndarray, "n T tags 3"]
    headings: Float[np.ndarray, "n T"]
    ranges: Float[np.ndarray, "n T tags anchors"]
    seen: Bool[np.ndarray, "n T tags anchors"]
    odometry: Float[np.ndarray, "n intervals 2"] | None
    rig: Rig
    ids: Int[np.ndarray, " n"]

    def folder(self, name: str) -> RecordingFolder:
        """The recording folder. Each trolley's first tag has its id as name; the others are `ID-2`, `ID-3`."""
        count = self.positions.shape[2]
        bodies = {str(i): (str(i), *(f"{i}-{k}" for k in range(2, count + 1))) for i in self.ids}
        names = np.array([tag for tags in bodies.values() for tag in tags])
        height, offsets = float(self.positions[0, 0, 0, 2]), [*OFFSETS[:count]] if count > 1 else [None]
        tags = {tag: Tag(height, at) for body in bodies.values() for tag, at in zip(body, offsets, strict=True)}
        half, zero = np.repeat(self.headings / 2, count, axis=0), np.zeros((len(names), len(self.times)))
        attitudes = np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)
        positions, ranges, seen = (_by_tag(x) for x in (self.positions, self.ranges, self.seen))
        tag, row, anchor = np.nonzero(seen)
        anchors = {"anchor": (anchor, list(self.rig.anchors))}
        tables = {
            "ranges": ArrayRows.of_entries(tag, names, self.times[row], {("range_m",): ranges[seen][:, None]}, anchors),
            "truth": ArrayRows.regular(self.times, names, {AXES: positions, QUATERNION: attitudes}),
        }
        if self.odometry is not None:
            tables["odometry"] = ArrayRows.regular(
                self.times[:-1], self.ids, {("speed_mps", "yaw_rate_radps"): self.odometry}
            )
        return folder_of(name, tables, tags, anchors=self.rig.anchors, bodies=bodies if count > 1 else {})


def _by_tag(values: Shaped[np.ndarray, "n T tags m"]) -> Shaped[np.ndarray, "n_tags T m"]:
    """The values of each tag, of one trolley after another."""
    return np.moveaxis(values, 2, 1).reshape(-1, values.shape[1], values.shape[3])


def simulate_bodies(
    rig: Rig,
    n: int | Sequence[int] | np.ndarray = 1,
    seed: int = 0,
    *,
    tags: int = 3,
    rate_hz: float = 10.0,
    n_points: int = 200,
    of_anchors: Mapping[str, Corruption] = MappingProxyType({}),
    of_ranges: Mapping[str, Corruption] = MappingProxyType({}),
    wheels: tuple[float, float] | None = (0.01, 0.04),
) -> SimulatedBodies:
    """Trolleys, `n` or with the ids `n`, whose `tags` range to all anchors at `n_points` times.

    The middle of the axle goes its `rounds`; the trolley looks along them. `of_anchors`: corruptions (n, T, A), m, of
    the ranges of all tags alike; `of_ranges`: of each tag (n, T, tags·A). `wheels`: white errors of the speed, m/s per
    √Hz, and of the turning rate, rad/s per √Hz; None: no odometry. A trajectory depends on the seed and its id alone.
    """
    ids = trajectory_ids(n)
    times, anchors = np.arange(n_points) / rate_hz, np.stack(list(rig.anchors.values()))

    def ranged(keys: Keys) -> tuple[np.ndarray, ...]:
        axle = rounds(stream(keys, "path"), times)
        along = np.gradient(axle, times, axis=1)
        headings = np.unwrap(np.arctan2(along[..., 1], along[..., 0]), axis=1)
        cosine, sine = np.cos(headings)[..., None], np.sin(headings)[..., None]
        x, y, z = OFFSETS[:tags].T
        arms = np.stack([cosine * x - sine * y, sine * x + cosine * y, z + 0.0 * sine], axis=-1)
        positions = axle[:, :, None] + arms
        nothing = np.zeros((len(axle), len(times), len(anchors)))
        shared, heard = corrupted(of_anchors, stream(keys, "anchors"), times, nothing, nothing == 0.0)
        distances = distances_to(anchors, positions.reshape(len(axle), -1, 3)).reshape(len(axle), len(times), -1)
        errors = stream(keys, "ranges")
        ranges, seen = corrupted(of_ranges, errors, times, distances + np.tile(shared, tags), np.tile(heard, tags))
        ranges, seen = (a.reshape(*positions.shape[:3], -1) for a in (np.where(seen, ranges, 0.0), seen))
        return positions, headings, ranges, seen, _driven(keys, times, axle, headings, wheels)

    positions, headings, ranges, seen, odometry = in_blocks(ranged, trajectory_keys(seed, ids), size=32)
    measured = None if wheels is None else odometry
    return SimulatedBodies(times, positions, headings, ranges, seen, measured, rig, ids)


def _driven(
    keys: Keys,
    times: Times,
    axle: Float[np.ndarray, "n T 3"],
    headings: Float[np.ndarray, "n T"],
    wheels: tuple[float, float] | None,
) -> Float[np.ndarray, "n intervals 2"]:
    """The odometry between the times: arcs of the true turns and distances, with white errors."""
    dt, turn = np.diff(times), np.diff(headings, axis=1)
    speed = np.sqrt((np.diff(axle, axis=1) ** 2).sum(axis=-1)) / dt / np.sinc(turn / (2 * np.pi))
    readings = np.stack([speed, turn / dt], axis=-1)
    for k, sigma in enumerate(wheels or ()):
        errors, part = {"noise": white_density(sigma)}, readings[..., k : k + 1]
        readings[..., k : k + 1], _ = corrupted(errors, stream(keys, f"wheels {k}"), times[:-1], part, part == part)
    return readings
