"""Phases at the stations of a rig, as the paper's work station, and angles at stations beside ranges, with truth.

The sign is as in equation (9) of paper A and of the recordings: phase of antenna i = +2 pi / lambda * p_i . u +
common, u the unit vector to the beacon. The common offset of a station's row holds no information and is omitted from
ideal phases.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int

from trackwright.sim.corruptions import Corruption, corrupted, white_noise
from trackwright.sim.keys import Keys, in_dtype, namespace, stream, uniforms
from trackwright.sim.paths import PATHS, WORK_VOLUME, PathFunction
from trackwright.sim.ranging import RangeDraw, SimulatedRanges
from trackwright.sim.tables import AXES, AbstractDraw, ArrayRows, folder_of
from trackwright.trackers.aoa.phases import DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH
from trackwright.trackers.core.model.rig import Rig, Station
from trackwright.trackers.recordings.folder import RecordingFolder

_BELOW_PI = np.nextafter(np.float32(np.pi), np.float32(0))


def wrapped(angle: Float[Any, "*shape"]) -> Float[Any, "*shape"]:
    """The angles wrapped into (-pi, pi], rad."""
    turn = 2 * np.pi
    return angle - turn * namespace(angle).ceil(angle / turn - 0.5)


def spherical_phases(
    stations: Sequence[Station], positions: Float[Any, "*rows 3"]
) -> Float[Any, "*rows stations antennas"]:
    """Phases (..., stations, antennas), rad in (-pi, pi], of spherical waves from beacons at positions (..., 3), m.

    The phase of antenna i is -2 pi / lambda times its distance from the beacon. Raises ValueError for stations without
    an array or with arrays of unequal size.
    """
    antennas, wavelengths = antenna_arrays(stations)
    xp = namespace(positions)
    x, y, z = xp.moveaxis(xp.asarray(positions, float)[..., None, None, :], -1, 0)
    distances = xp.sqrt((x - antennas[..., 0]) ** 2 + (y - antennas[..., 1]) ** 2 + (z - antennas[..., 2]) ** 2)
    return wrapped(distances * (-2 * np.pi / wavelengths[:, None]))


def plane_phases(
    stations: Sequence[Station], positions: Float[Any, "*rows 3"]
) -> Float[Any, "*rows stations antennas"]:
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


@dataclass(frozen=True)
class SimulatedPhases:
    """Phases of n beacons at T times with their truth.

    `times` (T,) s; `positions` (n, T, 3) m, float64; `phases` (n, T, stations, antennas) rad in (-pi, pi], float32,
    zero where not `seen`; stations in the order of `rig.stations`; `ids` (n,): the trajectory ids; `draw`: what drew
    them.
    """

    times: Float[np.ndarray, " T"]
    positions: Float64[np.ndarray, "n T 3"]
    phases: Float32[np.ndarray, "n T stations antennas"]
    seen: Bool[np.ndarray, "n T stations antennas"]
    rig: Rig
    ids: Int[np.ndarray, " n"]
    draw: PhaseDraw

    def folder(self, name: str) -> RecordingFolder:
        """The recording folder: a row of phases per tag, time and station with at least one, and truth in space."""
        heard = self.seen.any(axis=-1)
        tag, row, station = np.nonzero(heard)
        values = self.phases.astype(np.float64).reshape(-1, self.phases.shape[-1])
        if not self.seen.all():
            values[~self.seen.reshape(values.shape)] = np.nan
            values = values[heard.ravel()]
        phases = ArrayRows.of_entries(
            tag,
            self.ids,
            self.times[row],
            {tuple(f"phase_{k + 1}_rad" for k in range(values.shape[1])): values},
            {"station": (station, list(self.rig.stations))},
        )
        tables = {"phases": phases, "truth": ArrayRows.regular(self.times, self.ids, {AXES: self.positions})}
        return folder_of(name, tables, self.ids, self.draw, stations=self.rig.stations)


class PhaseDraw(AbstractDraw):
    """Phases at the stations of a rig: see `simulate_phases`."""

    noise: tuple[tuple[str, Corruption], ...]
    corruptions: tuple[tuple[str, Corruption], ...]
    rig: Rig = eqx.field(static=True)
    path: PathFunction = eqx.field(static=True)
    wave: str = eqx.field(static=True)
    rate_hz: float = eqx.field(static=True)
    n_points: int = eqx.field(static=True)

    measured = MappingProxyType({"phases": "seen"})
    size = 64

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        return np.arange(self.n_points) / self.rate_hz

    def arrays(self, keys: Keys) -> dict[str, Any]:
        times, stations = self.times, list(self.rig.stations.values())
        positions = self.path(stream(keys, "path"), times)
        common = uniforms(stream(keys, "common phase"), (self.n_points, len(stations)))
        values = WAVES[self.wave](stations, positions) + 2 * np.pi * in_dtype(common, positions)[..., None]
        values, seen = corrupted(self.noise, keys, times, values.astype(np.float32), np.ones(values.shape, bool))
        values, seen = corrupted(self.corruptions, stream(keys, "corruptions"), times, values, seen)
        # In float32, pi is rounded up: the clip keeps the values in (-pi, pi].
        values = namespace(values).clip(wrapped(values.astype(float)).astype(np.float32), -_BELOW_PI, _BELOW_PI)
        return {"positions": positions, "phases": values, "seen": seen}

    def world(self, arrays: dict[str, np.ndarray], ids: Int[np.ndarray, " n"]) -> SimulatedPhases:
        phases = np.where(arrays["seen"], arrays["phases"], np.float32(0))
        return SimulatedPhases(self.times, **arrays | {"phases": phases}, rig=self.rig, ids=ids, draw=self)


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
    z = np.asarray(target, float) - position
    x = np.cross(up, z)
    if not np.linalg.norm(x) > 1e-9 * np.linalg.norm(z):
        raise ValueError(f"a station at {position} that faces {target}: up direction {up} is its line of sight")
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    (a, b, c), (d, e, f), (g, h, i) = np.stack([x, np.cross(z, x), z], axis=1)
    # Four times q q': the row with the largest diagonal has no cancellation, even for a station that faces down.
    product = np.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    row = product[np.argmax(np.diag(product))]
    return row / np.linalg.norm(row)


def simulate_phases(
    rig: Rig,
    path: str | PathFunction = "helix",
    n: int | Sequence[int] | np.ndarray = 1,
    seed: int = 0,
    *,
    rate_hz: float = 10.0,
    n_points: int = 200,
    sigma_p: float = 0.1,
    wave: Literal["spherical", "plane"] = "spherical",
    corruptions: Mapping[str, Corruption] = MappingProxyType({}),
) -> SimulatedPhases:
    """Trajectories, `n` or with the ids `n`, of `n_points` rows of phases at all stations of the rig, with truth.

    Phases of a spherical (or plane) wave, a random common offset per row and station, white noise of `sigma_p` rad.
    `corruptions`: by name, which is the random stream, in order. A trajectory depends on the seed and its id alone.
    Raises ValueError for stations without arrays.
    """
    antenna_arrays(list(rig.stations.values()))
    noise = {} if isinstance(sigma_p, float | int) and sigma_p <= 0 else {"phase noise": white_noise(sigma_p)}
    move = PATHS[path] if isinstance(path, str) else path
    how = rig, move, wave, rate_hz, n_points
    return PhaseDraw(tuple(noise.items()), tuple(corruptions.items()), *how).drawn(n, seed)


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
    draw: FusionDraw

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
        rig = measured.rig
        return folder_of(name, tables, self.ids, self.draw, anchors=rig.anchors, stations=rig.stations)


class FusionDraw(AbstractDraw):
    """Ranges, and angles at the stations of their rig: see `simulate_fusion`."""

    ranges: RangeDraw
    corruptions: tuple[tuple[str, Corruption], ...]

    measured = MappingProxyType({"ranges": "heard", "angles": "seen"})
    size = 32

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        return self.ranges.times

    def arrays(self, keys: Keys) -> dict[str, Any]:
        ranged = self.ranges(keys)
        ranged["heard"] = ranged.pop("seen")
        stations, xp = self.ranges.rig.stations.values(), namespace(ranged["positions"])
        angles = xp.concatenate([station.angles(ranged["positions"]) for station in stations], axis=2)
        keys, all_seen = stream(stream(keys, "angles"), "corruptions"), np.ones(angles.shape, bool)
        angles, seen = corrupted(self.corruptions, keys, self.times, angles, all_seen)
        return {**ranged, "angles": angles, "seen": seen}

    def world(self, arrays: dict[str, np.ndarray], ids: Int[np.ndarray, " n"]) -> SimulatedFusion:
        of_ranges = {"positions": arrays["positions"], "ranges": arrays["ranges"], "seen": arrays["heard"]}
        return SimulatedFusion(self.ranges.world(of_ranges, ids), arrays["angles"], arrays["seen"], self)


def simulate_fusion(
    ranges: RangeDraw,
    n: int | Sequence[int] | np.ndarray,
    seed: int,
    corruptions: Mapping[str, Corruption] = MappingProxyType({}),
) -> SimulatedFusion:
    """Trajectories with ranges, and with angles at the stations of their rig.

    `corruptions`: of the angles (n, T, 2·S), rad, by name, which is the random stream, in order.
    """
    return FusionDraw(ranges, tuple(corruptions.items())).drawn(n, seed)
