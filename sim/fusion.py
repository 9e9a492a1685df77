"""Ranges to anchors and angles at stations of one room, at the same times, with truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.sim.corruptions import Corruption, corrupted
from trackwright.sim.keys import Keys, in_blocks, stream, trajectory_keys
from trackwright.sim.ranging import SimulatedRanges
from trackwright.sim.stations import facing
from trackwright.sim.tables import AXES, ArrayRows, folder_of
from trackwright.trackers.core.model.rig import Rig, Station
from trackwright.trackers.recordings.folder import RecordingFolder


def with_stations(rig: Rig, centre: Float[np.ndarray, " 3"], count: int) -> Rig:
    """The rig with stations at its first `count` anchors, by their names, that face `centre`, m."""
    places = list(rig.anchors.items())[:count]
    return replace(rig, stations={name: Station(p, facing(p, centre, (0.0, 0.0, 1.0))) for name, p in places})


@dataclass(frozen=True)
class SimulatedFusion:
    """Ranges of n tags at T times, and azimuth and elevation at S stations of the same rig.

    `angles` (n, T, 2·S) rad, of each station in the order of `rig.stations`, where `seen`.
    """

    ranges: SimulatedRanges
    angles: Float[np.ndarray, "n T angles"]
    seen: Bool[np.ndarray, "n T angles"]

    @property
    def ids(self) -> Int[np.ndarray, " n"]:
        """The trajectory ids."""
        return self.ranges.ids

    def rows(self) -> ArrayRows:
        """A row per azimuth and elevation of a station."""
        tag, row, station = np.nonzero(self.seen[..., ::2])
        values = np.stack([self.angles[tag, row, 2 * station + k] for k in range(2)], axis=1)
        return ArrayRows.of_entries(
            tag,
            self.ids,
            self.ranges.times[row],
            {("azimuth_rad", "elevation_rad"): values.astype(float)},
            {"station": (station, list(self.ranges.rig.stations))},
        )

    def folder(self, name: str) -> RecordingFolder:
        """The recording folder: a row per range and per pair of angles, and truth in space."""
        measured = self.ranges
        truth = ArrayRows.regular(measured.times, self.ids, {AXES: measured.positions})
        tables = {"ranges": measured.rows(), "bearings": self.rows(), "truth": truth}
        return folder_of(name, tables, self.ids, anchors=measured.rig.anchors, stations=measured.rig.stations)


def simulate_fusion(
    ranges: SimulatedRanges, seed: int, corruptions: Mapping[str, Corruption] = MappingProxyType({})
) -> SimulatedFusion:
    """The ranges with the angles at the stations of their rig; `seed`: that of the ranges.

    `corruptions`: of the angles (n, T, 2·S), rad, by name, which is the random stream, in order.
    """
    stations = list(ranges.rig.stations.values())

    def measured(keys: Keys, positions: np.ndarray) -> tuple[np.ndarray, ...]:
        angles = np.concatenate([station.angles(positions) for station in stations], axis=2)
        keys = stream(stream(keys, "angles"), "corruptions")
        return corrupted(corruptions, keys, ranges.times, angles, np.ones(angles.shape, bool))

    angles, seen = in_blocks(measured, trajectory_keys(seed, ranges.ids), ranges.positions, size=32)
    return SimulatedFusion(ranges, angles, seen)
