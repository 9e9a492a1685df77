"""Range differences between tags and anchors with synchronised clocks (TDoA), of times of arrival with their errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.sim.corruptions import Corruption, Times, corrupted
from trackwright.sim.keys import Keys, in_blocks, stream, trajectory_ids, trajectory_keys
from trackwright.sim.paths import PathFunction
from trackwright.sim.ranging import WALK, Ranges, distances_to
from trackwright.sim.tables import AXES, ArrayRows, folder_of
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder

CORNERS = np.array([[x, y, z] for z in (0.3, 2.5) for x, y in ((0.0, 0.0), (5.0, 0.0), (5.0, 5.0), (0.0, 5.0))])
"""Eight anchors, m, in the corners of the chamber of the ranges, near the floor and below the ceiling."""

Schedule = Literal["messages", "turns"]
"""`messages`: at each time the differences of all anchors heard from the first of them; `turns`: at each time one
difference, of two neighbouring anchors in turn."""


@dataclass(frozen=True)
class SimulatedDifferences:
    """Times of arrival at n tags at T times, as distances, with their truth, and the differences that are reported.

    `times` (T,) s; `positions` (n, T, 3) m; `arrivals` (n, T, A) m, up to an offset common to the anchors of a time, in
    the order of `rig.anchors`, where `heard`; `ids` (n,): the trajectory ids.
    """

    table: ClassVar[str] = "tdoa"

    times: Times
    positions: Float[np.ndarray, "n T 3"]
    arrivals: Ranges
    heard: Bool[np.ndarray, "n T anchors"]
    rig: Rig
    ids: Int[np.ndarray, " n"]
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
        return folder_of(name, tables, self.ids, anchors=self.rig.anchors)


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

    `corruptions`: of the times of arrival (n, T, anchors), m, by name, which is the random stream, in order: the noise
    of an arrival is in all differences with its anchor. A trajectory depends on the seed and its id alone. Raises
    ValueError for a rig with fewer than two anchors.
    """
    if len(rig.anchors) < 2:
        raise ValueError(f"range differences need two anchors, found {len(rig.anchors)}")
    ids = trajectory_ids(n)
    times = np.arange(n_points) / rate_hz
    anchors = np.stack(list(rig.anchors.values()))

    def arrived(keys: Keys) -> tuple[np.ndarray, ...]:
        positions = path(stream(keys, "path"), times)
        arrivals = distances_to(anchors, positions)
        heard = np.ones(arrivals.shape, bool)
        return positions, *corrupted(corruptions, stream(keys, "corruptions"), times, arrivals, heard)

    positions, arrivals, heard = in_blocks(arrived, trajectory_keys(seed, ids), size=32)
    return SimulatedDifferences(times, positions, arrivals, heard, rig, ids, schedule)
