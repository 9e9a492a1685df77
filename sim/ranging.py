"""Ranges between tags and anchors: two-way ranging with clock drift, and corruptions of ranges (n, T, anchors), m.

`drop_outs`, `white_noise`, `gauss_markov` and `outliers` of `sim.corruptions` apply to ranges, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.sim.corruptions import Corruption, Seen, Times, Values, corrupted, in_bursts
from trackwright.sim.keys import Keys, in_blocks, normals, stream, trajectory_ids, trajectory_keys, uniforms
from trackwright.sim.paths import PathFunction, hand_motion
from trackwright.sim.tables import AXES, ArrayRows, folder_of
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.uwb_imu.trilateration import SPEED_OF_LIGHT, double_sided, single_sided

Ranges = Float[np.ndarray, "n T anchors"]

CHAMBER = np.array([[0.0, 0.0, 0.3], [5.0, 0.0, 2.5], [5.0, 5.0, 0.3], [0.0, 5.0, 2.5]])
"""Four anchors 5 m apart, m, as in the paper's chamber (section 4.1); heights, not printed, alternate low and high."""

WALK_VOLUME = np.array([[0.8, 0.8, 0.8], [4.2, 4.2, 1.6]])
"""The volume of the tags' paths in the chamber, lower and upper corner, m."""

WALK: PathFunction = partial(hand_motion, volume=WALK_VOLUME, speed=0.5)
"""Smooth random motion through that volume at 0.5 m/s."""


@dataclass(frozen=True)
class Protocol:
    """A two-way ranging protocol: an anchor polls, the tag replies after `reply_s`, each with its own clock.

    `drift`: standard deviation of the relative clock rates; crystals have 1e-5. `sigma_stamp`: noise of a time stamp,
    s. `double_sided`: whether a second exchange cancels the drift; otherwise 1e-5 over 0.3 ms is an error of half a
    metre.
    """

    reply_s: float = 0.3e-3
    drift: float = 1e-5
    sigma_stamp: float = 1e-10
    double_sided: bool = True

    def __post_init__(self) -> None:
        if not (self.reply_s > 0 and self.drift >= 0 and self.sigma_stamp >= 0):
            raise ValueError(
                f"reply_s = {self.reply_s}, drift = {self.drift}, sigma_stamp = {self.sigma_stamp}: expected a "
                "positive time, and drift and noise of 0 or more"
            )


def two_way_ranges(keys: Keys, distances: Ranges, protocol: Protocol) -> Ranges:
    """Ranges (n, T, anchors), m, measured by the protocol at these distances; the drift of a node is constant."""
    rows, anchors = distances.shape[1:]
    flight = distances / SPEED_OF_LIGHT
    rates = 1.0 + protocol.drift * normals(stream(keys, "clocks"), (anchors + 1,)).astype(float)
    tag, anchor = rates[:, None, :1], rates[:, None, 1:]
    # Every interval lies between two time stamps, each with independent noise.
    stamps = protocol.sigma_stamp * normals(stream(keys, "stamps"), (rows, anchors, 6)).astype(float)
    poll_sent, poll_received, reply_sent, reply_received, final_sent, final_received = np.moveaxis(stamps, -1, 0)
    reply = protocol.reply_s
    total = (2.0 * flight + reply) * anchor + reply_received - poll_sent
    wait = reply * tag + reply_sent - poll_received
    if not protocol.double_sided:
        return single_sided(total, wait)
    second_total = (2.0 * flight + reply) * tag + final_received - reply_sent
    second_wait = reply * anchor + final_sent - reply_received
    return double_sided(total, wait, second_total, second_wait)


def antenna_biases(sigma: float) -> Corruption:
    """A constant bias of each anchor's ranges, m, normal with mean zero: uncalibrated antenna delays."""

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        biases = sigma * normals(keys, (values.shape[2],))
        return values + biases[:, None, :].astype(values.dtype), seen

    return corrupt


def obstruction(share: float, mean_length_s: float, bias: float, tail: float) -> Corruption:
    """No line of sight to an anchor for a `share` of the time, `mean_length_s` at a stretch on average.

    Meanwhile its ranges are too long by `bias` m plus exponential noise of mean `tail` m.
    """
    if not (0 <= share < 1 and mean_length_s >= 0 and bias >= 0 and tail >= 0):
        raise ValueError(
            f"share = {share}, mean length {mean_length_s} s, bias {bias} m, tail {tail} m: expected a share from 0 to "
            "below 1, the others 0 or more"
        )

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        hidden = in_bursts(stream(keys, "hidden"), times, values.shape[2], share, mean_length_s)
        draws = uniforms(stream(keys, "detour"), values.shape[1:]).astype(float)
        detour = bias - tail * np.log1p(-draws)
        return values + np.where(hidden, detour, 0.0).astype(values.dtype), seen

    return corrupt


def on_anchors(anchors: Sequence[int], corruption: Corruption) -> Corruption:
    """The corruption restricted to the ranges of some anchors, which count from 0 in the rig's order."""
    chosen = list(anchors)

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        values, seen = values.copy(), seen.copy()
        values[..., chosen], seen[..., chosen] = corruption(keys, times, values[..., chosen], seen[..., chosen])
        return values, seen

    return corrupt


def round_robin() -> Corruption:
    """Polling of the anchors in turn: one range per row instead of one to every anchor."""

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        turn = np.arange(values.shape[1])[:, None] % values.shape[2] == np.arange(values.shape[2])
        return values, seen & turn

    return corrupt


@dataclass(frozen=True)
class SimulatedRanges:
    """Ranges of n tags at T times with their truth.

    `times` (T,) s; `positions` (n, T, 3) m; `ranges` (n, T, anchors) m, anchors in the order of `rig.anchors`, zero
    where not `seen`; `ids` (n,): the trajectory ids.
    """

    table: ClassVar[str] = "ranges"

    times: Times
    positions: Float[np.ndarray, "n T 3"]
    ranges: Ranges
    seen: Bool[np.ndarray, "n T anchors"]
    rig: Rig
    ids: Int[np.ndarray, " n"]

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
        return folder_of(name, tables, tags, anchors=self.rig.anchors)


def chamber(anchors: Float[np.ndarray, "A 3"] = CHAMBER) -> Rig:
    """The rig of a room with anchors (A, 3), m, by default as in the paper's chamber."""
    return Rig("chamber", anchors={f"A{k + 1}": np.asarray(a, float) for k, a in enumerate(anchors)})


def distances_to(anchors: Float[np.ndarray, "A 3"], positions: Float[np.ndarray, "n T 3"]) -> Ranges:
    """The distances (n, T, A) of positions, m, from anchors."""
    x, y, z = (positions[..., None, axis] - anchors[:, axis] for axis in range(3))
    return np.asarray(np.sqrt(x * x + y * y + z * z))


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

    `corruptions`: by name, which is the random stream, in order. A trajectory depends on the seed and its id alone.
    Raises ValueError for a rig without anchors.
    """
    if not rig.anchors:
        raise ValueError("ranges need anchors, found a rig without")
    ids = trajectory_ids(n)
    keys = trajectory_keys(seed, ids)
    times = np.arange(n_points) / rate_hz
    anchors = np.stack(list(rig.anchors.values()))

    def ranged(keys: Keys) -> tuple[np.ndarray, ...]:
        positions = path(stream(keys, "path"), times)
        distances = distances_to(anchors, positions)
        ranges = two_way_ranges(stream(keys, "two-way ranging"), distances, protocol or Protocol())
        corruption_keys, all_seen = stream(keys, "corruptions"), np.ones(ranges.shape, bool)
        ranges, seen = corrupted(corruptions, corruption_keys, times, ranges, all_seen)
        return positions, np.where(seen, ranges, 0.0), seen

    positions, ranges, seen = in_blocks(ranged, keys, size=32)
    return SimulatedRanges(times, positions, ranges, seen, rig, ids)
