"""Trajectories: the rows of one tag (or of one tag at one station) of a recording folder, as arrays for trackers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from itertools import pairwise
from typing import Any

import numpy as np

from trackwright.trackers.core.data.recording import Columns, Readings, Recording, each_array
from trackwright.trackers.recordings.columns import TruthStatus
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import Kind, std_column


@dataclass(frozen=True)
class Trajectory:
    """One trajectory to track: its folder, tag and station, and its rows; `station` is empty if stations share it."""

    folder: RecordingFolder
    tag: str
    station: str
    recording: Recording


class Trajectories(Sequence[Trajectory]):
    """Trajectories, by folder, tag and station, whose rows are `columns`, of which each trajectory is a view."""

    def __init__(
        self, folders: Sequence[RecordingFolder], tags: Sequence[str], stations: Sequence[str], columns: Columns
    ) -> None:
        self.folders, self.tags, self.stations, self.columns = folders, tags, stations, columns

    @classmethod
    def of(cls, trajectories: Iterable[Trajectory]) -> Trajectories:
        """These trajectories; raises ValueError where they differ in the names or shapes of their arrays."""
        if isinstance(trajectories, Trajectories):
            return trajectories
        members = list(trajectories)
        columns = Columns.of([trajectory.recording for trajectory in members])
        return cls([t.folder for t in members], [t.tag for t in members], [t.station for t in members], columns)

    @classmethod
    def joined(cls, parts: Sequence[Trajectories]) -> Trajectories:
        """The trajectories of all parts; raises ValueError where they differ in the names or shapes of their arrays."""
        if len(parts) == 1:
            return parts[0]
        folders = [folder for part in parts for folder in part.folders]
        tags, stations = [tag for part in parts for tag in part.tags], [s for part in parts for s in part.stations]
        return cls(folders, tags, stations, Columns.joined([part.columns for part in parts]))

    def __len__(self) -> int:
        return len(self.tags)

    def __getitem__(self, which: Any) -> Any:
        if isinstance(which, slice):
            return self.chosen(np.arange(len(self))[which])
        number = range(len(self))[which]
        recording = self.columns.recording(number)
        return Trajectory(self.folders[number], self.tags[number], self.stations[number], recording)

    def chosen(self, index: np.ndarray) -> Trajectories:
        """The trajectories with these numbers, in their order."""
        if np.array_equal(index, np.arange(len(self))):
            return self
        numbers = index.tolist()
        folders, tags, stations = ([x[k] for k in numbers] for x in (self.folders, self.tags, self.stations))
        return Trajectories(folders, tags, stations, self.columns.chosen(index))

    def replaced(
        self, readings: Mapping[str, Readings], inputs: Mapping[str, np.ndarray] | None = None
    ) -> Trajectories:
        """The trajectories with other readings, and with further inputs."""
        columns = replace(self.columns, readings=readings, inputs={**self.columns.inputs, **(inputs or {})})
        return Trajectories(self.folders, self.tags, self.stations, columns)

    @cached_property
    def heights(self) -> np.ndarray:
        """The known heights of the tags (n,), m; NaN where the rig gives none."""
        if len({id(folder) for folder in self.folders}) == 1:
            return known_heights(self.folders[0], self.tags)
        heights = (known_heights(folder, [tag]) for folder, tag in zip(self.folders, self.tags, strict=True))
        return np.concatenate([np.zeros(0), *heights])


def trajectories_of(
    folder: RecordingFolder,
    tags: Sequence[str],
    starts: np.ndarray,
    times: np.ndarray,
    readings: Mapping[str, Readings],
    inputs: Mapping[str, np.ndarray],
    stations: Sequence[str] | None = None,
) -> Trajectories:
    """The trajectories of tags (and `stations`) with these rows, truth, and the input `height`, zero if unknown."""
    position, status = folder.paths.at(tags, starts, times)
    known = (status == TruthStatus.SCORED) & np.isfinite(position).all(axis=1)
    position = position if known.all() else np.where(known[:, None], position, 0.0)
    truth = {"position": (position, known)} if stations is None else {"direction": (np.zeros((len(times), 2)), known)}
    station_names = [""] * len(tags) if stations is None else stations
    for station in dict.fromkeys(stations or ()):
        rows = np.repeat([name == station for name in station_names], np.diff(starts))
        truth["direction"][0][rows] = folder.rig.stations[station].angles(position[rows])
    heights = np.repeat(np.nan_to_num(known_heights(folder, tags)), np.diff(starts))
    names = [f"{folder.name}, tag {tag}" for tag in tags]
    ids = trajectory_ids(folder.name, tags, station_names)
    columns = Columns(starts, times, readings, {**inputs, "height": heights}, truth, names, ids)
    return Trajectories([folder] * len(tags), tags, station_names, columns)


def kind_trajectories(folder: RecordingFolder, kind: Kind) -> Trajectories:
    """Each tag's readings of a kind, with the inputs `places` (N, 3k), `sensors` (N, k) and `middle` (N, 3) of all."""
    rows = folder.rows(kind.name)
    measured = kind.measured(folder.rig, rows)
    number, there, columns = measured.sensors.number, measured.sensors.places, measured.columns
    inputs = {"places": there[number].reshape(len(number), -1), "sensors": number.astype(float)}
    if len(there):
        inputs["middle"] = np.broadcast_to(there.mean(axis=0), (len(number), 3))
    readings = Readings(*rows.values(columns), rows.variances([*map(std_column, columns)]))
    return trajectories_of(folder, rows.tags, rows.starts, rows.times, {kind.name: readings}, inputs)


def segments(trajectory: Trajectory, rows: int) -> list[Trajectory]:
    """The trajectory cut into segments of about `rows` rows, which fits run in parallel, each with its own start."""
    whole = trajectory.recording
    ends = np.linspace(0, len(whole), max(1, round(len(whole) / rows)) + 1).astype(int)
    return [replace(trajectory, recording=cut(whole, a, b)) for a, b in pairwise(ends)]


def cut(recording: Recording, start: int, stop: int) -> Recording:
    """The rows start … stop − 1 of a recording."""
    # Segments of one trajectory draw different random numbers.
    segment_id = None if recording.id is None else (recording.id + int(start)) % 2**64
    rows = each_array(recording, lambda x: x[start:stop])
    return Recording(recording.times[start:stop], *rows, recording.name, segment_id)


def trajectory_ids(folder: str, tags: Sequence[str], stations: Sequence[str]) -> list[int]:
    """The ids of trajectories of a recording folder: random numbers do not depend on the others that run with it."""
    texts = (f"{folder}\0{tag}\0{station}".encode() for tag, station in zip(tags, stations, strict=True))
    return [int.from_bytes(blake2b(text, digest_size=8).digest(), "little") for text in texts]


def with_floor_truth(trajectory: Trajectory) -> Trajectory:
    """The trajectory with true positions over the floor, (T, 2) m, known also where the truth has no height."""
    recording = trajectory.recording
    positions, status = trajectory.folder.paths.at([trajectory.tag], np.array([0, len(recording)]), recording.times)
    known = status == TruthStatus.SCORED
    position = np.where(known[:, None], positions[:, :2], 0.0)
    return replace(trajectory, recording=replace(recording, truth={"position": (position, known)}))


def known_height(folder: RecordingFolder, tag: str) -> float | None:
    """The constant height of a tag in the rig, m; None if it has none."""
    known = folder.rig.tags.get(tag)
    return None if known is None else known.height


def known_heights(folder: RecordingFolder, tags: Sequence[str]) -> np.ndarray:
    """The constant heights of tags in the rig, m; NaN for those without one."""
    return np.array([known_height(folder, tag) for tag in tags], float)
