"""Trajectories and catalogue entries of trackers of phases and bearings: tables `phases` and `bearings`."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from functools import partial

import numpy as np

from trackers.aoa.beam import beam_tracker, in_plane_beam_tracker
from trackers.aoa.cascade import cascade_tracker
from trackers.aoa.das import DelayAndSum
from trackers.aoa.direct import direct_tracker
from trackers.aoa.fusion import BEARINGS, bearing_inputs, bearing_tracker
from trackers.aoa.rays import recent_points
from trackers.core.recording import Readings
from trackers.core.rig import Station
from trackers.core.tracker import AbstractTracker
from trackers.recordings.columns import by_tag, float_column, values_of
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerSpec, on_request
from trackers.recordings.trajectories import Trajectory, known_height, trajectory_of
from trackers.recordings.truth import truth_by_tag

PHASES = "phases"

IN_PLANE = 0.5
"""Largest difference of height, m, between a flat array and a tag that counts as in the array's plane."""


def bearing_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's bearings, one row per table row; inputs `origin`, `axes` of the row's station, and `nearby`."""
    stations = folder.rig.stations
    geometry = {name: bearing_inputs(s) for name, s in stations.items()}
    paths = truth_by_tag(folder)
    for tag, table in by_tag(folder.tables["bearings"]):
        values, seen = values_of(table, ["azimuth_rad", "elevation_rad"])
        # Zeros where no standard deviations are reported, so that trajectories with and without them share a batch.
        std = np.nan_to_num(np.stack([float_column(table, f"{a}_std_rad") for a in ("azimuth", "elevation")], axis=1))
        reported = np.stack([std[:, 0] ** 2, np.zeros(len(std)), std[:, 1] ** 2], axis=1)
        geometries = np.stack([geometry[s] for s in table["station"].to_list()])
        times, height = table["t_s"].to_numpy(), None if free_height else known_height(folder, tag)
        origin, axes = geometries[:, :3], geometries[:, 3:]
        nearby = recent_points(times, origin, axes, values, np.asarray(seen.all(axis=1)), height)
        inputs = {"origin": origin, "axes": axes, "nearby": nearby}
        readings = {BEARINGS: Readings(values, seen, reported)}
        yield trajectory_of(folder, tag, "", times, readings, inputs, paths)


def phase_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's phases at all stations, readings by the stations' ids; one row per time."""
    stations = {name: s for name, s in folder.rig.stations.items() if s.antennas is not None}
    paths = truth_by_tag(folder)
    for tag, table in by_tag(folder.tables["phases"]):
        times, row = _rows(table["t_s"].to_numpy(), table["station"].to_numpy())
        readings = {}
        for name, station in stations.items():
            here = (table["station"] == name).to_numpy()
            values, seen = values_of(table.filter(here), _phase_columns(station))
            all_values, mask = np.zeros((len(times), values.shape[1])), np.zeros((len(times), values.shape[1]), bool)
            all_values[row[here]], mask[row[here]] = values, seen
            readings[name] = Readings(all_values, mask)
        yield trajectory_of(folder, tag, "", times, readings, {}, paths)


def beam_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each pair of a tag and a station: the tag's phases there, readings `phases`, one row per table row."""
    paths = truth_by_tag(folder)
    for tag, table in by_tag(folder.tables["phases"]):
        for (name,), part in table.group_by(["station"], maintain_order=True):
            values, seen = values_of(part, _phase_columns(folder.rig.stations[str(name)]))
            readings = {PHASES: Readings(values, seen)}
            yield trajectory_of(folder, tag, str(name), part["t_s"].to_numpy(), readings, {}, paths)


def _phase_columns(station: Station) -> list[str]:
    assert station.antennas is not None
    return [f"phase_{k + 1}_rad" for k in range(len(station.antennas))]


def _rows(times: np.ndarray, stations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One row per time, and one more for each repeat of a station at that time: times, and the row of each entry."""
    order = np.lexsort((np.arange(len(times)), stations, times))
    repeat = np.zeros(len(times), int)
    same = (np.diff(times[order]) == 0) & (stations[order][1:] == stations[order][:-1])
    for k in np.flatnonzero(same):
        repeat[order[k + 1]] = repeat[order[k]] + 1
    keys, row = np.unique(np.stack([times, repeat], axis=1), axis=0, return_inverse=True)
    return keys[:, 0], row.ravel()


def stations_of(table: str, least: int) -> Callable[[RecordingFolder], str | None]:
    """A function of a folder: what it lacks of a `table` with at least `least` stations, in words, or None."""

    def lacks(folder: RecordingFolder) -> str | None:
        if table not in folder.tables:
            return f"a {table} table with at least {least} station(s), found no such table"
        found = folder.tables[table]["station"].n_unique()
        return None if found >= least else f"a {table} table with at least {least} station(s), found {found} station(s)"

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


def _arrays(trajectory: Trajectory) -> dict[str, Station]:
    return {name: s for name, s in trajectory.folder.rig.stations.items() if name in trajectory.recording.readings}


def _array(station: Station) -> tuple[Hashable, ...]:
    return np.asarray(station.antennas).tobytes(), station.wavelength


def _one_array(trajectory: Trajectory) -> Hashable:
    return _array(_station(trajectory))


def _all_arrays(trajectory: Trajectory) -> Hashable:
    return tuple(
        (name, *_array(s), np.asarray(s.position).tobytes(), np.asarray(s.rotation).tobytes())
        for name, s in _arrays(trajectory).items()
    )


_per_station = partial(
    TrackerSpec,
    table="phases",
    trajectories=beam_trajectories,
    lacks=stations_of("phases", 1),
    geometry=_one_array,
    planar=_in_plane,
    bearing_only=True,
)

TRACKERS = {
    "direct": TrackerSpec(
        about="position from the phases of all stations in one EKF, spherical waves",
        table="phases",
        trajectories=phase_trajectories,
        build=lambda trajectory, planar: direct_tracker(_arrays(trajectory), planar=planar),
        lacks=stations_of("phases", 2),
        geometry=_all_arrays,
    ),
    "cascade": TrackerSpec(
        about="3-D position from phases, a beam tracker per station, then bearings-only fusion (Will et al.)",
        table="phases",
        trajectories=phase_trajectories,
        build=lambda trajectory, planar: cascade_tracker(_arrays(trajectory)),
        lacks=stations_of("phases", 2),
        geometry=_all_arrays,
        planar=lambda trajectory, free_height: False,
        automatic=on_request,
    ),
    "beam": _per_station(about="azimuth and elevation per station from phases, EKF (Will et al.)", build=_beam),
    "das": _per_station(
        about="azimuth and elevation per station from phases, delay-and-sum on each row without a filter",
        build=lambda trajectory, planar: DelayAndSum.of(_station(trajectory), PHASES, planar),
        automatic=on_request,
    ),
    "bearings": TrackerSpec(
        about="position from azimuths and elevations of any number of stations, EKF",
        table="bearings",
        trajectories=bearing_trajectories,
        build=lambda trajectory, planar: bearing_tracker(planar=planar),
        lacks=stations_of("bearings", 1),
    ),
}
