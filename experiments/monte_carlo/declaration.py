"""What a study is: scenarios, trackers, a grid of numbers and how many runs; and what is refused before any run."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments.monte_carlo.errors import TrackedRuns
from experiments.monte_carlo.expectations import Conclusion, ExpectedResult
from trackers.catalogue import TRACKERS
from trackers.core.errors import UnusableInput
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerSpec

WORLD = "world."
"""What a grid's name begins with where it names a number of the worlds; other names are patterns of tunables."""

CHUNK, CHUNKS, LARGEST_CHUNK = 128, 512, 1024
"""Trajectories that are run together, more of them only where there would be more chunks than so many."""

METRICS = ("rmse_m", "median_m", "p95_m", "bound_m", "nees_mean", "nis_ratio", "diverged", "us_per_row")


@dataclass(frozen=True)
class World:
    """A scenario: `make(ids, seed, **numbers)` is a folder with truth whose tags are named by the ids (n,)."""

    make: Callable[..., RecordingFolder]
    numbers: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class TrackerConfig:
    """A tracker that takes part: by its name in the catalogue, or an entry of the study's own.

    `tunables`: values by name or pattern, in their units. `smooth`: over the whole recording. `free_height`: as the
    option of `track`. `every`: s, judge only the last estimate in every so many seconds.
    """

    tracker: str | TrackerSpec
    tunables: Mapping[str, Any] = field(default_factory=dict)
    smooth: bool = False
    free_height: bool = False
    every: float | None = None

    @property
    def spec(self) -> TrackerSpec:
        """What the command line knows of the tracker."""
        return TRACKERS[self.tracker] if isinstance(self.tracker, str) else self.tracker


@dataclass(frozen=True)
class Condition:
    """One scenario with one point of the grid; `index` counts them."""

    index: int
    world: str
    point: Mapping[str, Any]

    @property
    def label(self) -> str:
        """The world and the point, for a person."""
        return ", ".join([self.world, *(f"{short(name)} {value}" for name, value in self.point.items())])

    @property
    def numbers(self) -> dict[str, Any]:
        """The point's values by single names: a name of the grid may be several with commas, which share a value."""
        return {single.strip(): value for names, value in self.point.items() for single in names.split(",")}


def short(name: str) -> str:
    """A name of the grid for a person."""
    return name.split(",")[0].strip().removeprefix(WORLD)


@dataclass(frozen=True)
class Study:
    """Worlds × trackers × grid × runs. Trajectory ids are 0 … runs − 1 in all cells: differences are paired.

    The first tracker is the one that others are compared with. `grid`: `world.` and a keyword of the worlds, or a
    tunable's name or pattern, or several such with commas, to their values; all combinations. `measures`: figures of
    the study's own, numbers (n,) of n trajectories, NaN for none. `figures`: what the report's table shows. `expected`:
    what was printed elsewhere, beside what came out. `draw`: pictures of its own, as files in a folder; their names.
    """

    name: str
    about: str
    worlds: Mapping[str, World]
    trackers: Mapping[str, TrackerConfig]
    runs: int = 200
    grid: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    seed: int = 0
    measures: Mapping[str, Callable[[TrackedRuns], np.ndarray]] = field(default_factory=dict)
    metrics: Sequence[str] = METRICS
    expected: Callable[..., list[ExpectedResult | Conclusion]] | None = None
    draw: Callable[..., list[str]] | None = None
    source: str = ""

    @property
    def conditions(self) -> list[Condition]:
        """All worlds at all points of the grid."""
        points = [dict(zip(self.grid, values, strict=True)) for values in itertools.product(*self.grid.values())]
        return [Condition(k, w, p) for k, (w, p) in enumerate(itertools.product(self.worlds, points))]

    @property
    def chunk(self) -> int:
        """Trajectories that are run together: a small study has two chunks, so that little is lost with one."""
        return min(max(CHUNK, self.runs // CHUNKS), LARGEST_CHUNK, math.ceil(self.runs / 2))

    @property
    def chunks(self) -> int:
        """Chunks of every cell."""
        return math.ceil(self.runs / self.chunk)

    def numbers(self, condition: Condition) -> dict[str, Any]:
        """A world's numbers in a cell."""
        own = {k.removeprefix(WORLD): v for k, v in condition.numbers.items() if k.startswith(WORLD)}
        return {**self.worlds[condition.world].numbers, **own}


def checked(study: Study) -> Study:
    """The study; raises UnusableInput where it asks for nothing or names what isn't there."""
    where = f"study '{study.name}'"
    for what, named in (("worlds", study.worlds), ("trackers", study.trackers)):
        if not named:
            raise UnusableInput(f"{where}: no {what}; expected at least one; name it under [{what}]")
    if not 1 <= study.runs <= 10**9:
        raise UnusableInput(f"{where}: runs = {study.runs}; expected a whole number from 1 to 1e9")
    if not 0 <= study.seed < 2**63:
        raise UnusableInput(f"{where}: seed = {study.seed}; expected a whole number from 0 to 2^63 - 1")
    for name, config in study.trackers.items():
        if isinstance(config.tracker, str) and config.tracker not in TRACKERS:
            raise UnusableInput(
                f"{where}: trackers.{name}: tracker '{config.tracker}' is unknown; expected one of "
                f"{', '.join(TRACKERS)}"
            )
        for tunable, value in config.tunables.items():
            _finite(f"{where}: trackers.{name}.{tunable}", value)
    for name, values in study.grid.items():
        if isinstance(values, str) or not len(values):
            raise UnusableInput(f"{where}: grid '{name}' is empty; expected a list of at least one value")
        for value in values:
            _finite(f"{where}: grid '{name}'", value)
    for world in study.worlds.values():
        for name, value in world.numbers.items():
            _finite(f"{where}: worlds: {name}", value)
    return study


def _finite(what: str, value: Any) -> None:
    """Refuse a negative sigma, and numbers that are none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return
    if not math.isfinite(value):
        raise UnusableInput(f"{what} = {value}: expected a finite number")
    if value < 0 and "sigma" in what:
        raise UnusableInput(f"{what} = {value}: expected a standard deviation, zero or more; leave the sign out")
