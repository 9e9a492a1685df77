"""Phases at the stations of a rig, as the paper's work station, and angles at stations beside ranges, with truth.

The sign is as in equation (9) of paper A and of the recordings: phase of antenna i = +2 pi / lambda * p_i . u +
common, u the unit vector to the beacon. The common offset of a station's row holds no information and is omitted from
ideal phases.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from trackwright.sim.corruptions import Corruption, corrupted
from trackwright.sim.keys import Keys, in_dtype, namespace, normals, stream, uniforms
from trackwright.sim.paths import WORK_VOLUME, PathFunction
from trackwright.sim.ranging import RangeDraw
from trackwright.sim.tables import AbstractDraw, AbstractRigDraw, ArrayRows, SimulatedWorld, by_name, static
from trackwright.trackers.aoa.phases import DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH
from trackwright.trackers.core.model.rig import Rig, Station
from trackwright.trackers.recordings.folder import RecordingFolder

Phases = Float[Any, "*rows stations antennas"]

_BELOW_PI = np.nextafter(np.float32(np.pi), np.float32(0))


def wrapped(angle: Float[Any, "*shape"]) -> Float[Any, "*shape"]:
    """The angles wrapped into (-pi, pi], rad."""
    turn = 2 * np.pi
    return angle - turn * namespace(angle).ceil(angle / turn - 0.5)


def spherical_phases(stations: Sequence[Station], positions: Float[Any, "*rows 3"]) -> Phases:
    """Phases (..., stations, antennas), rad in (-pi, pi], of spherical waves from beacons at positions (..., 3), m.

    The phase of antenna i is -2 pi / lambda times its distance from the beacon. Raises ValueError for stations without
    an array or with arrays of unequal size.
    """
    antennas, wavelengths = antenna_arrays(stations)
    xp = namespace(positions)
    x, y, z = xp.moveaxis(xp.asarray(positions, float)[..., None, None, :], -1, 0)
    distances = xp.sqrt((x - antennas[..., 0]) ** 2 + (y - antennas[..., 1]) ** 2 + (z - antennas[..., 2]) ** 2)
    return wrapped(distances * (-2 * np.pi / wavelengths[:, None]))


def plane_phases(stations: Sequence[Station], positions: Float[Any, "*rows 3"]) -> Phases:
    """Phases (..., stations, antennas) of plane waves, equation (9): 2 pi / lambda * p_i . u.

    An approximation for distant beacons; for worlds in which a tracker's model is exact. Shapes, units and errors as in
    `spherical_phases`.
    """
    antenna_arrays(stations)
    columns, xp = [], namespace(positions)
    for station in stations:
        x, y, z = xp.moveaxis(station.position_in_array(positions), -1, 0)
        wave_number = 2 * np.pi / (station.wavelength * xp.sqrt(x**2 + y**2 + z**2))
        flat = np.asarray(station.antennas)
        columns.append((wave_number * x)[..., None] * flat[:, 0] + (wave_number * y)[..., None] * flat[:, 1])
    return wrapped(xp.stack(columns, axis=-2))


def antenna_arrays(
    stations: Sequence[Station],
) -> tuple[Float[np.ndarray, "stations antennas 3"], Float[np.ndarray, " stations"]]:
    """Antenna positions (stations, antennas, 3), m, world frame, and wavelengths (stations,), m.

    Raises ValueError for no station, for stations without an array or wavelength, and for arrays of unequal size.
    """
    arrays = [station.antennas is not None and station.wavelength is not None for station in stations]
    if not all(arrays) or len({len(station.antenna_positions()) for station in stations}) != 1:
        raise ValueError("phases need one or more stations with a wavelength and equal numbers of antennas")
    antennas = np.stack([station.antenna_positions() for station in stations])
    return antennas, np.array([station.wavelength for station in stations], float)


WAVES = MappingProxyType({"spherical": spherical_phases, "plane": plane_phases})


class PhaseDraw(AbstractRigDraw):
    """Phases at all stations of the rig along a path, at `n_points` times: of a spherical (or plane) wave.

    Each row of a station has a random common offset, each phase white noise of `sigma_p` rad. `path`: a name of `PATHS`
    or a function. `corruptions`: by name, in order. Its arrays: `positions` (n, T, 3) m, float64; `phases` (n, T,
    stations, antennas) rad in (-pi, pi], float32, where `seen`, stations in the order of the rig. Raises ValueError for
    stations without arrays.
    """

    path: str | PathFunction = static(default="helix")
    sigma_p: float = 0.1
    wave: Literal["spherical", "plane"] = static(default="spherical")

    measured = MappingProxyType({"phases": "seen"})
    size = 64

    def __check_init__(self) -> None:
        antenna_arrays(list(self.rig.stations.values()))

    def arrays(self, keys: Keys) -> dict[str, Any]:
        times, stations = self.times, list(self.rig.stations.values())
        positions = self.positions(keys, times)
        common = uniforms(stream(keys, "common phase"), (self.n_points, len(stations)))
        values = WAVES[self.wave](stations, positions) + 2 * np.pi * in_dtype(common, positions)[..., None]
        values = values.astype(np.float32)
        values = values + in_dtype(self.sigma_p * normals(stream(keys, "phase noise"), values.shape[1:]), values)
        values, seen = corrupted(self.corruptions, stream(keys, "corruptions"), times, values)
        # In float32, pi is rounded up: the clip keeps the values in (-pi, pi].
        values = namespace(values).clip(wrapped(values.astype(float)).astype(np.float32), -_BELOW_PI, _BELOW_PI)
        return {"positions": positions, "phases": values, "seen": seen}

    def rows(self, world: SimulatedWorld) -> dict[str, ArrayRows]:
        """A row per tag, time and station with at least one phase."""
        values = np.where(world.seen, world.arrays["phases"].astype(np.float64), np.nan)
        columns = {tuple(f"phase_{k + 1}_rad" for k in range(values.shape[-1])): values}
        stations = {"station": (np.arange(len(self.rig.stations)), [*self.rig.stations])}
        return {"phases": ArrayRows(world.times, world.ids, columns, world.seen.any(axis=-1), stations)}


def work_station(antennas: Float[np.ndarray, "n 2"] | None = None, radius: float = 0.4) -> Rig:
    """The paper's work stand: three stations 1 m above the work volume, at `radius` m from its vertical axis.

    Each faces the centre of the volume, all of which lies within 29 degrees of its boresight (at 0.4 m); the x axis of
    its array is horizontal, along the world's -x. `antennas` (n, 2), m: another array than the default one, whose
    layout is fitted (`experiments/lab/papers/will_2020/_work_stand.py`). The paper prints no
    station positions; these are chosen.
    """
    layout = DEFAULT_ANTENNAS if antennas is None else np.asarray(antennas, float)
    lower, upper = WORK_VOLUME
    stations = {}
    for number, angle in enumerate(np.deg2rad([90.0, 210.0, 330.0]), start=1):
        position = np.array([radius * np.cos(angle), radius * np.sin(angle), upper[2] + 1.0])
        rotation = facing(position, (lower + upper) / 2)
        stations[str(number)] = Station(position, rotation, layout, DEFAULT_WAVELENGTH)
    return Rig(name="work-station", stations=stations)


def facing(
    position: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"], up: Sequence[float] = (0.0, 1.0, 0.0)
) -> Float[np.ndarray, " 4"]:
    """The quaternion w, x, y, z (4,), array frame -> world frame, of a station whose boresight points at `target`.

    The array's y axis is as close as possible to `up`, a direction in the world. Raises ValueError where `up` is the
    line of sight.
    """
    from scipy.spatial.transform import Rotation

    z = np.asarray(target, float) - position
    x = np.cross(up, z)
    if not np.linalg.norm(x) > 1e-9 * np.linalg.norm(z):
        raise ValueError(f"a station at {position} that faces {target}: up direction {up} is its line of sight")
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return np.asarray(Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1)).as_quat(scalar_first=True))


def with_stations(rig: Rig, centre: Float[np.ndarray, " 3"], count: int) -> Rig:
    """The rig with stations at its first `count` anchors, by their names, that face `centre`, m."""
    places = list(rig.anchors.items())[:count]
    return replace(rig, stations={name: Station(p, facing(p, centre, (0.0, 0.0, 1.0))) for name, p in places})


class FusionDraw(AbstractDraw):
    """Ranges, and azimuth and elevation at the stations of the same rig.

    `of_angles`: corruptions of the angles by name, in order. Its arrays: those of the ranges; `angles` (n, T, stations,
    2) rad, azimuth and elevation of each station in the order of the rig, where `heard` (n, T, stations).
    """

    ranges: RangeDraw
    of_angles: Mapping[str, Corruption] = by_name(default_factory=dict)

    measured = MappingProxyType({"ranges": "seen", "angles": "heard"})
    size = 32

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        return self.ranges.times

    def arrays(self, keys: Keys) -> dict[str, Any]:
        ranged, stations = self.ranges(keys), self.ranges.rig.stations.values()
        xp = namespace(ranged["positions"])
        angles = xp.concatenate([station.angles(ranged["positions"]) for station in stations], axis=2)
        angles, heard = corrupted(self.of_angles, stream(stream(keys, "angles"), "corruptions"), self.times, angles)
        heard = heard[..., ::2]  # a station hears both angles or none
        return {**ranged, "angles": angles.reshape(*heard.shape, 2), "heard": heard}

    def folder(self, world: SimulatedWorld) -> RecordingFolder:
        """A row per range and per pair of angles, and truth in space."""
        names, columns = [*self.ranges.rig.stations], {("azimuth_rad", "elevation_rad"): world.arrays["angles"]}
        stations = {"station": (np.arange(len(names)), names)}
        return self.ranges.folder(world, bearings=ArrayRows(world.times, world.ids, columns, world.heard, stations))
