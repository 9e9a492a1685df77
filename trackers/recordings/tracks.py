"""Trajectories: the rows of one tag (or of one tag at one station) of a recording folder, as arrays for trackers.

The estimates of all are one table, a row per trajectory and time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from itertools import pairwise
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.data.estimates import AXES, STATUS_WORDS, STEP_COLUMNS, Estimates, Status
from trackwright.trackers.core.data.frames import frame_html, to_pandas
from trackwright.trackers.core.data.recording import Batch, Columns, Readings, Recording, each_array
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.run.chunks import CHUNK
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.columns import TruthStatus
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import Kind, std_column
from trackwright.trackers.recordings.tracks_table import HEADING

MAX_BATCH = 8 * CHUNK  # trajectories in memory at once, on every machine


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
        return np.array([known_height(*of) for of in zip(self.folders, self.tags, strict=True)], float)


def trajectories_of(
    folder: RecordingFolder, tags: Sequence[str], starts: np.ndarray, times: np.ndarray,
    readings: Mapping[str, Readings], inputs: Mapping[str, np.ndarray], stations: Sequence[str] | None = None,
) -> Trajectories:  # fmt: skip
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
    # Random numbers do not depend on the others that run with it.
    texts = (f"{folder.name}\0{tag}\0{station}".encode() for tag, station in zip(tags, station_names, strict=True))
    ids = [int.from_bytes(blake2b(text, digest_size=8).digest(), "little") for text in texts]
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


@dataclass(frozen=True)
class TrackerBatch:
    """Trajectories that one tracker runs as a batch; `planar`: the state lies in a plane, as of the floor.

    `places`: as in `TrackerSpec`.
    """

    tracker: AbstractTracker
    trajectories: Sequence[Trajectory]
    planar: bool
    notices: tuple[str, ...] = ()
    places: Callable[[Trajectories, bool], Any] | None = None


@dataclass(frozen=True, repr=False)
class Tracks:
    """The estimates of recordings: a row per time of a trajectory, how many ended how, and the batches that ran."""

    table: pl.DataFrame
    summaries: dict[str, int]
    batches: list[TrackerBatch]

    @property
    def notices(self) -> tuple[str, ...]:
        """One line for readings used once, and for what a recording has that its tracker leaves out of account."""
        return tuple(line for batch in self.batches for line in batch.notices)

    def to_polars(self) -> pl.DataFrame:
        """The table of estimates."""
        return self.table

    def to_pandas(self) -> Any:
        """The table of estimates as a pandas frame; raises UnusableInput where pandas is not installed."""
        return to_pandas(self.table)

    def _repr_html_(self) -> str:
        return frame_html(repr(self), self.table)

    def __repr__(self) -> str:
        ended = ", ".join(f"{n} {words}" for words, n in self.summaries.items())
        return f"<Tracks: {len(self.table)} estimates; trajectories: {ended}>"


def batches(trajectories: Iterable[Trajectory], seed: int = 0, truth: bool = True) -> list[tuple[Trajectories, Batch]]:
    """The trajectories in batches of at most `MAX_BATCH`, similar lengths together; `seed`: of filters that draw."""
    joined = Trajectories.of(trajectories)
    lengths = np.diff(joined.columns.starts)
    ordered = np.argsort(lengths, kind="stable")
    parts = [ordered[k : k + MAX_BATCH] for k in range(0, len(ordered), MAX_BATCH)]
    groups = [(joined.chosen(part), rounded(int(lengths[part].max()))) for part in parts]
    return [(group, group.columns.batch(steps, None, seed, truth)) for group, steps in groups]


def rounded(rows: int) -> int:
    """At least `rows`, with three significant bits: recordings of all lengths then share few compiled programs."""
    step = 1 << max(rows.bit_length() - 3, 0)
    return -(-rows // step) * step


def track(groups: Sequence[TrackerBatch], advance: Callable[[int], None] = lambda done: None, seed: int = 0) -> Tracks:
    """The estimates of all batches; `advance` gets the number of trajectories done; `seed`: of filters that draw."""
    tables, endings = list[pl.DataFrame](), Counter[str]()
    for group in groups:
        # Covariances of large states have hundreds of entries.
        tracker = group.tracker.for_positions()
        for trajectories, batch in batches(group.trajectories, seed, truth=False):
            estimates = tracker.run(batch)
            rows = trajectories.columns.padded(trajectories.columns.times, estimates.status.shape[1])
            last, merged = estimates.per_time(rows)
            number = np.nonzero(last)[0]
            endings += _endings(number, merged.status, len(trajectories))
            tables.append(_table(trajectories, number, estimates.valid_times(rows)[last], merged))
            advance(len(trajectories))
    table = pl.concat(tables, how="diagonal").sort("recording", "tag", "t_s", maintain_order=True)
    return Tracks(table, dict(endings), list(groups))


def _endings(number: np.ndarray, status: np.ndarray, count: int) -> Counter[str]:
    """How many of `count` trajectories ended how; `number` (N,): of the one of each estimate, with its `status`."""
    has = {s: np.bincount(number[status == s], minlength=count) for s in Status}
    endings = {
        "too little data": has[Status.WAITING] == np.bincount(number, minlength=count),
        "non-finite": has[Status.NON_FINITE] > 0,
        "lost and re-started": has[Status.RESTARTED] > 0,
        "lost and never re-started": has[Status.LOST] > 0,
    }
    return Counter(np.select(list(endings.values()), list(endings), "ok").tolist())


def _table(trajectories: Trajectories, number: np.ndarray, times: np.ndarray, estimates: Estimates) -> pl.DataFrame:
    """The estimates (N,), one per time; `number`: of the trajectory of each; `times`: for which they are valid, s."""
    bearing = bool(trajectories.stations[0])
    origins = np.array([folder.origin for folder in trajectories.folders])[number]
    columns = angles(estimates) if bearing else _positions(estimates, trajectories.heights[number], origins)
    ids: dict[str, Sequence[str]] = {"recording": [f.name for f in trajectories.folders], "tag": trajectories.tags}
    if bearing:
        ids["station"] = trajectories.stations
    known = {name: np.where(estimates.usable, np.asarray(x, float), np.nan) for name, x in columns.items()}
    words = pl.Series([STATUS_WORDS.get(s) for s in Status])
    return pl.DataFrame(
        {name: pl.Series(texts).gather(number) for name, texts in ids.items()}
        | {"t_s": times}
        | {name: pl.Series(x, nan_to_null=True) for name, x in known.items()}
        | {name: getattr(estimates, name) for name in STEP_COLUMNS}
        | {"wrapped": estimates.wrapped > 0, "status": words.gather(estimates.status)}
    )


def _positions(estimates: Estimates, height: np.ndarray, origins: np.ndarray) -> dict[str, np.ndarray]:
    """Positions about `origins` (N, 2), m, of `height` (N,) without one, spreads, velocities and heading."""
    mean, every_sigma = [np.asarray(x) for x in estimates.mean.position], estimates.sigmas
    mean[:2] = [np.asarray(x, float) + origin for x, origin in zip(mean, origins.T, strict=False)]
    sigmas = [every_sigma[f"position.{k}"] for k in range(len(mean))]
    cov, n = estimates.entries("position"), len(mean)
    if n == 2:
        mean, sigmas = [*mean, height], [*sigmas, 0.0 * height]
    columns = {f"{a}_m": x for a, x in zip(AXES, mean, strict=True)}
    columns |= {f"std_{a}_m": s for a, s in zip(AXES, sigmas, strict=True)}
    columns |= {f"cov_{AXES[i]}{AXES[j]}_m2": cov[i][j] for i in range(n) for j in range(i + 1, n)}
    # A moving window has no velocity.
    velocity = [np.asarray(x) for x in getattr(estimates.mean, "velocity", ())]
    columns |= {f"v{a}_mps": v for a, v in zip(AXES, velocity, strict=False)}
    attitude = getattr(estimates.mean, "attitude", None)
    if attitude is None:
        return columns
    if isinstance(attitude, Heading):
        angle = np.asarray(attitude.angle)
    else:
        w, x, y, z = (np.asarray(q) for q in (attitude.w, attitude.x, attitude.y, attitude.z))
        angle = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    columns[HEADING] = np.pi - (np.pi - angle) % (2 * np.pi)
    if isinstance(attitude, Heading) and "attitude.0" in every_sigma:
        columns[f"std_{HEADING}"] = every_sigma["attitude.0"]
    return columns


def angles(estimates: Estimates) -> dict[str, np.ndarray]:
    """Azimuth and elevation; a direction in the array's plane has azimuth ±90° and its spread in the elevation."""
    mean, sigmas = estimates.mean, estimates.sigmas
    if hasattr(mean, "heading"):
        angle, sigma = np.asarray(mean.heading.angle), sigmas["heading.0"]
        azimuth = np.where(np.cos(angle) >= 0, np.pi / 2, -np.pi / 2)
        elevation = np.arcsin(np.clip(np.sin(angle), -1, 1))
        spreads = np.full_like(sigma, np.nan), sigma
    else:
        azimuth, elevation, spreads = mean.azimuth, mean.elevation, (sigmas["azimuth"], sigmas["elevation"])
    both = {"azimuth_rad": azimuth, "elevation_rad": elevation}
    return both | {"std_azimuth_rad": spreads[0], "std_elevation_rad": spreads[1]}
