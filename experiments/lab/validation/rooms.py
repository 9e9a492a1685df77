"""How far estimates leave the room of a recording: the box around its anchors, stations and truth, over the floor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl

from trackers.recordings.columns import float_column
from trackers.recordings.folder import RecordingFolder

MARGIN = 1.0
"""Largest distance, m, of an estimate outside its room."""


def room(folder: RecordingFolder) -> np.ndarray:
    """The lowest and the highest corner (2, 2), m, of the box around anchors, stations and truth in x and y."""
    rig, places = folder.rig, [_positions(folder.tables["truth"])] if "truth" in folder.tables else []
    places += [np.asarray(place, float)[None, :2] for place in rig.anchors.values()]
    places += [np.asarray(station.position, float)[None, :2] for station in rig.stations.values()]
    every = np.concatenate(places)
    return np.stack([np.nanmin(every, axis=0), np.nanmax(every, axis=0)])


class Outside(NamedTuple):
    """The estimate farthest from its room: distance and larger reported standard deviation, m, and time, s.

    `rows`: how many estimates are more than `MARGIN` outside.
    """

    distance: float
    sigma: float
    time: float
    rows: int


def farthest_outside(estimates: pl.DataFrame, corners: np.ndarray) -> Outside:
    """The estimate that is farthest from the box, at distance 0 where all are inside; rows without one are left out."""
    found = _positions(estimates)
    low, high = corners
    distances = np.nan_to_num(np.hypot(*np.maximum(np.maximum(low - found, found - high), 0.0).T))
    row = int(np.argmax(distances))
    sigma = max(float_column(estimates, f"std_{axis}_m")[row] for axis in "xy")
    time = float_column(estimates, "t_s")[row]
    return Outside(float(distances[row]), float(sigma), float(time), int(np.sum(distances > MARGIN)))


def _positions(table: pl.DataFrame) -> np.ndarray:
    return np.stack([float_column(table, f"{axis}_m") for axis in "xy"], axis=1)
