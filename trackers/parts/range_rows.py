"""Trajectories of trackers that read ranges: one range per row, with the position and number of its anchor."""

from __future__ import annotations

import numpy as np
import polars as pl

from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.core.model.inputs import HEIGHT_LIMITS
from trackwright.trackers.core.model.rig import Rig, mirrored, room_rows
from trackwright.trackers.core.run.track_loss import ROOM
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.parts.recent_positions import recent_positions
from trackwright.trackers.parts.start_nearby import NEARBY
from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.trajectories import Trajectories, known_heights, trajectories_of

COLLINEAR = 1e-2
"""Ratio of the horizontal singular values of the anchor positions below which the anchors count as collinear."""

CARRIER = "tag of the body"
"""The column with the tag of each range where ranges of several tags are rows of one trajectory."""


def range_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's ranges, one row per table row, with the inputs of `range_inputs`, and `room`."""
    rows = folder.rows("ranges")
    readings, number = range_rows(folder, rows)
    heights = np.full(len(rows.tags), np.nan) if free_height else known_heights(folder, rows.tags)
    anchors = anchor_positions(folder)
    inputs = range_inputs(rows.starts, rows.times, readings, number, anchors, heights, folder.rig)
    inputs |= room_of_anchors(folder, len(number))
    return trajectories_of(folder, rows.tags, rows.starts, rows.times, {RANGES: readings}, inputs)


def range_rows(folder: RecordingFolder, rows: TagRows) -> tuple[Readings, np.ndarray]:
    """The readings of ranges, one row per row of the table, and the number of each range's anchor (N,).

    Anchors are numbered in the order of their ids. Ranges that are not positive are masked. Where the folder has a
    calibration, ranges are without the systematic errors of their anchor and tag, and have the variance that these add.
    """
    values, seen = rows.values(["range_m"])
    seen &= values > 0.0
    anchors = sorted(folder.rig.anchors)
    number = rows.codes("anchor", anchors)
    variances = rows.variances(["range_std_m"])
    if folder.calibration is not None:
        # The ranges of several tags on one body are rows of one trajectory.
        tags = sorted(folder.tables["ranges"]["tag"].cast(pl.String).unique()) if CARRIER in rows else rows.tags
        tag = rows.codes(CARRIER, tags) if CARRIER in rows else rows.of_each(np.arange(len(tags)))
        distances, added = folder.calibration.of_ranges(anchors, number, tags, tag, values[:, 0])
        values, variances = np.where(seen, distances[:, None], 0.0), variances + added[:, None]
        seen &= values > 0.0
    return Readings(values, seen, variances), number


def range_inputs(
    starts: np.ndarray,
    times: np.ndarray,
    readings: Readings,
    number: np.ndarray,
    anchors: np.ndarray,
    heights: np.ndarray,
    rig: Rig,
) -> dict[str, np.ndarray]:
    """The inputs of rows with one range each: `anchors`, `anchor`, its number, `nearby` and `height_limits`.

    `starts` (n + 1,): the first row of each of n tags, then N. `number` (N,): of each range's anchor in `anchors`
    (A, 3). `heights` (n,) m: of the tags, NaN where unknown.
    """
    nearby = recent_positions(starts, times, anchors, number, readings.values[:, 0], readings.seen[:, 0], heights)
    return {"anchors": anchors[number], "anchor": number[:, None].astype(float), **within_limits(nearby, rig)}


def within_limits(nearby: np.ndarray, rig: Rig) -> dict[str, np.ndarray]:
    """The inputs `height_limits` and `nearby` (N, 4), with heights on the likely side of the anchors' plane."""
    limits = rig.height_limits()
    nearby[:, 2] = np.where(nearby[:, 3] > 0, mirrored(nearby[:, 2], limits), 0.0)
    return {NEARBY.name: nearby, HEIGHT_LIMITS.name: np.broadcast_to(limits, (len(nearby), 2))}


def anchor_positions(folder: RecordingFolder) -> np.ndarray:
    """The anchors' positions (A, 3), m, in the order of their ids."""
    return np.stack([np.asarray(folder.rig.anchors[a], float) for a in sorted(folder.rig.anchors)])


def lacks_a_plane(positions: np.ndarray) -> str | None:
    """What anchors at these positions (A, 3), m, lack for a position over the floor, in words."""
    sizes = np.linalg.svd(positions[:, :2] - positions[:, :2].mean(axis=0), compute_uv=False)
    if sizes[1] > COLLINEAR * sizes[0]:
        return None
    return f"anchors that span a plane, found all {len(positions)} on one line or at one place seen from above"


def room_of_anchors(folder: RecordingFolder, rows: int) -> dict[str, np.ndarray]:
    """The input `room` for this number of rows, from the folder's floor or its anchors."""
    return {ROOM.name: room_rows(anchor_positions(folder), folder.rig.outline, rows)}
