"""Ranges and range differences (TDoA) between tags and anchors, of tags alone and of several on a trolley, in m.

`drop_outs`, `white_noise`, `gauss_markov` and `outliers` of `sim.corruptions` apply to ranges, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import equinox as eqx
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Bool, Float, Int, Shaped

from trackwright.sim.corruptions import (
    Constant,
    Corruption,
    Seen,
    Times,
    Values,
    added,
    bursts,
    corrupted,
    in_bursts,
    white_density,
)
from trackwright.sim.keys import (
    Keys,
    in_blocks,
    in_dtype,
    namespace,
    normals,
    stream,
    trajectory_ids,
    trajectory_keys,
    uniforms,
)
from trackwright.sim.paths import PathFunction, hand_motion
from trackwright.sim.tables import AXES, AbstractDraw, ArrayRows, folder_of
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.uwb_imu.trilateration import SPEED_OF_LIGHT

Ranges = Float[Any, "n T anchors"]

CHAMBER = np.array([[0.0, 0.0, 0.3], [5.0, 0.0, 2.5], [5.0, 5.0, 0.3], [0.0, 5.0, 2.5]])
"""Four anchors 5 m apart, m, as in the paper's chamber (section 4.1); heights, not printed, alternate low and high."""

# Eight anchors, m, in the corners of the chamber, near the floor and below the ceiling.
CORNERS = np.array([[x, y, z] for z in (0.3, 2.5) for x, y in ((0.0, 0.0), (5.0, 0.0), (5.0, 5.0), (0.0, 5.0))])

WALK_VOLUME = np.array([[0.8, 0.8, 0.8], [4.2, 4.2, 1.6]])
"""The volume of the tags' paths in the chamber, lower and upper corner, m."""

WALK: PathFunction = partial(hand_motion, volume=WALK_VOLUME, speed=0.5)
"""Smooth random motion through that volume at 0.5 m/s."""


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
    poll_sent, poll_received, reply_sent, reply_received, final_sent, final_received = (
        stamps[..., k] for k in range(6)
    )
    # Equation (12) of Neirynck et al. as in `double_sided`, with (1 + rate) (2 flight + reply) + noise for round trips
    # and (1 + rate) reply + noise for delays, multiplied out: the squares of the reply cancel, also in float32.
    both, reply = (1.0 + tag) * (1.0 + anchor), protocol.reply_s * SPEED_OF_LIGHT
    first, second = reply_received - poll_sent, final_received - reply_sent
    delay, second_delay = reply_sent - poll_received, final_sent - reply_received
    there = (1.0 + anchor) * second + (1.0 + tag) * first
    back = (1.0 + tag) * second_delay + (1.0 + anchor) * delay
    product = 4.0 * both * distances * (distances + reply) + 2.0 * distances * there + reply * (there - back)
    product = product + (first * second - delay * second_delay)
    noise = first + second + delay + second_delay
    return product / (2.0 * (distances + reply) * (2.0 + tag + anchor) + noise)


def antenna_biases(sigma: float) -> Corruption:
    """A constant bias of each anchor's ranges, m, normal with mean zero: uncalibrated antenna delays."""
    return added(_antenna_biases, sigma=sigma)


def _antenna_biases(keys: Keys, times: Times, values: Values, *, sigma: float) -> Constant:
    return (sigma * normals(keys, values.shape[2:3]))[:, None]


def obstruction(share: float, mean_length_s: float, bias: float, tail: float) -> Corruption:
    """No line of sight to an anchor for a `share` of the time, `mean_length_s` at a stretch on average.

    Meanwhile its ranges are too long by `bias` m plus exponential noise of mean `tail` m.
    """
    hidden = bursts("the share of the time without line of sight", share, mean_length_s)
    return added(_detour, hidden_when=hidden, bias=bias, tail=tail)


def _detour(
    keys: Keys, times: Times, values: Values, *, hidden_when: Mapping[str, float], bias: float, tail: float
) -> Values:
    hidden = in_bursts(stream(keys, "hidden"), times, values.shape[2], **hidden_when)
    draws = in_dtype(uniforms(stream(keys, "detour"), values.shape[1:]), values)
    xp = namespace(hidden, draws)
    return xp.where(hidden, bias - tail * xp.log1p(-draws), 0.0)


def on_anchors(anchors: Sequence[int], corruption: Corruption) -> Corruption:
    """The corruption restricted to the ranges of some anchors, which count from 0 in the rig's order."""
    return Partial(_on_anchors, tuple(anchors), corruption)


def _on_anchors(
    chosen: tuple[int, ...], corruption: Corruption, keys: Keys, times: Times, values: Values, seen: Seen
) -> tuple[Values, Seen]:
    parts = corruption(keys, times, values[..., list(chosen)], seen[..., list(chosen)])
    xp, order = namespace(*parts), [*(k for k in range(values.shape[-1]) if k not in chosen), *chosen]
    rest, place = order[: -len(chosen)], np.argsort(order)
    both = (xp.concatenate([x[..., rest], part], axis=-1) for x, part in zip((values, seen), parts, strict=True))
    values, seen = (x[..., place] for x in both)
    return values, seen


def round_robin() -> Corruption:
    """Polling of the anchors in turn: one range per row instead of one to every anchor."""

    return Partial(_in_turn)


def _in_turn(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
    return values, seen & (np.arange(values.shape[1])[:, None] % values.shape[2] == np.arange(values.shape[2]))


@dataclass(frozen=True)
class SimulatedRanges:
    """Ranges of n tags at T times with their truth: m and s, anchors in the order of `rig.anchors`.

    `ranges` are zero where not `seen`; `ids`: the trajectory ids; `draw`: what drew them.
    """

    table: ClassVar[str] = "ranges"

    times: Times
    positions: Float[np.ndarray, "n T 3"]
    ranges: Ranges
    seen: Bool[np.ndarray, "n T anchors"]
    rig: Rig
    ids: Int[np.ndarray, " n"]
    draw: RangeDraw

    def rows(self) -> ArrayRows:
        """A row per range."""
        tag, row, anchor = np.nonzero(self.seen)
        return ArrayRows.of_entries(
            tag,
            self.ids,
            self.times[row],
            {("range_m",): self.ranges[self.seen].astype(float)[:, None]},
            {"anchor": (anchor, list(self.rig.anchors))},
        )

    def folder(self, name: str) -> RecordingFolder:
        """The recording folder: a row per range, truth in space; constant heights are in the rig."""
        heights = [float(z[0]) if np.ptp(z) == 0 else None for z in self.positions[..., 2]]
        tags = {str(i): Tag(height=height) for i, height in zip(self.ids, heights, strict=True)}
        tables = {self.table: self.rows(), "truth": ArrayRows.regular(self.times, self.ids, {AXES: self.positions})}
        return folder_of(name, tables, tags, self.draw, anchors=self.rig.anchors)


class RangeDraw(AbstractDraw):
    """Ranges to all anchors of a rig: see `simulate_ranges`."""

    corruptions: tuple[tuple[str, Corruption], ...]
    rig: Rig = eqx.field(static=True)
    path: PathFunction = eqx.field(static=True)
    rate_hz: float = eqx.field(static=True)
    n_points: int = eqx.field(static=True)
    protocol: Protocol = eqx.field(static=True)

    measured = MappingProxyType({"ranges": "seen"})
    size = 32

    @property
    def times(self) -> Times:
        return np.arange(self.n_points) / self.rate_hz

    def arrays(self, keys: Keys) -> dict[str, Any]:
        positions = self.path(stream(keys, "path"), self.times)
        distances = distances_to(np.stack(list(self.rig.anchors.values())), positions)
        ranges, seen = (
            two_way_ranges(stream(keys, "two-way ranging"), distances, self.protocol),
            np.ones(distances.shape, bool),
        )
        ranges, seen = corrupted(self.corruptions, stream(keys, "corruptions"), self.times, ranges, seen)
        # A tag reports no range that is not positive.
        return {"positions": positions, "ranges": ranges, "seen": seen & (ranges > 0)}

    def world(self, arrays: dict[str, np.ndarray], ids: Int[np.ndarray, " n"]) -> SimulatedRanges:
        ranges = np.where(arrays["seen"], arrays["ranges"], 0.0)
        return SimulatedRanges(self.times, **arrays | {"ranges": ranges}, rig=self.rig, ids=ids, draw=self)


def chamber(anchors: Float[np.ndarray, "A 3"] = CHAMBER) -> Rig:
    """The rig of a room with anchors (A, 3), m, by default as in the paper's chamber."""
    return Rig("chamber", anchors={f"A{k + 1}": np.asarray(a, float) for k, a in enumerate(anchors)})


def distances_to(anchors: Float[np.ndarray, "A 3"], positions: Float[Any, "n T 3"]) -> Ranges:
    """The distances (n, T, A) of positions, m, from anchors."""
    x, y, z = (positions[..., None, axis] - anchors[:, axis] for axis in range(3))
    distances: Ranges = namespace(x).sqrt(x * x + y * y + z * z)
    return distances


def simulate_ranges(
    rig: Rig,
    path: PathFunction = WALK,
    n: int | Sequence[int] | np.ndarray = 1,
    seed: int = 0,
    *,
    rate_hz: float = 10.0,
    n_points: int = 200,
    protocol: Protocol | None = None,
    corruptions: Mapping[str, Corruption] = MappingProxyType({}),
) -> SimulatedRanges:
    """Trajectories, `n` or with the ids `n`, of `n_points` rows of ranges to all anchors of the rig, with truth.

    `corruptions`: by name, which is the random stream, in order.
    """
    how = path, rate_hz, n_points, protocol or Protocol()
    return RangeDraw(tuple(corruptions.items()), rig, *how).drawn(n, seed)


Schedule = Literal["messages", "turns"]
"""At each time the differences of all anchors heard from the first of them; or one, of two neighbours in turn."""


@dataclass(frozen=True)
class SimulatedDifferences:
    """Times of arrival at n tags at T times, as distances, with their truth, and the differences that are reported.

    `arrivals` in m, up to an offset common to the anchors of a time, in the order of `rig.anchors`, where `heard`.
    """

    table: ClassVar[str] = "tdoa"

    times: Times
    positions: Float[np.ndarray, "n T 3"]
    arrivals: Ranges
    heard: Bool[np.ndarray, "n T anchors"]
    rig: Rig
    ids: Int[np.ndarray, " n"]
    draw: DifferenceDraw
    schedule: Schedule = "messages"

    def rows(self) -> ArrayRows:
        """A row per difference."""
        count = self.heard.shape[2]
        if self.schedule == "messages":
            first = np.broadcast_to(np.argmax(self.heard, axis=2)[..., None], self.heard.shape)
            tag, row, anchor = np.nonzero(self.heard & (np.arange(count) != first))
            other = first[tag, row, anchor]
        else:
            turn = np.arange(len(self.times)) % count
            both = self.heard[:, np.arange(len(turn)), turn] & self.heard[:, np.arange(len(turn)), turn - 1]
            tag, row = np.nonzero(both)
            anchor, other = turn[row], (turn[row] - 1) % count
        differences = self.arrivals[tag, row, anchor] - self.arrivals[tag, row, other]
        names = list(self.rig.anchors)
        return ArrayRows.of_entries(
            tag,
            self.ids,
            self.times[row],
            {("range_difference_m",): differences.astype(float)[:, None]},
            {"anchor": (anchor, names), "anchor_2": (other, names)},
        )

    def folder(self, name: str) -> RecordingFolder:
        """The recording folder: a row per difference, truth in space."""
        tables = {self.table: self.rows(), "truth": ArrayRows.regular(self.times, self.ids, {AXES: self.positions})}
        return folder_of(name, tables, self.ids, self.draw, anchors=self.rig.anchors)


class DifferenceDraw(AbstractDraw):
    """Times of arrival from all anchors of a rig, as distances: see `simulate_differences`."""

    corruptions: tuple[tuple[str, Corruption], ...]
    rig: Rig = eqx.field(static=True)
    path: PathFunction = eqx.field(static=True)
    rate_hz: float = eqx.field(static=True)
    n_points: int = eqx.field(static=True)
    schedule: Schedule = eqx.field(static=True)

    size = 32

    @property
    def times(self) -> Times:
        return np.arange(self.n_points) / self.rate_hz

    def arrays(self, keys: Keys) -> dict[str, Any]:
        positions = self.path(stream(keys, "path"), self.times)
        arrivals, keys = distances_to(np.stack(list(self.rig.anchors.values())), positions), stream(keys, "corruptions")
        arrivals, heard = corrupted(self.corruptions, keys, self.times, arrivals, np.ones(arrivals.shape, bool))
        return {"positions": positions, "arrivals": arrivals, "heard": heard}

    def world(self, arrays: dict[str, np.ndarray], ids: Int[np.ndarray, " n"]) -> SimulatedDifferences:
        return SimulatedDifferences(self.times, **arrays, rig=self.rig, ids=ids, draw=self, schedule=self.schedule)


def simulate_differences(
    rig: Rig,
    path: PathFunction = WALK,
    n: int | Sequence[int] | np.ndarray = 1,
    seed: int = 0,
    *,
    rate_hz: float = 10.0,
    n_points: int = 200,
    schedule: Schedule = "messages",
    corruptions: Mapping[str, Corruption] = MappingProxyType({}),
) -> SimulatedDifferences:
    """Trajectories, `n` or with the ids `n`, of `n_points` times of range differences, with truth.

    `corruptions`: of the times of arrival (n, T, anchors), m, by name, in order: the noise of an arrival is in all
    differences with its anchor.
    """
    return DifferenceDraw(tuple(corruptions.items()), rig, path, rate_hz, n_points, schedule).drawn(n, seed)


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
    √Hz, and of the turning rate, rad/s per √Hz; None: no odometry.
    """
    ids = trajectory_ids(n)
    times, anchors = np.arange(n_points) / rate_hz, np.stack(list(rig.anchors.values()))

    def ranged(keys: Keys) -> dict[str, np.ndarray]:
        axle = rounds(stream(keys, "path"), times)
        along = np.gradient(axle, times, axis=1)
        headings = np.unwrap(np.arctan2(along[..., 1], along[..., 0]), axis=1)
        cosine, sine = np.cos(headings)[..., None], np.sin(headings)[..., None]
        x, y, z = OFFSETS[:tags].T
        arms = np.stack([cosine * x - sine * y, sine * x + cosine * y, z + 0.0 * sine], axis=-1)
        positions = axle[:, :, None] + arms
        nothing = np.zeros((len(axle), len(times), len(anchors)))
        shared, heard = corrupted(of_anchors.items(), stream(keys, "anchors"), times, nothing, nothing == 0.0)
        distances = distances_to(anchors, positions.reshape(len(axle), -1, 3)).reshape(len(axle), len(times), -1)
        errors = stream(keys, "ranges")
        ranges, seen = corrupted(
            of_ranges.items(), errors, times, distances + np.tile(shared, tags), np.tile(heard, tags)
        )
        ranges, seen = (a.reshape(*positions.shape[:3], -1) for a in (np.where(seen, ranges, 0.0), seen))
        odometry = _driven(keys, times, axle, headings, wheels)
        return {"positions": positions, "headings": headings, "ranges": ranges, "seen": seen, "odometry": odometry}

    arrays: dict[str, Any] = in_blocks(ranged, trajectory_keys(seed, ids), size=32)
    return SimulatedBodies(times, **arrays | ({"odometry": None} if wheels is None else {}), rig=rig, ids=ids)


def _driven(
    keys: Keys, times: Times, axle: np.ndarray, headings: np.ndarray, wheels: tuple[float, float] | None
) -> Float[np.ndarray, "n intervals 2"]:
    """The odometry between the times: arcs of the true turns and distances, with white errors."""
    dt, turn = np.diff(times), np.diff(headings, axis=1)
    speed = np.sqrt((np.diff(axle, axis=1) ** 2).sum(axis=-1)) / dt / np.sinc(turn / (2 * np.pi))
    readings = np.stack([speed, turn / dt], axis=-1)
    for k, sigma in enumerate(wheels or ()):
        errors, part = [("noise", white_density(sigma))], readings[..., k : k + 1]
        readings[..., k : k + 1], _ = corrupted(errors, stream(keys, f"wheels {k}"), times[:-1], part, part == part)
    return readings
