"""Trajectories: the rows of one tag (or of one tag at one station) of a recording folder, as arrays for trackers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from hashlib import blake2b
from itertools import pairwise

import numpy as np

from trackers.core.recording import Readings, Recording
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.truth import TruthPath, TruthStatus, interpolate_truth


@dataclass(frozen=True)
class Trajectory:
    """One trajectory to track: its folder, tag and station, and its rows; `station` is empty if stations share it."""

    folder: RecordingFolder
    tag: str
    station: str
    recording: Recording


def segments(trajectory: Trajectory, rows: int) -> list[Trajectory]:
    """The trajectory cut into segments of about `rows` rows, which fits run in parallel, each with its own start."""
    whole = trajectory.recording
    count = max(1, round(len(whole) / rows))
    ends = np.linspace(0, len(whole), count + 1).astype(int)
    return [replace(trajectory, recording=cut(whole, a, b)) for a, b in pairwise(ends)]


def cut(recording: Recording, start: int, stop: int) -> Recording:
    """The rows start … stop − 1 of a recording."""
    part = slice(start, stop)
    readings = {
        name: Readings(r.values[part], r.seen[part], None if r.reported is None else r.reported[part])
        for name, r in recording.readings.items()
    }
    inputs = {name: x[part] for name, x in recording.inputs.items()}
    truth = {name: (values[part], known[part]) for name, (values, known) in recording.truth.items()}
    # Segments of one trajectory draw different random numbers.
    own = None if recording.id is None else (recording.id + int(start)) % 2**64
    return Recording(recording.times[part], readings, inputs, truth, recording.name, own)


def trajectory_of(
    folder: RecordingFolder,
    tag: str,
    station: str,
    times: np.ndarray,
    readings: dict[str, Readings],
    inputs: dict[str, np.ndarray],
    paths: dict[str, TruthPath],
) -> Trajectory:
    """A trajectory of these rows, with the truth at their times and the input `height` (T,), m.

    The height is zero if the rig gives none for the tag. `paths`: from `truth_by_tag`.
    """
    height = known_height(folder, tag)
    inputs = {**inputs, "height": np.full(len(times), 0.0 if height is None else height)}
    truth = _truth(folder, tag, station, times, paths)
    recording = Recording(
        times, readings, inputs, truth, f"{folder.name}, tag {tag}", trajectory_id(folder.name, tag, station)
    )
    return Trajectory(folder, tag, station, recording)


def trajectory_id(folder: str, tag: str, station: str) -> int:
    """The id of a trajectory of a recording folder: random numbers do not depend on the others that run with it."""
    text = "\0".join((folder, tag, station))
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little")


def with_floor_truth(trajectory: Trajectory, paths: dict[str, TruthPath]) -> Trajectory:
    """The trajectory with true positions over the floor, (T, 2) m, known also where the truth has no height.

    `paths`: from `truth_by_tag`.
    """
    recording = trajectory.recording
    position, known = np.zeros((len(recording), 2)), np.zeros(len(recording), bool)
    if trajectory.tag in paths:
        found, status = interpolate_truth(recording.times, *paths[trajectory.tag])
        known = status == TruthStatus.SCORED
        position = np.where(known[:, None], found[:, :2], 0.0)
    return replace(trajectory, recording=replace(recording, truth={"position": (position, known)}))


def known_height(folder: RecordingFolder, tag: str) -> float | None:
    """The constant height of a tag in the rig, m; None if it has none."""
    known = folder.rig.tags.get(tag)
    return None if known is None else known.height


def known_heights(trajectory: Trajectory) -> np.ndarray:
    """The known height of the tag at each row (T,), m; NaN if the rig gives none."""
    height = known_height(trajectory.folder, trajectory.tag)
    return np.full(len(trajectory.recording), np.nan if height is None else height)


def _truth(
    folder: RecordingFolder, tag: str, station: str, times: np.ndarray, paths: dict[str, TruthPath]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """True positions (T, 3), or true directions (T, 2) from the station, with their mask; unknown without truth."""
    position, known = np.zeros((len(times), 3)), np.zeros(len(times), bool)
    if tag in paths:
        position, status = interpolate_truth(times, *paths[tag])
        known = (status == TruthStatus.SCORED) & np.isfinite(position).all(axis=1)
        position = np.where(known[:, None], position, 0.0)
    if station:
        return {"direction": (folder.rig.stations[station].angles(position), known)}
    return {"position": (position, known)}
