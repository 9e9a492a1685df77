"""Trajectories of trackers that read ranges: one range per row, with the position and number of its anchor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import polars as pl

from trackers.core.recording import Readings
from trackers.parts.ranges import RANGES
from trackers.parts.recent_positions import recent_positions
from trackers.recordings.columns import by_tag, float_column, values_of
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.trajectories import Trajectory, known_height, trajectory_of
from trackers.recordings.truth import truth_by_tag


def range_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's ranges, one row per table row, with the inputs of `range_rows`."""
    paths = truth_by_tag(folder)
    for tag, table in by_tag(folder.tables["ranges"]):
        readings, inputs = range_rows(folder, tag, table, free_height)
        yield trajectory_of(folder, tag, "", table["t_s"].to_numpy(), {RANGES: readings}, inputs, paths)


def range_rows(
    folder: RecordingFolder, tag: str, table: pl.DataFrame, free_height: bool
) -> tuple[Readings, dict[str, np.ndarray]]:
    """The readings of a tag's ranges, one row per row of `table`, and their inputs `anchors`, `anchor` and `nearby`.

    Anchors are numbered in the order of their ids. Ranges that are not positive are masked.
    """
    order, positions = sorted(folder.rig.anchors), anchor_positions(folder)
    number = np.array([order.index(a) for a in table["anchor"].to_list()])
    values, seen = values_of(table, ["range_m"])
    seen &= values > 0.0
    variances = np.nan_to_num(float_column(table, "range_std_m"))[:, None] ** 2
    height = None if free_height else known_height(folder, tag)
    inputs = range_inputs(table["t_s"].to_numpy(), values[:, 0], seen[:, 0], number, positions, height)
    return Readings(values, seen, variances), inputs


def range_inputs(
    times: np.ndarray,
    ranges: np.ndarray,
    seen: np.ndarray,
    number: np.ndarray,
    anchors: np.ndarray,
    height: float | None,
) -> dict[str, np.ndarray]:
    """The inputs of rows with one range each: `anchors` (T, 3) m, `anchor` (T, 1), its number, and `nearby` (T, 4).

    `number` (T,): of each range's anchor in `anchors` (A, 3); `height` m: the tag's, where it is known.
    """
    nearby = recent_positions(times, anchors, number, ranges, seen, height)
    return {"anchors": anchors[number], "anchor": number[:, None].astype(float), "nearby": nearby}


def anchor_positions(folder: RecordingFolder) -> np.ndarray:
    """The anchors' positions (A, 3), m, in the order of their ids."""
    return np.stack([np.asarray(folder.rig.anchors[a], float) for a in sorted(folder.rig.anchors)])
