"""The trackers that the command line knows: their names, what they need, how they are built for a recording."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.errors import UnusableInput
from experiments.folder import Folder
from experiments.lanes import PHASES, Lane, beam_lanes, bearing_lanes, known_height, phase_lanes
from trackers.aoa.beam import beam_tracker, in_plane_beam_tracker
from trackers.aoa.cascade import cascade_tracker
from trackers.aoa.das import DelayAndSum
from trackers.aoa.direct import direct_tracker
from trackers.aoa.fusion import bearing_tracker
from trackers.core.rig import Station
from trackers.core.tracker import AbstractTracker

IN_PLANE = 0.5
"""Metres between the heights of a flat array and a tag up to which the tag counts as being in the array's plane."""


@dataclass(frozen=True)
class Group:
    """Lanes that one tracker runs as a batch; `planar`: in the floor plane at known heights, or in an array's plane."""

    tracker: AbstractTracker
    lanes: list[Lane]
    planar: bool


@dataclass(frozen=True)
class Entry:
    """A tracker by name: the table it reads, how many stations it needs, and what it is in one line."""

    table: str
    stations: int
    about: str
    bearing_only: bool
    lanes: Callable[[Folder, bool], Iterator[Lane]]
    build: Callable[[Lane, bool], AbstractTracker]


def _in_plane(lane: Lane) -> bool:
    """Whether a flat array hears a tag at its own height: there azimuth and elevation are singular."""
    station, height = lane.folder.rig.stations[lane.station], known_height(lane.folder, lane.tag)
    upright = abs(station.world_from_array()[2, 2]) > 0.99
    return upright and height is not None and abs(height - station.position[2]) < IN_PLANE


def _station(lane: Lane) -> Station:
    return lane.folder.rig.stations[lane.station]


def _beam(lane: Lane, planar: bool) -> AbstractTracker:
    return in_plane_beam_tracker(_station(lane), PHASES) if planar else beam_tracker(_station(lane), PHASES)


TRACKERS = {
    "direct": Entry(
        "phases", 2, "3-D position straight from all stations' phases, spherical waves", False, phase_lanes,
        lambda lane, planar: direct_tracker(_arrays(lane), planar=planar),
    ),
    "cascade": Entry(
        "phases", 2, "3-D position: a beam tracker per station, then fusion (the paper's)", False, phase_lanes,
        lambda lane, planar: cascade_tracker(_arrays(lane)),
    ),
    "beam": Entry("phases", 1, "azimuth and elevation per station, EKF on phases", True, beam_lanes, _beam),
    "das": Entry(
        "phases", 1, "azimuth and elevation per station, delay-and-sum on each row: the baseline", True, beam_lanes,
        lambda lane, planar: DelayAndSum.of(_station(lane), PHASES, planar),
    ),
    "bearings": Entry(
        "bearings", 1, "position from azimuths and elevations of any number of stations", False, bearing_lanes,
        lambda lane, planar: bearing_tracker(planar=planar),
    ),
}  # fmt: skip


def _arrays(lane: Lane) -> dict[str, Station]:
    return {name: s for name, s in lane.folder.rig.stations.items() if name in lane.recording.readings}


def fitting(folder: Folder) -> str:
    """The name of the tracker that fits the folder's tables; raises UnusableInput where none does."""
    for name, entry in TRACKERS.items():
        if name != "cascade" and _usable(entry, folder):
            return name
    needs = ", ".join(sorted({e.table for e in TRACKERS.values()}))
    raise UnusableInput(
        f"{folder.path}: tables {', '.join(folder.tables)}: no tracker fits; expected one of {needs} "
        "with the stations in rig.toml; see `trackwright track --help`"
    )


def _usable(entry: Entry, folder: Folder) -> bool:
    if entry.table not in folder.tables:
        return False
    return folder.tables[entry.table]["station"].n_unique() >= entry.stations


def groups(folders: Sequence[Folder], name: str, free_height: bool) -> list[Group]:
    """The lanes of all folders for the named tracker, batched where one tracker serves them; raises UnusableInput."""
    entry = TRACKERS.get(name)
    if entry is None:
        raise UnusableInput(f"--tracker {name}: unknown; expected one of {', '.join(TRACKERS)}")
    batches: dict[Any, list[Lane]] = defaultdict(list)
    for folder in folders:
        if not _usable(entry, folder):
            found = "no such table"
            if entry.table in folder.tables:
                found = f"{folder.tables[entry.table]['station'].n_unique()} station(s)"
            raise UnusableInput(
                f"{folder.path}: tracker '{name}' needs a {entry.table} table with at least {entry.stations} "
                f"station(s), found {found}; its tables: {', '.join(folder.tables)}"
            )
        for lane in entry.lanes(folder, free_height):
            planar = _planar(entry, name, lane, free_height)
            batches[(planar, *_geometry(entry, lane))].append(lane)
    return [Group(entry.build(lanes[0], key[0]), lanes, key[0]) for key, lanes in batches.items()]


def _planar(entry: Entry, name: str, lane: Lane, free_height: bool) -> bool:
    if entry.bearing_only:
        return _in_plane(lane)
    return name != "cascade" and not free_height and known_height(lane.folder, lane.tag) is not None


def _geometry(entry: Entry, lane: Lane) -> tuple[Any, ...]:
    """What of the rig is part of the tracker: lanes that agree in it share one."""
    if entry.table == "bearings":
        return ()
    stations = [_station(lane)] if entry.bearing_only else list(_arrays(lane).values())
    names = [] if entry.bearing_only else list(_arrays(lane))
    parts: list[Any] = [tuple(names)]
    for s in stations:
        assert s.antennas is not None
        parts.append((np.asarray(s.antennas).tobytes(), s.wavelength))
        if not entry.bearing_only:
            parts.append((np.asarray(s.position).tobytes(), np.asarray(s.rotation).tobytes()))
    return tuple(parts)
