"""Trajectories of range differences: one row per message, the differences of a tag at one time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.joint_positions import joint_positions
from trackwright.trackers.parts.ranges import anchor_positions, lacks_anchors, room_of_anchors, within_limits
from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import TrackerSpec
from trackwright.trackers.recordings.tracks import Trajectories, Trajectory, known_heights, trajectories_of
from trackwright.trackers.uwb_imu.fusion import TDOA, difference_tracker
from trackwright.trackers.uwb_imu.rows import bias_slots

# Most differences in a row; a longer message has several rows, whose differences count as independent. Twice as many
# take up to four times as long to compile.
MOST_SLOTS = 16
# Share of the variance of a difference that is of its two times of arrival, which other differences share. The rest is
# its own, as of rounding: differences that close a loop exactly would else have no density.
SHARED = 0.9
# Length, m, by which a difference may exceed the distance of its anchors, its largest value; others are no reading.
BEYOND = 1.0


def difference_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's range differences, one row per message, with the inputs `pairs`, `pair`, `nearby` and `room`.

    Differences that the triangle inequality rules out are masked.
    """
    rows, anchors = folder.rows(TDOA), anchor_positions(folder)
    values, seen = rows.values(["range_difference_m"])
    variances = rows.variances(["range_difference_std_m"])
    number = anchor_pairs(folder, rows)
    apart = np.linalg.norm(anchors[number[:, 0]] - anchors[number[:, 1]], axis=1)
    seen &= ((apart > 0.0) & (np.abs(values[:, 0]) <= apart + BEYOND))[:, None]
    slot, message, starts = messages(rows)
    # A power of two, so that recordings share a program.
    count, slots = int(starts[-1]), 1 << int(slot.max(initial=0)).bit_length()
    at = np.full((count, slots), len(values))
    at[message, slot] = np.arange(len(values))
    values, seen, variances, number = (
        np.concatenate([x, np.zeros((1, x.shape[1]), x.dtype)])[at] for x in (values, seen, variances, number)
    )
    number = number * seen
    times = rows.times[at[:, 0]]
    heights = np.full(len(rows.tags), np.nan) if free_height else known_heights(folder, rows.tags)
    reported = np.concatenate([variances[..., 0], correlations(number, seen[..., 0])], axis=1)
    readings = Readings(values[..., 0], seen[..., 0], reported)
    nearby = joint_positions(folder, [TDOA], rows.tags, starts, times, heights, np.zeros((count, 4)))
    inputs = {
        "pairs": anchors[number].reshape(count, -1),
        "pair": number.reshape(count, -1).astype(float),
        **within_limits(nearby, folder.rig),
        **room_of_anchors(folder, count),
    }
    return trajectories_of(folder, rows.tags, starts, times, {TDOA: readings}, inputs)


def anchor_pairs(folder: RecordingFolder, rows: TagRows) -> Int[np.ndarray, "N 2"]:
    """The numbers of both anchors of each difference, in the order of their ids."""
    ids = sorted(folder.rig.anchors)
    return np.stack([rows.codes(name, ids).astype(int) for name in ("anchor", "anchor_2")], axis=1)


def messages(rows: TagRows) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"], Int[np.ndarray, " ends"]]:
    """The slot and the row of each difference of a table, and the first row of each tag, then their number."""
    begins = np.append(True, np.diff(rows.times) != 0.0)[: len(rows.times)]
    begins[rows.starts[:-1]] = True
    first = np.flatnonzero(begins)
    place = np.arange(len(begins)) - np.repeat(first, np.diff(np.append(first, len(begins))))
    begins |= place % MOST_SLOTS == 0
    message = np.cumsum(begins) - 1
    starts = np.append(message[rows.starts[:-1]], begins.sum())
    return place % MOST_SLOTS, message, starts


def correlations(number: Int[np.ndarray, "M S 2"], seen: Bool[np.ndarray, "M S"]) -> Float[np.ndarray, "M P"]:
    """The correlation of each pair of slots, row by row of the upper triangle.

    Times of arrival of one variance make ½ for two differences to, or from, a common anchor, −½ for one to and one
    from it.
    """
    first, second = number[..., 0], number[..., 1]
    pairs = list(combinations(range(number.shape[1]), 2))
    result = np.zeros((len(number), len(pairs)))
    for column, (i, j) in enumerate(pairs):
        alike = (first[:, i] == first[:, j]) * 1.0 + (second[:, i] == second[:, j])
        opposite = (first[:, i] == second[:, j]) * 1.0 + (second[:, i] == first[:, j])
        result[:, column] = 0.5 * SHARED * (alike - opposite) * (seen[:, i] & seen[:, j])
    return result


def lacks_differences(folder: RecordingFolder) -> str | None:
    """What a folder lacks for the tracker of range differences, in words: enough anchors, and differences in metres."""
    if TDOA not in folder.tables:
        return "a tdoa table with at least 4 anchors, found no such table"
    rows, anchors = folder.rows(TDOA), anchor_positions(folder)
    number, (values, seen) = anchor_pairs(folder, rows), rows.values(["range_difference_m"])
    part = seen[:, 0] & (number[:, 0] != number[:, 1])
    if lacking := lacks_anchors(folder, rows, part, number, 4, "range differences of a tag among"):
        return lacking
    apart = np.linalg.norm(anchors[number[part, 0]] - anchors[number[part, 1]], axis=1)
    median, most = float(np.median(np.abs(values[part, 0]))), float(np.median(apart))
    if median > most:
        return (
            f"range differences in metres, found a median of {median:.4g} between anchors {most:.4g} m apart: probably "
            "nanoseconds or millimetres"
        )
    return None


def slots_of(trajectory: Trajectory) -> int:
    """The most differences in a row of a trajectory."""
    return int(trajectory.recording.readings[TDOA].values.shape[1])


def tracker_of_differences(trajectory: Trajectory, planar: bool, together: int = 8) -> Tracker:
    """The tracker of a trajectory's range differences, with `bias_slots`."""
    tracker = difference_tracker(bias_slots(trajectory, together), slots_of(trajectory), planar)
    return replace(tracker, lasting_errors=True)


TRACKERS: Mapping[str, Callable[..., TrackerSpec]] = {
    "tdoa": partial(
        TrackerSpec,
        trajectories=difference_trajectories,
        build=tracker_of_differences,
        lacks=lacks_differences,
        geometry=lambda trajectory: (bias_slots(trajectory), slots_of(trajectory)),
    )
}
"""How each tracker is built; `trackers.catalogue` has its table and its line in lists."""
