"""The kinds of measurement: the columns of each table, what true positions predict for them, how large errors are.

Reading, checks, averages, calibration, import and the residuals on a page loop over `KINDS`. A user's kind joins them
by `add_kind`; docs/extending.md has one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count, takewhile
from typing import Literal, NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.errors import UnusableInput, seconds
from trackwright.trackers.core.model.rig import Point, Rig, angles_in_array
from trackwright.trackers.recordings.columns import QUATERNION, TagRows, stable_order, within_groups

MANY_REPEATS = 0.2  # share of readings that equal the one before from which a source may repeat them
MOST_ROWS = 100_000  # of a table whose streams are looked at
UNITS = {"m": "m", "rad": "rad", "mps": "m/s", "mps2": "m/s²", "radps": "rad/s", "dbm": "dBm", "hz": "Hz", "pa": "Pa"}
_NAME = re.compile(rf"[a-z][a-z0-9_]*_({'|'.join(UNITS)})")


class Sensors(NamedTuple):
    """The k sensors of each of N readings: `number` (N, k) of G, whose `axes` take array-frame vectors to the world.

    Of stations with phases also `antennas`, m, NaN for those that one lacks, and `wavelengths`, m.
    """

    number: Int[np.ndarray, "N k"]
    places: Float[np.ndarray, "G 3"]
    axes: Float[np.ndarray, "G 3 3"]
    antennas: Float[np.ndarray, "G m 2"]
    wavelengths: Float[np.ndarray, " G"]

    def distances(self, positions: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N k"]:
        """Distances of positions, m, from the sensors of each reading."""
        x, y, z = (positions.T[..., None] - self.places.T.take(self.number, axis=1)) ** 2
        return np.sqrt(x + y + z)

    def in_array(self, positions: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3 N"]:
        """Coordinates of positions, m, in the array frame of each reading's first sensor."""
        first = self.number[:, 0]
        return np.einsum("ni,nij->jn", positions - self.places[first], self.axes[first])


class Column(NamedTuple):
    """A column whose name ends with its unit. `bound`: largest usual size; `positive`: zero and below is no reading.

    Errors up to `bias` are a sensor's own, up to `large` need no explanation, below `floor` are not told apart.
    """

    name: str
    bias: float = 0.0
    large: float = math.inf
    floor: float = 0.0
    bound: float = math.pi
    positive: bool = False

    @property
    def unit(self) -> str:
        """The ending of its name."""
        return self.name.rpartition("_")[2]


class Layout(NamedTuple):
    """The columns of a table: ids, values, optional ones, and signal quality, which have any other name."""

    ids: tuple[str, ...]
    values: tuple[str, ...]
    optional: tuple[str, ...]
    quality: tuple[str, ...]


@dataclass(frozen=True)
class Kind:
    """A table of recordings, and the values that true positions and the rig predict.

    `columns`: with values; `numbered`: its one column, with `{n}`, is repeated from 1. `sensors`: columns with ids.
    `predicted(positions, sensors)`: values (N, m) at positions (N, 3), m, or None. `averaged`: a mean over
    tenths of a second is a reading again. `common`: a row has an unknown offset. `attitude`: it may have a quaternion.
    `difference`: values are a distance to one anchor less one to another. `calibrated`: its part of a calibration.
    """

    name: str
    columns: tuple[Column, ...]
    sensors: tuple[str, ...] = ()
    predicted: Callable[[np.ndarray, Sensors], np.ndarray] | None = None
    averaged: bool = False
    common: bool = False
    numbered: bool = False
    attitude: bool = False
    difference: bool = False
    calibrated: Literal["stations", "anchors"] | None = None

    def __post_init__(self) -> None:
        names = [column.name.replace("{n}", "1") for column in self.columns]
        others = [name for name in self.sensors if not name.startswith(("anchor", "station"))]
        wrong = [f"name {self.name!r}, expected lower case"] * (not re.fullmatch(r"[a-z][a-z0-9_]*", self.name))
        unit = f"expected a unit at its end ({', '.join(UNITS)})"
        wrong += [f"column {name!r}, {unit}" for name in names if not _NAME.fullmatch(name)]
        wrong += [f"sensor {name!r}, expected anchor … or station" for name in others]
        if wrong:
            raise UnusableInput(f"kind {self.name}: {wrong[0]}")

    @cached_property
    def noun(self) -> str:
        """What has errors of its own: `anchor`, `station`, or without sensors `tag`."""
        return self.sensors[0] if self.sensors else "tag"

    @cached_property
    def unit(self) -> str:
        """The unit of its values, by the first of them."""
        return self.columns[0].unit

    @cached_property
    def position(self) -> bool:
        """Whether its values are a position."""
        return [column.name for column in self.columns] == ["x_m", "y_m", "z_m"]

    @cached_property
    def angles(self) -> bool:
        """Whether its values are azimuth and elevation."""
        return [column.name for column in self.columns] == ["azimuth_rad", "elevation_rad"]

    @cached_property
    def shown(self) -> tuple[str, float]:
        """The unit in which its errors are shown, and how many of it are one of its own."""
        return ("°", math.degrees(1.0)) if self.angles else (f" {self.unit}", 1.0)

    def places(self, rig: Rig) -> dict[str, Point]:
        """The positions, m, of the anchors or stations of a rig that its sensors may be; none without sensors."""
        if self.noun == "station":
            return {key: np.asarray(station.position, float) for key, station in rig.stations.items()}
        return {key: np.asarray(place, float) for key, place in rig.anchors.items()} if self.sensors else {}

    @cached_property
    def least(self) -> tuple[str, ...]:
        """The columns with values that a table has at least."""
        return tuple(column.name.replace("{n}", "1") for column in self.columns)

    def layout(self, columns: Sequence[str]) -> Layout:
        """Its columns in a table with `columns`; kinds without anchors and stations have no signal quality."""
        names, stds = self.least, tuple[str, ...]()
        if self.numbered:
            before, after = map(re.escape, self.columns[0].name.split("{n}"))
            names = tuple(name for name in columns if re.fullmatch(rf"{before}[1-9]\d*{after}", name))
            stds = (std_column(self.columns[0].name.replace("_{n}", "")),)
        ids, optional = ("tag", *self.sensors), (*map(std_column, names), *stds, *(QUATERNION * self.attitude))
        quality = (name for name in columns if name and name not in ("t_s", *ids, *names, *optional))
        return Layout(ids, names, optional, tuple(quality) if self.sensors else ())

    def sizes(self, which: Literal["bias", "large", "floor"], columns: int) -> Float[np.ndarray, " m"]:
        """A size of errors of each of so many columns."""
        return np.broadcast_to(np.array([getattr(column, which) for column in self.columns]), (columns,))

    def measured(self, rig: Rig, rows: TagRows) -> Measured:
        """The readings in the rows of its table, with the anchors or stations of a rig."""
        columns, ids = self.least, tuple(self.places(rig))
        if self.numbered:
            columns = tuple(takewhile(rows.__contains__, (self.columns[0].name.format(n=n) for n in count(1))))
        number = np.zeros((len(rows.times), len(self.sensors)), int)
        for k, sensor in enumerate(self.sensors):
            number[:, k] = rows.codes(sensor, ids)
        return Measured(self, ids, columns, rows.floats(columns), self.sensors_of(rig, ids, number, len(columns)))

    def sensors_of(self, rig: Rig, ids: Sequence[str], number: Int[np.ndarray, "N k"], columns: int) -> Sensors:
        """The sensors of readings with so many columns, numbered in `ids`, anchors or stations of the rig."""
        there, axes = self.places(rig), np.tile(np.eye(3), (len(ids), 1, 1))
        places = np.array([there[key] for key in ids]).reshape(-1, 3)
        antennas, wavelengths = np.full((len(ids), columns, 2), np.nan), np.ones(len(ids))
        for k, station in enumerate(rig.stations[key] for key in ids if self.noun == "station"):
            axes[k] = station.world_from_array()
            if self.numbered and station.antennas is not None and station.wavelength is not None:
                antennas[k, : len(station.antennas)], wavelengths[k] = station.antennas, station.wavelength
        return Sensors(number, places, axes, antennas, wavelengths)

    def values_at(self, positions: Float[np.ndarray, "N 3"], sensors: Sensors) -> Float[np.ndarray, "N m"]:
        """The values that positions imply; raises UnusableInput where `predicted` returns another shape."""
        assert self.predicted is not None
        values, expected = self.predicted(positions, sensors), (len(positions), sensors.antennas.shape[1])
        if np.shape(values) != expected:
            found = f"predicted gave {np.shape(values)}, expected {expected}"
            raise UnusableInput(f"kind {self.name}: {found}; usual fix: values[:, None]")
        return values

    def errors(self, values: np.ndarray, positions: np.ndarray, sensors: Sensors, columns: Sequence[str]) -> np.ndarray:
        """Values (N, m) of columns less those predicted, angles in [−π, π); less an offset common to a row, if any."""
        errors = values - self.values_at(positions, sensors)
        if self.common:
            errors = errors - np.angle(np.nansum(np.exp(1j * errors), axis=1, keepdims=True))
        return wrapped(errors, columns)


class Streams(NamedTuple):
    """Readings (N, m) of columns, NaN where missing, one stream, of a tag and a sensor, after another.

    Of each but the first: whether it `follows` one in its stream, and how it `moved`; infinite where one lacks.
    """

    columns: tuple[str, ...]
    values: Float[np.ndarray, "N m"]
    follows: Bool[np.ndarray, " n"]
    moved: Float[np.ndarray, "n m"]

    @property
    def repeated_share(self) -> float:
        """The share of those with a predecessor in their stream that equal it in all columns; NaN without any."""
        return float(np.mean((self.moved[self.follows] == 0.0).all(axis=1))) if self.follows.any() else math.nan


class Measured(NamedTuple):
    """The readings (N, m) of `columns`, NaN where missing, and their anchors or stations, numbered in `ids`."""

    kind: Kind
    ids: tuple[str, ...]
    columns: tuple[str, ...]
    values: Float[np.ndarray, "N m"]
    sensors: Sensors

    @property
    def usable(self) -> Measured:
        """These readings, NaN also where the kind has positive ones alone and one is not."""
        positive = np.broadcast_to([column.positive for column in self.kind.columns], self.values.shape[1:])
        return self._replace(values=np.where(positive & ~(self.values > 0.0), np.nan, self.values))

    def of_rows(self, part: np.ndarray) -> Measured:
        """Some of the readings, by their numbers."""
        return self._replace(values=self.values[part], sensors=self.sensors._replace(number=self.sensors.number[part]))

    def streams(self, stream: Int[np.ndarray, " N"]) -> Streams:
        """These readings, each of a tag's `stream`; of more than `MOST_ROWS`, equally many first ones of a stream."""
        for number in self.sensors.number.T:
            stream = stream * len(self.ids) + number
        order = stable_order(stream)
        if len(order) > MOST_ROWS:
            counts = np.bincount(stream)
            order = order[within_groups(counts) < MOST_ROWS // np.count_nonzero(counts)]
        order = order[np.isfinite(self.values[order]).any(axis=1)]
        x, missing = self.values[order], np.isnan(self.values[order])
        moved = np.where(missing[1:] & missing[:-1], 0.0, wrapped(np.diff(x, axis=0), self.columns))
        return Streams(self.columns, x, np.diff(stream[order]) == 0, np.where(np.isnan(moved), np.inf, moved))

    def errors(self, positions: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N m"]:
        """The differences from the values that positions imply: see `Kind.errors`."""
        return self.kind.errors(self.values, positions, self.sensors, self.columns)


def std_column(value: str) -> str:
    """The name of the column with the standard deviation of `value`: `range_m` gives `range_std_m`."""
    quantity, _, unit = value.rpartition("_")
    return f"{quantity}_std_{unit}"


def wrapped(differences: Float[np.ndarray, "N m"], columns: Sequence[str]) -> Float[np.ndarray, "N m"]:
    """Differences of the values of columns, of angles in [−π, π)."""
    angles = np.array([column.endswith("_rad") for column in columns])
    if not angles.any():
        return differences
    return np.where(angles, np.mod(differences + np.pi, 2 * np.pi) - np.pi, differences)


def _angles(positions: np.ndarray, sensors: Sensors) -> np.ndarray:
    return angles_in_array(sensors.in_array(positions))


def _phases(positions: np.ndarray, sensors: Sensors) -> np.ndarray:
    """Phases of spherical waves, up to one offset of all antennas."""
    x, y, z = sensors.in_array(positions)
    p, a = np.stack([x, y], axis=1)[:, None], sensors.antennas[sensors.number[:, 0]]
    square = np.einsum("nmd,nmd->nm", a, a)
    along = 2.0 * np.einsum("nmd,nmd->nm", p * np.ones_like(a), a) - square
    far = np.sqrt(x * x + y * y + z * z)[:, None]
    # The distance less the antenna's, without subtracting the two.
    shorter = along / (far + np.sqrt(np.maximum(far * far - along, 0.0)))
    return 2 * np.pi / sensors.wavelengths[sensors.number[:, :1]] * shorter


_POSITION = (Column("x_m", 0.0, 0.25, 0.05), Column("y_m", 0.0, 0.25, 0.05), Column("z_m", 1.0, 1.0, 0.05))
_ANGLES = math.radians(5.0), math.radians(12.0), math.radians(2.0)
_IMU = [f"accel_{axis}_mps2" for axis in "xyz"] + [f"gyro_{axis}_radps" for axis in "xyz"]

_RANGE = (Column("range_m", 1.0, 0.3, 0.05, positive=True),)
_DIFFERENCE = (Column("range_difference_m", 0.5, 0.3, 0.05),)
_BEARING = (Column("azimuth_rad", *_ANGLES), Column("elevation_rad", *_ANGLES, bound=math.pi / 2))
_PHASE, _PAIR = (Column("phase_{n}_rad", 0.5, 0.8, 0.1),), ("anchor", "anchor_2")
_KINDS = (
    Kind("ranges", _RANGE, ("anchor",), lambda at, of: of.distances(at), averaged=True, calibrated="anchors"),
    Kind("tdoa", _DIFFERENCE, _PAIR, lambda at, of: -np.diff(of.distances(at)), averaged=True, difference=True),
    Kind("fixes", _POSITION, (), lambda at, of: at, averaged=True),
    Kind("bearings", _BEARING, ("station",), _angles, averaged=True, calibrated="stations"),
    Kind("phases", _PHASE, ("station",), _phases, common=True, numbered=True),
    Kind("imu", tuple(map(Column, _IMU)), attitude=True),
    Kind("odometry", (Column("speed_mps", bound=10.0), Column("yaw_rate_radps", bound=10.0))),
)
KINDS: dict[str, Kind] = {kind.name: kind for kind in _KINDS}
"""The kinds of measurement by name of their table, in the order in which they are listed."""

TRUTH = Kind("truth", _POSITION, attitude=True)  # the table of true positions


def table_kinds() -> dict[str, Kind]:
    """All tables of a recording: the kinds of measurement, and truth."""
    return {**KINDS, TRUTH.name: TRUTH}


def distinct(table: pl.DataFrame, kind: Kind) -> pl.DataFrame:
    """The table without rows whose time, ids and values repeat a row before; rows without a value stay."""
    ids, values, *_ = kind.layout(table.columns)
    empty = pl.all_horizontal(pl.col(values).is_null())
    return table.filter(pl.struct("t_s", *ids, *values).is_first_distinct() | empty)


def first_time(frames: Mapping[str, pl.DataFrame]) -> float:
    """The earliest time, s, of the measurements, or of the truth where there are none; zero without rows."""
    measured = [frames[name] for name in KINDS if name in frames]
    times = [seconds(table["t_s"].to_numpy()) for table in measured or frames.values()]
    return min((float(column.min()) for column in times if len(column)), default=0.0)


def add_kind(kind: Kind) -> Kind:
    """Adds a user's kind to those that are read; returns it. Raises UnusableInput for a built-in name."""
    if kind.name in _BUILT_IN:
        raise UnusableInput(f"kind {kind.name!r}: is a table of the format; give another name")
    KINDS[kind.name] = kind
    return kind


_BUILT_IN = frozenset(table_kinds())
