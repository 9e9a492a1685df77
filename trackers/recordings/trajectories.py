"""From recording folders to the rows that trackers take: trajectories, and what every system's trajectories are made with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import polars as pl

from trackers.core.recording import Readings, Recording
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.truth import TruthStatus, interpolated, truth_paths

Path = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Trajectory:
    """One trajectory to track: whose it is, and its rows. `station` is empty where all stations share the trajectory."""

    folder: RecordingFolder
    tag: str
    station: str
    recording: Recording


def pieces(trajectory: Trajectory, rows: int) -> list[Trajectory]:
    """The trajectory cut into parts of about `rows` rows, for fits: short parts run side by side, each started anew."""
    whole = trajectory.recording
    count = max(1, round(len(whole) / rows))
    ends = np.linspace(0, len(whole), count + 1).astype(int)
    return [
        Trajectory(trajectory.folder, trajectory.tag, trajectory.station, cut(whole, a, b)) for a, b in pairwise(ends)
    ]


def cut(recording: Recording, start: int, stop: int) -> Recording:
    """The rows start … stop − 1 of a recording."""
    part = slice(start, stop)
    readings = {
        name: Readings(r.values[part], r.seen[part], None if r.reported is None else r.reported[part])
        for name, r in recording.readings.items()
    }
    inputs = {name: x[part] for name, x in recording.inputs.items()}
    truth = {name: (values[part], known[part]) for name, (values, known) in recording.truth.items()}
    return Recording(recording.times[part], readings, inputs, truth, recording.name)


def trajectory_of(
    folder: RecordingFolder,
    tag: str,
    station: str,
    times: np.ndarray,
    readings: dict[str, Readings],
    inputs: dict[str, np.ndarray],
    paths: dict[str, Path],
) -> Trajectory:
    """A trajectory of these rows, with the input `height` (T,), m, zero where the rig gives none, and the truth at them."""
    height = known_height(folder, tag)
    inputs = {**inputs, "height": np.full(len(times), 0.0 if height is None else height)}
    truth = _truth(folder, tag, station, times, paths)
    return Trajectory(folder, tag, station, Recording(times, readings, inputs, truth, f"{folder.name}, tag {tag}"))


def known_height(folder: RecordingFolder, tag: str) -> float | None:
    """The constant height of a tag, m, where the rig gives one."""
    known = folder.rig.tags.get(tag)
    return None if known is None else known.height


def known_heights(trajectory: Trajectory) -> np.ndarray:
    """What estimates over the floor show as the tag's height (T,), m: NaN where nobody knows it."""
    height = known_height(trajectory.folder, trajectory.tag)
    return np.full(len(trajectory.recording), np.nan if height is None else height)


def true_paths(folder: RecordingFolder) -> dict[str, Path]:
    """The true paths by tag, as `lane_of` takes them; empty without truth."""
    return truth_paths(folder.tables["truth"], folder.name) if "truth" in folder.tables else {}


def _truth(
    folder: RecordingFolder, tag: str, station: str, times: np.ndarray, paths: dict[str, Path]
) -> dict[str, Path]:
    """The true position at the rows' times, or for a station's trajectory the true direction; known nowhere without truth."""
    place, known = np.zeros((len(times), 3)), np.zeros(len(times), bool)
    if tag in paths:
        place, verdict = interpolated(times, *paths[tag])
        known = (verdict == TruthStatus.COUNTS) & np.isfinite(place).all(axis=1)
        place = np.where(known[:, None], place, 0.0)
    if station:
        return {"direction": (folder.rig.stations[station].angles(place), known)}
    return {"position": (place, known)}


def by_tag(table: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
    """The rows of each tag."""
    for (tag,), part in table.group_by(["tag"], maintain_order=True):
        yield str(tag), part


def values_of(table: pl.DataFrame, columns: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """The columns (n, m) with zero where a value is missing, and where there is one."""
    values = table.select(pl.col(columns).cast(pl.Float64).fill_null(np.nan)).to_numpy()
    seen = np.isfinite(values)
    return np.where(seen, values, 0.0), seen
