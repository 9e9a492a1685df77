"""Recordings in memory without a mistake, and the mistakes that are made on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import polars as pl

from tests.faulty import write_good
from trackwright.sim.corruptions import white_noise
from trackwright.sim.ranging import CORNERS, DifferenceDraw, chamber
from trackwright.sim.stations import facing
from trackwright.trackers.core.model.rig import Rig, Station, Tag
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording

Make = Callable[[RecordingFolder], RecordingFolder]


def with_columns(name: str, *columns: pl.Expr, **named: pl.Expr) -> Make:
    """Other columns of a table."""
    return lambda of: replace(of, tables={**of.tables, name: of.tables[name].with_columns(*columns, **named)})


def with_rows(name: str, kept: pl.Expr) -> Make:
    """Some of the rows of a table."""
    return lambda folder: replace(folder, tables={**folder.tables, name: folder.tables[name].filter(kept)})


def only(*tables: str) -> Make:
    """These tables alone."""
    return lambda folder: replace(folder, tables={name: folder.tables[name] for name in tables})


def with_anchors(change: Callable[[dict[str, np.ndarray]], dict[str, Any]]) -> Make:
    """Other places of the anchors that the change gives of all."""
    return lambda of: replace(of, rig=replace(of.rig, anchors={**of.rig.anchors, **change(dict(of.rig.anchors))}))


def rotated(change: Callable[[np.ndarray], np.ndarray], chosen: Sequence[str] | None = None) -> Make:
    """Other quaternions of stations, of all or of those that are chosen."""

    def make(folder: RecordingFolder) -> RecordingFolder:
        stations = {
            key: replace(s, rotation=change(np.asarray(s.rotation, float))) if key in (chosen or (key,)) else s
            for key, s in folder.rig.stations.items()
        }
        return replace(folder, rig=replace(folder.rig, stations=stations))

    return make


def about_z(q: np.ndarray, degrees: float) -> np.ndarray:
    """The attitude q turned about the world's z."""
    c, s = np.cos(np.radians(degrees) / 2), np.sin(np.radians(degrees) / 2)
    w, x, y, z = q
    return np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])


@cache
def good() -> RecordingFolder:
    """Five seconds of two tags with a table of each kind, as tests of readers write them."""
    with TemporaryDirectory() as folder:
        write_good(Path(folder) / "good")
        return read_recording(Path(folder) / "good")


ANCHORS = {
    "A1": (0.0, 0.0, 2.7), "A2": (6.0, 0.0, 2.4), "A3": (12.0, 0.0, 2.7),
    "A4": (12.0, 8.0, 2.7), "A5": (6.0, 8.0, 2.4), "A6": (0.0, 8.0, 2.7),
}  # fmt: skip
AXES = ("x_m", "y_m", "z_m")


def _facing(x: float, y: float) -> Station:
    """A level station 2.5 m high that looks at the middle of the hall."""
    place = np.array([x, y, 2.5])
    return Station(place, facing(place, np.array([6.0, 4.0, 2.5]), (0.0, 0.0, 1.0)))


@cache
def hall() -> RecordingFolder:
    """A walk of 60 s at 1.1 m with ranges of six anchors and bearings of three stations, at 5 Hz, and its truth."""
    rng, t = np.random.default_rng(4), 0.2 * np.arange(300)
    true = np.stack([6 + 4 * np.sin(0.31 * t), 4 + 2.5 * np.cos(0.47 * t), np.full_like(t, 1.1)], axis=1)
    stations = {"S1": _facing(0.0, 1.0), "S2": _facing(12.0, 2.0), "S3": _facing(5.0, 8.0)}
    ranges, bearings = [], []
    for anchor, place in ANCHORS.items():
        r = np.linalg.norm(true - place, axis=1) + rng.normal(0.05, 0.08, len(t))
        ranges.append(pl.DataFrame({"t_s": t, "tag": "T", "anchor": anchor, "range_m": r}))
    for name, station in stations.items():
        angles = np.asarray(station.angles(true)) + rng.normal(0, 0.03, (len(t), 2))
        head = {"t_s": t, "tag": "T", "station": name}
        bearings.append(pl.DataFrame(head | {"azimuth_rad": angles[:, 0], "elevation_rad": angles[:, 1]}))
    tables = {
        "ranges": pl.concat(ranges).sort("t_s"), "bearings": pl.concat(bearings).sort("t_s"),
        "truth": pl.DataFrame({"t_s": t, "tag": "T"} | dict(zip(AXES, true.T, strict=True))),
    }  # fmt: skip
    anchors = {key: np.array(place) for key, place in ANCHORS.items()}
    return RecordingFolder("hall", None, Rig("hall", anchors, stations, {"T": Tag(height=1.1)}), tables)


@cache
def differences(schedule: str = "messages") -> RecordingFolder:
    """Differences of ranges to the corners of a room that is no mirror image of itself.

    Else the sign of all differences only turns the path.
    """
    places = CORNERS + np.random.default_rng(7).uniform(-0.6, 0.6, CORNERS.shape)
    noise = {"white": white_noise(0.05)}
    draw = DifferenceDraw(chamber(places), n_points=300, schedule=schedule, corruptions=noise)
    return draw.drawn(seed=1).folder("w")


def height(metres: float | None) -> Make:
    """Another height of the tag of the hall."""
    return lambda folder: replace(folder, rig=replace(folder.rig, tags={"T": Tag(height=metres)}))


def together(*makes: Make) -> Make:
    """One change after another."""

    def make(folder: RecordingFolder) -> RecordingFolder:
        for one in makes:
            folder = one(folder)
        return folder

    return make
