"""Ranges of tags among anchors: two-way ranging by clocks that differ, and what real rooms do to it, one piece each.

A piece is a `sim.corruptions.Corruption` on ranges (n, T, anchors), m; `drop_outs`, `white_noise`, `gauss_markov` and
`outliers` of `sim.corruptions` are others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
import polars as pl

from sim.corruptions import Corruption, corrupted, in_bursts
from sim.keys import Keys, normals, stream, trajectory_keys, uniforms
from sim.paths import PathFunction, hand_motion
from sim.tables import axes_m, folder_of, named, table_of
from trackers.core.rig import Rig, Tag
from trackers.recordings.folder import RecordingFolder
from trackers.uwb_imu.ranging import SPEED_OF_LIGHT, double_sided, single_sided

CHAMBER = np.array([[0.0, 0.0, 0.3], [5.0, 0.0, 2.5], [5.0, 5.0, 0.3], [0.0, 5.0, 2.5]])
"""Four anchors 5 m apart, as in the paper's chamber (section 4.1), m; it prints no heights: low and high in turn."""

WALK_VOLUME = np.array([[0.8, 0.8, 0.8], [4.2, 4.2, 1.6]])
"""Where tags move among the chamber's anchors, lower and upper corner, m."""

WALK: PathFunction = partial(hand_motion, volume=WALK_VOLUME, speed=0.5)
"""Smooth random motion through that volume at 0.5 m/s."""


@dataclass(frozen=True)
class Protocol:
    """How a range is taken: an anchor asks, the tag answers `reply_s` later, by clocks of their own.

    `drift`: the standard deviation of a clock's rate about the true one; crystals have 1e-5. `sigma_stamp`: the noise
    of a time stamp, s. `double_sided`: whether a second turn follows, which cancels the drift; without it nothing is
    known of the drift, and 1e-5 over 0.3 ms makes half a metre.
    """

    reply_s: float = 0.3e-3
    drift: float = 1e-5
    sigma_stamp: float = 1e-10
    double_sided: bool = True

    def __post_init__(self) -> None:
        if not (self.reply_s > 0 and self.drift >= 0 and self.sigma_stamp >= 0):
            raise ValueError(
                f"a reply takes a positive time, drift and noise aren't negative: found {self.reply_s} s, "
                f"{self.drift}, {self.sigma_stamp} s"
            )


def two_way_ranges(keys: Keys, distances: np.ndarray, protocol: Protocol) -> np.ndarray:
    """Ranges (n, T, anchors), m, as the protocol takes them of the distances; every node's drift stays as it is."""
    rows, anchors = distances.shape[1:]
    flight = distances / SPEED_OF_LIGHT
    rates = 1.0 + protocol.drift * normals(stream(keys, "clocks"), (anchors + 1,)).astype(float)
    tag, anchor = rates[:, None, :1], rates[:, None, 1:]
    # Intervals between two stamps each, every stamp with its own noise.
    stamps = protocol.sigma_stamp * normals(stream(keys, "stamps"), (rows, anchors, 6)).astype(float)
    asked, heard, answered, back, again, end = np.moveaxis(stamps, -1, 0)
    reply = protocol.reply_s
    total = (2.0 * flight + reply) * anchor + back - asked
    wait = reply * tag + answered - heard
    if not protocol.double_sided:
        return single_sided(total, wait)
    second_total = (2.0 * flight + reply) * tag + end - answered
    second_wait = reply * anchor + again - back
    return double_sided(total, wait, second_total, second_wait)


def antenna_biases(sigma: float, mean: float = 0.0) -> Corruption:
    """A constant bias of every anchor's ranges, m, normal about `mean`: antenna delays that nobody measured."""

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        biases = mean + sigma * normals(keys, (values.shape[2],))
        return values + biases[:, None, :].astype(values.dtype), seen

    return corrupt


def obstruction(share: float, mean_length_s: float, bias: float, tail: float) -> Corruption:
    """No line of sight for a `share` of the time, `mean_length_s` at a stretch: a detour of `bias` m, and a heavy tail.

    While an anchor is hidden its ranges are too long by `bias`, and by exponential numbers of mean `tail` m.
    """
    if not (0 <= share < 1 and mean_length_s >= 0 and bias >= 0 and tail >= 0):
        raise ValueError(
            f"a share lies in 0..1, length, bias and tail aren't negative: found {share}, {mean_length_s} s, {bias} m, "
            f"{tail} m"
        )

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hidden = in_bursts(stream(keys, "hidden"), times, values.shape[2], share, mean_length_s)
        draws = uniforms(stream(keys, "detour"), values.shape[1:]).astype(float)
        detour = bias - tail * np.log1p(-draws)
        return values + np.where(hidden, detour, 0.0).astype(values.dtype), seen

    return corrupt


def on_anchors(anchors: Sequence[int], piece: Corruption) -> Corruption:
    """The piece on the ranges of some anchors alone; they count from 0 in the rig's order."""
    chosen = list(anchors)

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values, seen = values.copy(), seen.copy()
        values[..., chosen], seen[..., chosen] = piece(keys, times, values[..., chosen], seen[..., chosen])
        return values, seen

    return corrupt


def round_robin() -> Corruption:
    """Anchors in turn, one a row, where otherwise a row holds all of them."""

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turn = np.arange(values.shape[1])[:, None] % values.shape[2] == np.arange(values.shape[2])
        return values, seen & turn

    return corrupt


@dataclass(frozen=True)
class SimulatedRanges:
    """Ranges of n tags at T times with their truth.

    `times` (T,) s; `positions` (n, T, 3) m; `ranges` (n, T, anchors) m, anchors in the order of `rig.anchors`, zero
    where not `seen`; `ids` (n,): the trajectory ids.
    """

    times: np.ndarray
    positions: np.ndarray
    ranges: np.ndarray
    seen: np.ndarray
    rig: Rig
    ids: np.ndarray

    def folder(self, name: str) -> RecordingFolder:
        """The recording folder: a row per range, truth in space; constant heights are in the rig."""
        tag, row, anchor = np.nonzero(self.seen)
        ranges = pl.DataFrame(
            {
                "t_s": self.times[row],
                "tag": named(tag, self.ids),
                "anchor": named(anchor, list(self.rig.anchors)),
                "range_m": self.ranges[tag, row, anchor].astype(float),
            }
        )
        heights = [float(z[0]) if np.ptp(z) == 0 else None for z in self.positions[..., 2]]
        tags = {str(i): Tag(height=height) for i, height in zip(self.ids, heights, strict=True)}
        tables = {"ranges": ranges, "truth": table_of(self.times, self.ids, axes_m(self.positions))}
        return folder_of(name, tables, tags, anchors=self.rig.anchors)


def chamber(anchors: np.ndarray = CHAMBER) -> Rig:
    """A room with anchors (A, 3), m, by default the paper's chamber."""
    return Rig("chamber", anchors={f"A{k + 1}": np.asarray(a, float) for k, a in enumerate(anchors)})


def simulate_ranges(
    rig: Rig,
    path: PathFunction = WALK,
    n: int = 1,
    seed: int = 0,
    *,
    rate_hz: float = 10.0,
    n_points: int = 200,
    protocol: Protocol | None = None,
    corruptions: Mapping[str, Corruption] = MappingProxyType({}),
    ids: Sequence[int] | np.ndarray | None = None,
) -> SimulatedRanges:
    """`n` tags on paths of (keys, times), `n_points` rows of ranges to all anchors of the rig.

    `corruptions`: name -> piece, in order; the name is the piece's random stream. A tag depends on the seed and its id,
    on no other. Raises ValueError for a rig without anchors and for ids that aren't `n`.
    """
    if not rig.anchors:
        raise ValueError("ranges take anchors, this rig has none")
    every = np.arange(n) if ids is None else np.asarray(ids)
    if len(every) != n:
        raise ValueError(f"as many ids as trajectories are needed, n = {n}: found {len(every)}")
    keys = trajectory_keys(seed, every)
    times = np.arange(n_points) / rate_hz
    positions = path(stream(keys, "path"), times)
    distances = np.linalg.norm(positions[:, :, None, :] - np.stack(list(rig.anchors.values())), axis=-1)
    ranges = two_way_ranges(stream(keys, "two-way ranging"), distances, protocol or Protocol())
    ranges, seen = corrupted(corruptions, stream(keys, "corruptions"), times, ranges, np.ones(ranges.shape, bool))
    return SimulatedRanges(times, positions, np.where(seen, ranges, 0.0), seen, rig, every)
