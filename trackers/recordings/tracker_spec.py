"""What the catalogue holds of a tracker: the tables it reads, how they become its rows, and how it is built."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.run.requirements import check_input
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.core.user_file import fault_of, split_name
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.trajectories import Trajectories, Trajectory, known_height

Key = tuple[bool, Hashable]  # whether a batch is planar, and the installation built into its tracker


@contextmanager
def faults_named(tracker: str, name: str, function: Callable[..., Any]) -> Iterator[None]:
    """Raises UnusableInput, with the line, where a function of a user's tracker fails; else the fault as it is."""
    try:
        yield
    except (UnusableInput, MemoryError):
        raise
    except Exception as error:
        code = getattr(function, "__code__", None)
        if code is None or function.__module__.startswith("trackwright."):
            raise
        file = Path(code.co_filename)
        raise UnusableInput(f"{tracker}: {name} failed ({fault_of(error, file)}); correct {file.name}") from error


@dataclass(frozen=True)
class TrackerBatch:
    """Trajectories that one tracker runs as a batch; `planar`: the state lies in a plane, as of the floor."""

    tracker: AbstractTracker
    trajectories: Sequence[Trajectory]
    planar: bool
    notices: tuple[str, ...] = ()


def at_known_height(trajectory: Trajectory, free_height: bool) -> bool:
    """Whether a tag's height is known and to be used, so that only its position over the floor is estimated."""
    return not free_height and known_height(trajectory.folder, trajectory.tag) is not None


@dataclass(frozen=True)
class TrackerSpec:
    """A tracker of the catalogue, or a user's own.

    `about`: one line for lists and help. `table`: the table it reads. `trajectories(folder, free_height)`: the rows of
    every tag (or of every tag and station) of a recording folder. `build(trajectory, planar)`: the tracker for a
    trajectory. `lacks(folder)`: what a folder lacks for it, in words, or None where it fits; by default the table.
    `geometry(trajectory)`: the part of the installation that is built into the tracker; trajectories that agree in
    it and in `planar` run as one batch. `planar(trajectory, free_height)`: whether the state lies in a plane. Both are
    asked once for all tags of a folder that share station and known height, where the rows are `Trajectories`.
    `notices(folder, free_height)`: a line for each tag of which the tracker assumes what the folder contradicts.
    `automatic(folder)`: whether the tracker may be chosen for a folder that it fits when none is named.
    `bearing_only`: it estimates directions, not positions. `every_row`: the tables of which it reads rows that repeat a
    value, too, since it averages them, counts rows, or estimates each time by itself.
    """

    about: str
    table: str
    trajectories: Callable[[RecordingFolder, bool], Iterable[Trajectory]]
    build: Callable[[Trajectory, bool], AbstractTracker]
    lacks: Callable[[RecordingFolder], str | None] | None = None
    geometry: Callable[[Trajectory], Hashable] = lambda trajectory: ()
    planar: Callable[[Trajectory, bool], bool] = at_known_height
    notices: Callable[[RecordingFolder, bool], Iterable[str]] = lambda folder, free_height: ()
    automatic: Callable[[RecordingFolder], bool] = lambda folder: True
    bearing_only: bool = False
    every_row: Collection[str] = ()

    @property
    def reads(self) -> frozenset[str]:
        """The words of `table`, among them the tables that it reads."""
        return frozenset(re.findall(r"\w+", self.table))

    def missing(self, folder: RecordingFolder) -> str | None:
        """What the folder lacks for this tracker, in words, or None where it fits."""
        if self.lacks is not None:
            return self.lacks(folder)
        return None if self.table in folder.tables else f"a {self.table} table, found no such table"

    def refusal(self, folder: RecordingFolder, name: str) -> str | None:
        """Why the tracker, of this name, does not run on the folder, in one line; None where it fits."""
        missing = self.missing(folder)
        if missing is None:
            return None
        return f"{folder.path or folder.name}: tracker '{name}' needs {missing}; its tables: {', '.join(folder.tables)}"

    def batches(self, folders: Sequence[RecordingFolder], name: str, free_height: bool = False) -> list[TrackerBatch]:
        """The trajectories of all folders, batched by tracker; raises UnusableInput for one that lacks something."""
        grouped: dict[Key, list[Trajectories]] = defaultdict(list)
        for folder in folders:
            if refused := self.refusal(folder, name):
                raise UnusableInput(refused)
            with faults_named(name, "trajectories", self.trajectories):
                rows = self.trajectories(folder, free_height)
                groups = [rows] if isinstance(rows, Trajectories) else [Trajectories.of([one]) for one in rows]
            with faults_named(name, "planar", self.planar):
                for group in groups:
                    for key, part in self._parts(group, free_height).items():
                        grouped[key].append(part)
        joined = {key: Trajectories.joined(parts) for key, parts in grouped.items()}
        with faults_named(name, "build", self.build):
            built = [TrackerBatch(self.build(mine[0], planar), mine, planar) for (planar, _), mine in joined.items()]
        for batch in built if split_name(name)[0] else ():
            with faults_named(name, "run", self.build):
                check_input(batch.tracker, batch.trajectories[0].recording, name)
        return built

    def _parts(self, trajectories: Trajectories, free_height: bool) -> dict[Key, Trajectories]:
        """The trajectories by `planar` and `geometry`, which are the first one's of each station and height."""
        kinds: dict[tuple[str, float], Key] = {}
        parts: dict[Key, list[int]] = defaultdict(list)
        heights = np.nan_to_num(trajectories.heights, nan=np.inf).tolist()
        for number, kind in enumerate(zip(trajectories.stations, heights, strict=True)):
            if kind not in kinds:
                first = trajectories[number]
                kinds[kind] = self.planar(first, free_height), self.geometry(first)
            parts[kinds[kind]].append(number)
        return {key: trajectories.chosen(np.array(numbers)) for key, numbers in parts.items()}
