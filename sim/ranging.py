"""Ranges and range differences (TDoA) between tags and anchors, of tags alone and of several on a trolley, in m."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from trackwright.sim.corruptions import Corruption, Seen, corrupted, white_density
from trackwright.sim.keys import Keys, namespace, normals, stream, uniforms
from trackwright.sim.paths import Times, hand_motion
from trackwright.sim.tables import AXES, AbstractDraw, AbstractRigDraw, ArrayRows, SimulatedWorld, by_name, static
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.uwb_imu.trilateration import SPEED_OF_LIGHT

Ranges = Float[Any, "n T anchors"]

CHAMBER = np.array([[0.0, 0.0, 0.3], [5.0, 0.0, 2.5], [5.0, 5.0, 0.3], [0.0, 5.0, 2.5]])
"""Four anchors 5 m apart, m, as in the paper's chamber (section 4.1); heights, not printed, alternate low and high."""

# Eight anchors, m, in the corners of the chamber, near the floor and below the ceiling.
CORNERS = np.array([[x, y, z] for z in (0.3, 2.5) for x, y in ((0.0, 0.0), (5.0, 0.0), (5.0, 5.0), (0.0, 5.0))])


@dataclass(frozen=True)
class Protocol:
    """A two-way ranging protocol: an anchor polls, the tag replies after `reply_s`, each with its own clock.

    `drift`: standard deviation of the relative clock rates; crystals have 1e-5. `sigma_stamp`: noise of a time stamp,
    s. A second exchange cancels most of the drift.
    """

    reply_s: float = 0.3e-3
    drift: float = 1e-5
    sigma_stamp: float = 1e-10


def two_way_ranges(keys: Keys, distances: Ranges, protocol: Protocol) -> Ranges:
    """Ranges (n, T, anchors), m, measured by the protocol at these distances; the drift of a node is constant."""
    rows, anchors = distances.shape[1:]
    rates = protocol.drift * normals(stream(keys, "clocks"), (anchors + 1,)).astype(float)
    tag, anchor = rates[:, None, :1], rates[:, None, 1:]
    # Every interval lies between two time stamps, each with independent noise; all as lengths, m.
    stamps = protocol.sigma_stamp * normals(stream(keys, "stamps"), (rows, anchors, 6)).astype(float) * SPEED_OF_LIGHT
    poll_out, poll_in, reply_out, reply_in, final_out, final_in = (stamps[..., k] for k in range(6))
    # Equation (12) of Neirynck et al. as in `double_sided`, with (1 + rate) (2 flight + reply) + noise for round trips
    # and (1 + rate) reply + noise for delays, multiplied out: the squares of the reply cancel, also in float32.
    both, reply = (1.0 + tag) * (1.0 + anchor), protocol.reply_s * SPEED_OF_LIGHT
    first, second = reply_in - poll_out, final_in - reply_out
    delay, second_delay = reply_out - poll_in, final_out - reply_in
    there = (1.0 + anchor) * second + (1.0 + tag) * first
    back = (1.0 + tag) * second_delay + (1.0 + anchor) * delay
    product = 4.0 * both * distances * (distances + reply) + 2.0 * distances * there + reply * (there - back)
    product = product + (first * second - delay * second_delay)
    noise = first + second + delay + second_delay
    return product / (2.0 * (distances + reply) * (2.0 + tag + anchor) + noise)


def chamber(anchors: Float[np.ndarray, "A 3"] = CHAMBER) -> Rig:
    """The rig of a room with anchors (A, 3), m, by default as in the paper's chamber."""
    return Rig("chamber", anchors={f"A{k + 1}": np.asarray(a, float) for k, a in enumerate(anchors)})


def distances_to(rig: Rig, positions: Float[Any, "*rows 3"], places: Any = None) -> Float[Any, "*rows A"]:
    """The distances (..., A) of positions (..., 3), m, from the rig's anchors, or from `places` (A, 3) of theirs."""
    anchors = np.stack([*rig.anchors.values()]) if places is None else places
    x, y, z = (positions[..., None, axis] - anchors[:, axis] for axis in range(3))
    distances: Ranges = namespace(x).sqrt(x * x + y * y + z * z)
    return distances


class RangeDraw(AbstractRigDraw):
    """Ranges to all anchors of the rig, or to `places` (A, 3) m instead of its own, by a two-way protocol.

    Its arrays: `positions` (n, T, 3) m; `ranges` (n, T, anchors) m, where `seen`, anchors in the order of the rig.
    """

    protocol: Protocol = static(default=Protocol())
    places: Float[Any, "A 3"] | None = None

    measured = MappingProxyType({"ranges": "seen"})

    def arrays(self, keys: Keys) -> dict[str, Any]:
        positions = self.positions(keys, self.times)
        distances = distances_to(self.rig, positions, self.places)
        ranges = two_way_ranges(stream(keys, "two-way ranging"), distances, self.protocol)
        ranges, seen = corrupted(self.corruptions, stream(keys, "corruptions"), self.times, ranges)
        # A tag reports no range that is not positive.
        return {"positions": positions, "ranges": ranges, "seen": seen & (ranges > 0)}

    def rows(self, world: SimulatedWorld) -> dict[str, ArrayRows]:
        """A row per range."""
        return {"ranges": _range_rows(self.times, world.ids, world.arrays["ranges"], world.seen, self.rig)}


def _range_rows(times: Times, tags: np.ndarray, ranges: Ranges, seen: Seen, rig: Rig) -> ArrayRows:
    anchors = {"anchor": (np.arange(len(rig.anchors)), [*rig.anchors])}
    return ArrayRows(times, tags, {("range_m",): ranges[..., None]}, seen, anchors)


class DifferenceDraw(AbstractRigDraw):
    """Range differences; the noise of an arrival is in all differences with its anchor.

    `schedule`: at each time those of all anchors heard from the first of them; or one, of two neighbours in turn. Its
    arrays: `positions` (n, T, 3) m; `arrivals` (n, T, anchors): times of arrival as distances, m, up to an offset
    common to the anchors of a time, where `heard`, anchors in the order of the rig.
    """

    schedule: Literal["messages", "turns"] = static(default="messages")

    def arrays(self, keys: Keys) -> dict[str, Any]:
        positions, errors = self.positions(keys, self.times), stream(keys, "corruptions")
        arrivals, heard = corrupted(self.corruptions, errors, self.times, distances_to(self.rig, positions))
        return {"positions": positions, "arrivals": arrivals, "heard": heard}

    def rows(self, world: SimulatedWorld) -> dict[str, ArrayRows]:
        """A row per difference."""
        heard, names = world.heard, [*self.rig.anchors]
        if self.schedule == "messages":
            anchor, other = np.arange(len(names))[None, None], np.argmax(heard, axis=2)[..., None]
        else:
            anchor = (np.arange(self.n_points) % len(names))[None, :, None]
            other = (anchor - 1) % len(names)
        arrival, seen = ([np.take_along_axis(x, k, axis=2) for k in (anchor, other)] for x in (world.arrivals, heard))
        differences, seen = (arrival[0] - arrival[1])[..., None], seen[0] & seen[1] & (anchor != other)
        of_rows = {"anchor": (anchor, names), "anchor_2": (other, names)}
        return {"tdoa": ArrayRows(self.times, world.ids, {("range_difference_m",): differences}, seen, of_rows)}


OFFSETS = np.array([[0.0, 0.0, 0.0], [0.5, 0.25, 0.0], [0.5, -0.25, 0.0]])
"""Places of the tags on a trolley, m, ahead and to the left of the middle of its axle."""

# Of the trolleys' rounds in the chamber, m and m/s; the height is the tags'.
CENTRE, RADIUS, WANDER, SPEED = np.array([2.5, 2.5, 1.0]), 1.2, np.array([0.5, 0.5, 0.0]), 0.5


def rounds(keys: Keys, times: Times) -> Float[np.ndarray, "n T 3"]:
    """Paths (n, T, 3), m, round the middle of the chamber at about 0.5 m/s, either way.

    A smooth random motion is added, a fifth as fast, so that a trolley neither stops nor turns on the spot.
    """
    start, way = uniforms(stream(keys, "round"), (2,)).astype(float).T[..., None]
    angle = 2 * np.pi * start + np.where(way < 0.5, -1.0, 1.0) * (SPEED / RADIUS) * times
    circle = RADIUS * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    return circle + hand_motion(keys, times, np.stack([CENTRE - WANDER, CENTRE + WANDER]), speed=SPEED / 5)


class TrolleyDraw(AbstractDraw):
    """Trolleys whose `tags` range to all anchors of the rig at `n_points` times, in NumPy alone.

    The middle of the axle goes its `rounds`; the trolley looks along them. `of_anchors`: corruptions (n, T, A), m, of
    the ranges of all tags alike; `of_ranges`: of each tag (n, T, tags·A). `wheels`: white errors of the speed, m/s per
    √Hz, and of the turning rate, rad/s per √Hz; None: no odometry. Its arrays: `positions` (n, T, tags, 3) m;
    `headings` (n, T) rad; `ranges` (n, T, tags, A) m, where `seen`; `odometry` (n, T − 1, 2): forward speed, m/s, and
    turning rate, rad/s, of each time until the next.
    """

    rig: Rig = static()
    tags: int = static(default=3)
    rate_hz: float = static(default=10.0)
    n_points: int = static(default=200)
    of_anchors: Mapping[str, Corruption] = by_name(default_factory=dict)
    of_ranges: Mapping[str, Corruption] = by_name(default_factory=dict)
    wheels: tuple[float, float] | None = static(default=(0.01, 0.04))

    size = 32

    @property
    def times(self) -> Times:
        return np.arange(self.n_points) / self.rate_hz

    def arrays(self, keys: Keys) -> dict[str, Any]:
        times, axle = self.times, rounds(stream(keys, "path"), self.times)
        along = np.gradient(axle, times, axis=1)
        headings = np.unwrap(np.arctan2(along[..., 1], along[..., 0]), axis=1)
        cosine, sine = np.cos(headings)[..., None], np.sin(headings)[..., None]
        x, y, z = OFFSETS[: self.tags].T
        arms = np.stack([cosine * x - sine * y, sine * x + cosine * y, z + 0.0 * sine], axis=-1)
        positions = axle[:, :, None] + arms
        distances = distances_to(self.rig, positions)
        nothing = np.zeros_like(distances[:, :, 0])
        shared, heard = corrupted(self.of_anchors, stream(keys, "anchors"), times, nothing)
        ranges, heard = distances + shared[:, :, None], np.broadcast_to(heard[:, :, None], distances.shape)
        flat = (x.reshape(*x.shape[:2], -1) for x in (ranges, heard))
        ranges, seen = corrupted(self.of_ranges, stream(keys, "ranges"), times, *flat)
        ranges, seen = (x.reshape(distances.shape) for x in (np.where(seen, ranges, 0.0), seen))
        arrays = {"positions": positions, "headings": headings, "ranges": ranges, "seen": seen & (ranges > 0)}
        if self.wheels is not None:
            arrays["odometry"] = _driven(keys, times, axle, headings, self.wheels)
        return arrays

    def folder(self, world: SimulatedWorld) -> RecordingFolder:
        """Ranges, truth with attitudes, odometry; each trolley's first tag has its id as name, then `ID-2`, `ID-3`."""
        bodies = {str(i): (str(i), *(f"{i}-{k}" for k in range(2, self.tags + 1))) for i in world.ids}
        names = np.array([tag for tags in bodies.values() for tag in tags])
        height, offsets = float(world.positions[0, 0, 0, 2]), [*OFFSETS[: self.tags]] if self.tags > 1 else [None]
        tags = {tag: Tag(height, at) for body in bodies.values() for tag, at in zip(body, offsets, strict=True)}
        half = np.repeat(world.headings / 2, self.tags, axis=0)
        attitudes = np.stack([np.cos(half), (zero := np.zeros_like(half)), zero, np.sin(half)], axis=-1)
        # Of each tag, of one trolley after another.
        positions, ranges, seen = (
            np.moveaxis(world.arrays[name], 2, 1).reshape(len(names), self.n_points, -1)
            for name in ("positions", "ranges", "seen")
        )
        tables = {
            "ranges": _range_rows(self.times, names, ranges, seen, self.rig),
            "truth": ArrayRows(self.times, names, {AXES: positions, QUATERNION: attitudes}),
        }
        if self.wheels is not None:
            driven = {("speed_mps", "yaw_rate_radps"): world.odometry}
            tables["odometry"] = ArrayRows(self.times[:-1], world.ids, driven)
        return world.recorded(tables, tags, anchors=self.rig.anchors, bodies=bodies if self.tags > 1 else {})


def _driven(
    keys: Keys, times: Times, axle: np.ndarray, headings: np.ndarray, wheels: tuple[float, float]
) -> Float[np.ndarray, "n intervals 2"]:
    """The odometry between the times: arcs of the true turns and distances, with white errors."""
    dt, turn = np.diff(times), np.diff(headings, axis=1)
    speed = np.sqrt((np.diff(axle, axis=1) ** 2).sum(axis=-1)) / dt / np.sinc(turn / (2 * np.pi))
    readings = np.stack([speed, turn / dt], axis=-1)
    for k, sigma in enumerate(wheels):
        noise, errors = {"noise": white_density(sigma)}, stream(keys, f"wheels {k}")
        readings[..., k : k + 1], _ = corrupted(noise, errors, times[:-1], readings[..., k : k + 1])
    return readings
