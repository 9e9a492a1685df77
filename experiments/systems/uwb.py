"""System C without an inertial sensor on the command line: trackers of ranges, and their lanes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import polars as pl

from experiments.entry import Entry
from experiments.folder import Folder
from experiments.lanes import Lane, by_tag, known_height, lane_of, true_paths, values_of
from experiments.matching import numbers
from trackers.core.recording import Readings
from trackers.uwb_imu.fusion import range_tracker
from trackers.uwb_imu.nearby import recent_places
from trackers.uwb_imu.ranges import RANGES


def range_lanes(folder: Folder, free_height: bool) -> Iterator[Lane]:
    """Each tag's ranges, one a row, with the place and number of the row's anchor as inputs."""
    paths = true_paths(folder)
    for tag, table in by_tag(folder.tables["ranges"]):
        readings, inputs = range_rows(folder, tag, table, free_height)
        yield lane_of(folder, tag, "", table["t_s"].to_numpy(), {RANGES: readings}, inputs, paths)


def range_rows(
    folder: Folder, tag: str, table: pl.DataFrame, free_height: bool
) -> tuple[Readings, dict[str, np.ndarray]]:
    """The readings of a tag's ranges, one a row of `table`, and the rows' inputs `anchors`, `anchor` and `nearby`.

    Anchors are numbered in the order of their ids. A negative range is no distance and counts as missing.
    """
    order = sorted(folder.rig.anchors)
    places = np.stack([np.asarray(folder.rig.anchors[a], float) for a in order])
    number = np.array([order.index(a) for a in table["anchor"].to_list()])
    values, seen = values_of(table, ["range_m"])
    seen &= values > 0.0
    variances = np.nan_to_num(numbers(table, "range_std_m"))[:, None] ** 2
    height = None if free_height else known_height(folder, tag)
    nearby = recent_places(table["t_s"].to_numpy(), places, number, values[:, 0], seen[:, 0], height)
    inputs = {"anchors": places[number], "anchor": number[:, None].astype(float), "nearby": nearby}
    return Readings(values, seen, variances), inputs


def _heard(folder: Folder) -> str | None:
    """What a folder lacks for a tracker of ranges."""
    if "ranges" not in folder.tables:
        return "a ranges table with at least 3 anchors, found no such table"
    found = folder.tables["ranges"]["anchor"].n_unique()
    return None if found >= 3 else f"a ranges table with at least 3 anchors, found {found} anchor(s)"


def _biases(lane: Lane) -> int:
    """How many biases the tracker of a lane has: whole eights, so that installations share a tracker."""
    return -(-len(lane.folder.rig.anchors) // 8) * 8


TRACKERS = {
    "uwb": Entry(
        "position from ranges, with a drifting bias per anchor", "ranges", _heard,
        range_lanes, lambda lane, planar: range_tracker(_biases(lane), planar), _biases,
    ),
}  # fmt: skip
