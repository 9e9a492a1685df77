"""Recordings at the edge of single precision: tags that creep through rooms of any size, read with any noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.model.rig import Rig, Station
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.rig_file import mounted

EPOCHS = 16
"""Times at which every tag is read."""

FASTEST = 1.0
"""Greatest speed of a tag, m/s."""

IMU_SIGMAS = {"accel": 0.02, "gyro": 0.002}
"""Standard deviations of an IMU's samples, m/s² and rad/s."""

GRAVITY = 9.81
CORNERS = np.array([[0, 0, 0.1], [1, 0, 0.9], [1, 1, 0.1], [0, 1, 0.9], [0.5, 0, 0.5], [0, 0.5, 0.2]])
STATIONS = ((0.0, 0.5, 0.0), (1.0, 0.5, 180.0), (0.5, 0.0, 90.0))
"""Anchors in a room of length 1; places and yaws, degrees, of stations half its height above its floor."""


class Cell(NamedTuple):
    """Standard deviation of a reading, m or rad; s between two readings; length of the room, m."""

    sigma: float
    dt: float
    room: float


class Walks(NamedTuple):
    """Positions (n, 3), m, at time 0, and velocities (n, 3), m/s; tags are named by their number."""

    begin: np.ndarray
    velocity: np.ndarray

    def at(self, times: np.ndarray) -> np.ndarray:
        """The positions (n, T, 3), m, at times (n, T), s."""
        return self.begin[:, None] + self.velocity[:, None] * times[..., None]


def recorded(cell: Cell, table: str, tags: int) -> tuple[RecordingFolder, Walks]:
    """A recording of `fixes`, `mirrored` fixes, fixes along a `path`, `ranges`, ranges and an `imu`, or `bearings`."""
    rng = np.random.default_rng(0)
    walks = _walks(cell, tags, table == "path", rng)
    times = np.tile(cell.dt * np.arange(EPOCHS), (tags, 1))
    places = walks.at(times)
    names = np.repeat(np.char.mod("%d", np.arange(tags)), EPOCHS)
    head = {"t_s": times.ravel(), "tag": names}
    anchors, rig = cell.room * CORNERS, Rig("envelope")
    if table == "mirrored":
        anchors[:, 2] = cell.room
    if table in ("mirrored", "ranges", "imu"):
        rig = Rig("envelope", {f"A{k}": place for k, place in enumerate(anchors)})
    if table == "bearings":
        frame, rig = _bearings(cell, head, places, rng)
    elif table in ("ranges", "imu"):
        exact = np.linalg.norm(places[:, :, None] - anchors, axis=-1)
        read = exact + cell.sigma * rng.normal(size=exact.shape)
        repeated = {name: np.repeat(column, len(anchors)) for name, column in head.items()}
        frame = pl.DataFrame(repeated | {"anchor": [*rig.anchors] * len(names), "range_m": read.ravel()})
    else:
        read = (places + cell.sigma * rng.normal(size=places.shape)).reshape(-1, 3)
        frame = pl.DataFrame(head | dict(zip(("x_m", "y_m", "z_m"), read.T, strict=True)))
    if table == "path":
        frame = frame.with_columns(z_m=pl.lit(None, pl.Float64))
        rig = Rig("envelope", path_knots=cell.room * np.array([[0.1, 0.5], [0.9, 0.5], [0.9, 0.9]]))
    tables = {{"bearings": "bearings", "ranges": "ranges", "imu": "ranges"}.get(table, "fixes"): frame}
    if table == "imu":
        tables["imu"] = _samples(cell, tags, rng)
    ordered = {name: unordered.sort("t_s", maintain_order=True) for name, unordered in tables.items()}
    return RecordingFolder("envelope", None, rig, ordered), walks


def _walks(cell: Cell, tags: int, on_path: bool, rng: np.random.Generator) -> Walks:
    begin = cell.room * rng.uniform(0.3, 0.7, (tags, 3))
    heading = rng.uniform(0, 2 * np.pi, tags)
    if on_path:
        begin[:, 1], heading = 0.5 * cell.room, np.zeros(tags)
    longest = cell.dt * EPOCHS
    speed = min(FASTEST, 0.2 * cell.room / longest) if longest else 0.0
    return Walks(begin, speed * np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1))


def _bearings(
    cell: Cell, head: dict[str, np.ndarray], places: np.ndarray, rng: np.random.Generator
) -> tuple[pl.DataFrame, Rig]:
    stations = {
        f"S{k}": Station(cell.room * np.array([x, y, 0.5]), mounted(np.deg2rad(yaw), 0.0, 0.0))
        for k, (x, y, yaw) in enumerate(STATIONS)
    }
    exact = np.stack([station.angles(places.reshape(-1, 3)) for station in stations.values()], axis=1)
    read = exact + cell.sigma * rng.normal(size=exact.shape)
    read = np.mod(read + np.pi, 2 * np.pi) - np.pi
    repeated = {name: np.repeat(column, len(stations)) for name, column in head.items()}
    angles = {"azimuth_rad": read[..., 0].ravel(), "elevation_rad": read[..., 1].ravel()}
    ids = {"station": [*stations] * len(head["tag"])}
    return pl.DataFrame(repeated | ids | angles), Rig("envelope", stations=stations)


def _samples(cell: Cell, tags: int, rng: np.random.Generator) -> pl.DataFrame:
    """Samples of IMUs that do not turn, at the times of the ranges and halfway between them."""
    times = 0.5 * cell.dt * np.arange(2 * EPOCHS)
    columns = {"t_s": np.tile(times, tags), "tag": np.repeat(np.char.mod("%d", np.arange(tags)), len(times))}
    for kind, unit, level in (("accel", "mps2", (0.0, 0.0, GRAVITY)), ("gyro", "radps", (0.0, 0.0, 0.0))):
        read = level + IMU_SIGMAS[kind] * rng.normal(size=(len(columns["t_s"]), 3))
        columns |= {f"{kind}_{axis}_{unit}": x for axis, x in zip("xyz", read.T, strict=True)}
    return pl.DataFrame(columns)
