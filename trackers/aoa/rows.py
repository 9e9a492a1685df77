"""Trajectories of trackers of phases and bearings, and how each is built: tables `phases` and `bearings`."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from functools import partial

import numpy as np

from trackwright.trackers.aoa.beam import PHASES, DelayAndSum, beam_tracker, in_plane_beam_tracker
from trackwright.trackers.aoa.cascade import cascade_tracker
from trackwright.trackers.aoa.direct import direct_tracker
from trackwright.trackers.aoa.fusion import BEARINGS, CALIBRATED, CALIBRATION, bearing_inputs, bearing_tracker
from trackwright.trackers.aoa.mapped_bearings import mapped_bearing_tracker
from trackwright.trackers.aoa.rays import RayPlaces, recent_points
from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.core.model.rig import Station, room_rows
from trackwright.trackers.core.run.track_loss import ROOM
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.calibration import floor_grid
from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import TrackerSpec
from trackwright.trackers.recordings.tracks import (
    Trajectories,
    Trajectory,
    known_height,
    known_heights,
    trajectories_of,
)

REPEATED, AVERAGE_S = 0.5, 0.5
"""Share of repeated bearings above which they are averaged, over this interval, s: their errors last longer still."""

IN_PLANE = 0.5  # largest difference of height, m, between a flat array and a tag in its plane


def bearing_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's bearings, one row per table row; inputs `origin`, `axes` of the row's station, `nearby`, and `room`.

    Where the folder has a calibration, the input `calibration` of the row's station, and the variance that it adds.
    """
    interval = AVERAGE_S if folder.streams("bearings").repeated_share > REPEATED else 0.0
    rows, stations = folder.rows("bearings", interval), folder.rig.stations
    values, seen = rows.values(["azimuth_rad", "elevation_rad"])
    # Zeros where no standard deviations are reported, so that trajectories with and without them share a batch.
    variances = rows.variances(["azimuth_std_rad", "elevation_std_rad"])
    reported = np.stack([variances[:, 0], np.zeros(len(values)), variances[:, 1]], axis=1)
    number = rows.codes("station", list(stations))
    geometries = np.stack([bearing_inputs(s) for s in stations.values()])[number]
    heights = np.full(len(rows.tags), np.nan) if free_height else known_heights(folder, rows.tags)
    origin, axes = geometries[:, :3], geometries[:, 3:]
    inputs, directions = {"origin": origin, "axes": axes, "station": number.astype(float)}, values
    if folder.calibration is not None:
        inputs["calibration"], directions, added = folder.calibration.of_bearings(list(stations), number, values)
        reported[:, ::2] += added
    inputs[ROOM.name] = room_rows(np.stack([s.position for s in stations.values()]), folder.rig.outline, len(values))
    inputs["nearby"] = recent_points(rows.starts, rows.times, origin, axes, directions, seen, heights)
    readings = {BEARINGS: Readings(values, seen, reported)}
    return trajectories_of(folder, rows.tags, rows.starts, rows.times, readings, inputs)


def bearing_places(trajectories: Trajectories, planar: bool) -> RayPlaces:
    """How the input `nearby` of one tag's rows follows from its bearings; `planar`: at the known height."""
    rows, height = trajectories.columns, float(trajectories.heights[0]) if planar else None
    return RayPlaces.of(rows.times, rows.inputs["origin"], rows.inputs["axes"], height)


def phase_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's phases at all stations, readings by the stations' ids; one row per time."""
    rows = folder.rows("phases")
    names = list(folder.rig.stations)
    station = rows.codes("station", names)
    row, starts, times = _shared_rows(rows, station)
    phases, mask = rows.values(_phase_columns(max(folder.rig.stations.values(), key=_antennas)))
    readings = {}
    for name, rig_station in folder.rig.stations.items():
        if rig_station.antennas is None:
            continue
        here, count = np.flatnonzero(station == names.index(name)), len(rig_station.antennas)
        values, seen = given = phases[here, :count], mask[here, :count]
        if len(here) < len(times):
            values, seen = (np.zeros((len(times), count), x.dtype) for x in given)
            values[row[here]], seen[row[here]] = given
        readings[name] = Readings(values, seen)
    return trajectories_of(folder, rows.tags, starts, times, readings, {})


def beam_trajectories(folder: RecordingFolder, free_height: bool) -> Iterable[Trajectory]:
    """Each pair of a tag and a station: the tag's phases there, readings `phases`, one row per table row."""
    rows = folder.rows("phases")
    names = list(folder.rig.stations)
    pair = rows.of_each(np.arange(len(rows.tags))) * len(names) + rows.codes("station", names)
    # Pairs by tag, and of a tag in the order in which its stations first appear.
    pairs, first, which = np.unique(pair, return_index=True, return_inverse=True)
    by_appearance = np.argsort(first)
    rank = np.argsort(by_appearance)
    order = np.argsort(rank[which], kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(rank[which], minlength=len(pairs)))])
    tag, station = np.divmod(pairs[by_appearance], len(names))
    values, seen = rows.values(_phase_columns(max(folder.rig.stations.values(), key=_antennas)))
    readings = {PHASES: Readings(values[order], seen[order])}
    tags, stations = [rows.tags[k] for k in tag], [names[k] for k in station]
    trajectories = trajectories_of(folder, tags, starts, rows.times[order], readings, {}, stations)
    sizes = np.array([_antennas(s) for s in folder.rig.stations.values()])[station]
    return trajectories if len(set(sizes.tolist())) <= 1 else _of_several_sizes(trajectories, sizes)


def _of_several_sizes(trajectories: Trajectories, sizes: np.ndarray) -> list[Trajectory]:
    """The trajectories with as many channels as their stations have antennas, `sizes` (n,)."""
    by_number: dict[int, Trajectory] = {}
    for size in set(sizes.tolist()):
        numbers = np.flatnonzero(sizes == size)
        part = trajectories.chosen(numbers)
        phases = part.columns.readings[PHASES]
        cut = part.replaced({PHASES: Readings(phases.values[:, :size], phases.seen[:, :size])})
        by_number |= dict(zip(numbers.tolist(), cut, strict=True))
    return [by_number[number] for number in range(len(sizes))]


def _antennas(station: Station) -> int:
    return 0 if station.antennas is None else len(station.antennas)


def _phase_columns(station: Station) -> list[str]:
    assert station.antennas is not None
    return [f"phase_{k + 1}_rad" for k in range(len(station.antennas))]


def _shared_rows(rows: TagRows, station: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One row per tag and time, and one more for each repeat of a station (N,) there: the row of each entry (N,).

    Also the first row of each tag, then their number, and the times of the rows.
    """
    new = np.append(True, np.diff(rows.times) != 0)
    new[rows.starts[:-1]] = True
    group = np.cumsum(new) - 1
    if np.bincount(group * (station.max() + 1) + station).max() == 1:
        return group, np.append(group[rows.starts[:-1]], group[-1] + 1), rows.times[new]
    order, run, repeat = np.lexsort((station, group)), np.arange(len(group)), np.empty(len(group), int)
    same = np.append(False, (np.diff(group[order]) == 0) & (np.diff(station[order]) == 0))
    repeat[order] = run - np.maximum.accumulate(np.where(same, 0, run))
    most = int(repeat.max(initial=0)) + 1
    keys, first, row = np.unique(group * most + repeat, return_index=True, return_inverse=True)
    starts = np.append(np.searchsorted(keys, group[rows.starts[:-1]] * most), len(keys))
    return row, starts, rows.times[first]


def stations_of(table: str, least: int) -> Callable[[RecordingFolder], str | None]:
    """A function of a folder: what it lacks of a `table` with at least `least` stations, in words, or None."""

    def lacks(folder: RecordingFolder) -> str | None:
        if table not in folder.tables:
            return f"a {table} table with at least {least} station(s), found no such table"
        count = len(np.unique(folder.rows(table).codes("station", list(folder.rig.stations))))
        return None if count >= least else f"a {table} table with at least {least} station(s), found {count} station(s)"

    return lacks


def _in_plane(trajectory: Trajectory, free_height: bool) -> bool:
    """Whether an upright array and a tag are at one height: there azimuth and elevation are singular."""
    station, height = _station(trajectory), known_height(trajectory.folder, trajectory.tag)
    upright = abs(station.world_from_array()[2, 2]) > 0.99
    return upright and height is not None and abs(height - station.position[2]) < IN_PLANE


def _station(trajectory: Trajectory) -> Station:
    return trajectory.folder.rig.stations[trajectory.station]


def _beam(trajectory: Trajectory, planar: bool) -> AbstractTracker:
    return in_plane_beam_tracker(_station(trajectory), PHASES) if planar else beam_tracker(_station(trajectory), PHASES)


def _calibrated(trajectory: Trajectory) -> bool:
    return CALIBRATION.name in trajectory.recording.inputs


def _map_of(folder: RecordingFolder) -> Mapping[str, np.ndarray]:
    return {} if folder.calibration is None else folder.calibration.bearing_map


def _map_key(folder: RecordingFolder) -> Hashable:
    """What tells the map of a folder from others, and from none."""
    by_place = _map_of(folder)
    visits = [by_place[name].tobytes() if name in by_place else b"" for name in folder.rig.stations]
    return (tuple(visits), folder.origin) if by_place else ()


def _without_map(folder: RecordingFolder, free_height: bool) -> list[str]:
    """A line where tags of unknown height are tracked without the map of the calibration."""
    if not _map_of(folder) or not (free_height or np.isnan(known_heights(folder, folder.rows("bearings").tags)).any()):
        return []
    text = "the calibration's map of errors over the floor is not used for tags whose height is estimated"
    return [f"{folder.path or folder.name}: bearings: {text}; give their height_m in rig.toml"]


def _bearings(trajectory: Trajectory, planar: bool) -> AbstractTracker:
    folder = trajectory.folder
    names, by_place = [*folder.rig.stations], _map_of(folder)
    if planar and by_place:
        return mapped_bearing_tracker(len(names), floor_grid(by_place, names, folder.origin))
    return bearing_tracker(len(names), planar, **(CALIBRATED if _calibrated(trajectory) else {}))


def _arrays(trajectory: Trajectory) -> dict[str, Station]:
    return {name: s for name, s in trajectory.folder.rig.stations.items() if name in trajectory.recording.readings}


def _array(station: Station) -> tuple[Hashable, ...]:
    return np.asarray(station.antennas).tobytes(), station.wavelength


def _all_arrays(trajectory: Trajectory) -> Hashable:
    return tuple(
        (name, *_array(s), np.asarray(s.position).tobytes(), np.asarray(s.rotation).tobytes())
        for name, s in _arrays(trajectory).items()
    )


_per_station = partial(
    TrackerSpec,
    trajectories=beam_trajectories,
    lacks=stations_of("phases", 1),
    geometry=lambda trajectory: _array(_station(trajectory)),
    planar=_in_plane,
    bearing_only=True,
)

TRACKERS: Mapping[str, Callable[..., TrackerSpec]] = {
    "direct": partial(
        TrackerSpec,
        trajectories=phase_trajectories,
        build=lambda trajectory, planar: direct_tracker(_arrays(trajectory), planar=planar),
        lacks=stations_of("phases", 2),
        geometry=_all_arrays,
    ),
    "cascade": partial(
        TrackerSpec,
        trajectories=phase_trajectories,
        build=lambda trajectory, planar: cascade_tracker(_arrays(trajectory)),
        lacks=stations_of("phases", 2),
        geometry=_all_arrays,
        planar=lambda trajectory, free_height: False,
    ),
    "beam": partial(_per_station, build=_beam),
    "das": partial(_per_station, build=lambda trajectory, planar: DelayAndSum.of(_station(trajectory), PHASES, planar)),
    "bearings": partial(
        TrackerSpec,
        trajectories=bearing_trajectories,
        build=_bearings,
        lacks=stations_of("bearings", 1),
        geometry=lambda of: (len(of.folder.rig.stations), _calibrated(of), _map_key(of.folder)),
        notices=_without_map,
        every_row=(BEARINGS,),
        places=bearing_places,
    ),
}
"""How each tracker is built; `trackers.catalogue` has its table and its line in lists."""
