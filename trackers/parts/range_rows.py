"""Rows of trackers that read ranges: one range a row, with the position and number of its anchor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import polars as pl

from trackers.core.recording import Readings
from trackers.parts.range_places import recent_places
from trackers.parts.ranges import RANGES
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.trajectories import Trajectory, by_tag, known_height, trajectory_of, true_paths, values_of
from trackers.recordings.truth import numbers


def range_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's ranges, one a row, with the place and number of the row's anchor as inputs."""
    paths = true_paths(folder)
    for tag, table in by_tag(folder.tables["ranges"]):
        readings, inputs = range_rows(folder, tag, table, free_height)
        yield trajectory_of(folder, tag, "", table["t_s"].to_numpy(), {RANGES: readings}, inputs, paths)


def range_rows(
    folder: RecordingFolder, tag: str, table: pl.DataFrame, free_height: bool
) -> tuple[Readings, dict[str, np.ndarray]]:
    """The readings of a tag's ranges, one a row of `table`, and the rows' inputs `anchors`, `anchor` and `nearby`.

    Anchors are numbered in the order of their ids. A negative range is no distance and counts as missing.
    """
    order, places = sorted(folder.rig.anchors), anchor_positions(folder)
    number = np.array([order.index(a) for a in table["anchor"].to_list()])
    values, seen = values_of(table, ["range_m"])
    seen &= values > 0.0
    variances = np.nan_to_num(numbers(table, "range_std_m"))[:, None] ** 2
    height = None if free_height else known_height(folder, tag)
    nearby = recent_places(table["t_s"].to_numpy(), places, number, values[:, 0], seen[:, 0], height)
    inputs = {"anchors": places[number], "anchor": number[:, None].astype(float), "nearby": nearby}
    return Readings(values, seen, variances), inputs


def anchor_positions(folder: RecordingFolder) -> np.ndarray:
    """The anchors' places (A, 3), m, in the order of their ids."""
    return np.stack([np.asarray(folder.rig.anchors[a], float) for a in sorted(folder.rig.anchors)])
