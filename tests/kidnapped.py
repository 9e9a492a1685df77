"""Walks of tags that are carried away, and how soon the loss of their track is found."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

import trackwright as tw
from trackwright.trackers.core.model.tunable import with_values
from trackwright.trackers.recordings.rig_file import mounted

RATE_HZ, SECONDS, HEIGHT = 8.0, 60.0, 1.1
SIZE = np.array([12.0, 6.0])
CORNERS = np.array([[0.0, 0.0, 2.3], [12.0, 0.0, 2.3], [12.0, 6.0, 2.3], [0.0, 6.0, 2.3]])
PATIENCE_S, JUDGED_S = 5.0, (1.0, 3.0)
"""Longest delay that counts as a detection, and times after the kidnapping at which errors are taken, s."""


class Walk(NamedTuple):
    """The readings of a walk, its true positions (T, 2), m, and the row of the kidnapping."""

    recording: tw.Recording
    truth: np.ndarray
    kidnapped: int


def kidnapped_walk(seed: int, sensor: str) -> Walk:
    """A walk with `ranges` to four anchors or `bearings` of four stations, one reading a row, in turn."""
    rng = np.random.default_rng(seed)
    rows = int(SECONDS * RATE_HZ)
    times = np.arange(rows) / RATE_HZ
    velocity, truth = np.zeros(2), np.empty((rows, 2))
    truth[0] = rng.uniform(1.0, SIZE - 1.0)
    half = rows // 2
    for row in range(1, rows):
        velocity = velocity * np.exp(-1 / (4.0 * RATE_HZ)) + 0.5 * np.sqrt(1 / RATE_HZ) * rng.normal(size=2)
        truth[row] = truth[row - 1] + velocity / RATE_HZ
        if row == half:
            truth[row] = (truth[row] + SIZE / 2) % SIZE
        leaving = (truth[row] < 0.5) & (velocity < 0) | (truth[row] > SIZE - 0.5) & (velocity > 0)
        velocity = np.where(leaving, -velocity, velocity)
    number = np.arange(rows) % len(CORNERS)
    places = np.column_stack([truth, np.full(rows, HEIGHT)])
    if sensor == "ranges":
        errors = 0.08 * rng.standard_t(2.5, rows) + rng.normal(0.1, 0.1, len(CORNERS))[number]
        ranges = np.linalg.norm(places - CORNERS[number], axis=1) + errors
        return Walk(tw.range_recording(times, ranges, CORNERS, anchor=number, height=HEIGHT), truth, half)
    stations = {str(k): _station(corner) for k, corner in enumerate(CORNERS)}
    exact = np.stack([stations[str(k)].angles(place) for k, place in zip(number, places, strict=True)])
    biases = rng.normal(0.0, 0.1, (len(CORNERS), 2))[number]
    bearings = exact + biases + 0.07 * rng.standard_t(2.5, (rows, 2))
    names = [str(k) for k in number]
    return Walk(tw.bearing_recording(times, bearings, names, stations, height=HEIGHT), truth, half)


def _station(corner: np.ndarray) -> tw.Station:
    """A station in a corner that looks at the middle of the room."""
    x, y = SIZE / 2 - corner[:2]
    return tw.Station(corner, mounted(np.arctan2(y, x), 0.0, 0.0))


class Detection(NamedTuple):
    """Of many kidnapped walks: tracks lost before the kidnapping, and the share lost within `PATIENCE_S` after it.

    `delay`: median time from kidnapping to loss, s. `errors`: median errors, m, `JUDGED_S` after the kidnapping.
    """

    false_alarms: int
    detected: float
    delay: float
    errors: tuple[float, ...]


def detection(sensor: str, trajectories: int, score_limit: float | None = None) -> Detection:
    """Track loss on kidnapped walks; `score_limit`: in place of the tracker's own, nats."""
    tracker = tw.range_tracker(4, planar=True) if sensor == "ranges" else tw.bearing_tracker(4, planar=True)
    if score_limit is not None:
        tracker = with_values(tracker, {"track_loss.score_limit": score_limit})
    walks = [kidnapped_walk(seed, sensor) for seed in range(trajectories)]
    estimates = tracker.run([walk.recording for walk in walks])
    restarted = np.asarray(estimates.status) == tw.Status.RESTARTED
    x, y = (np.asarray(p) for p in estimates.mean.position)
    before, delays, errors = 0, [], []
    for k, walk in enumerate(walks):
        before += bool(restarted[k, : walk.kidnapped].any())
        later = np.flatnonzero(restarted[k, walk.kidnapped :])
        delays.append((later[0] if len(later) else np.inf) / RATE_HZ)
        judged = walk.kidnapped + (RATE_HZ * np.array(JUDGED_S)).astype(int)
        errors.append(np.hypot(x[k] - walk.truth[:, 0], y[k] - walk.truth[:, 1])[judged])
    after = np.array(delays)
    medians = tuple(float(e) for e in np.median(errors, axis=0))
    return Detection(before, float(np.mean(after <= PATIENCE_S)), float(np.median(after)), medians)
