"""Declaration of a study: worlds, trackers, a grid of values and the number of runs; and its checks before any run."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import GetPydanticSchema, StrictBool, StrictFloat, StrictStr

from trackwright.experiments.monte_carlo.tracked import TrackedRuns
from trackwright.experiments.text.expectations import Claim
from trackwright.experiments.text.tables import STUDIES
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.errors import UnusableInput, near
from trackwright.trackers.evaluation.metrics import METRICS
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import TrackerSpec

WORLD = "world."
"""Prefix of grid names that are parameters of the worlds; all other grid names are patterns of tunables."""

CHUNK, CHUNKS, LARGEST_CHUNK = 128, 512, 1024
"""Trajectories per chunk; number of chunks from which on chunks grow; largest number of trajectories per chunk."""

DEFAULT_METRICS = ("rmse_m", "median_m", "p95_m", "bound_m", "nees_mean", "nis_ratio", "diverged", "us_per_row")


@dataclass(frozen=True)
class World:
    """A simulated world: `make(ids, seed, **numbers)` returns a folder with truth and a tag named after each id (n,).
    Further tags, as of one body, are not scored."""

    make: Callable[..., RecordingFolder]
    numbers: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class TrackerConfig:
    """A tracker of a study: its name in the catalogue, `FILE.py:NAME`, or its specification; and its settings. In TOML
    the name of its table is the default. `tunables`: values by name or pattern, in physical units. `smooth`: RTS
    smoothing over the whole recording. `free_height`: as the option of `track`. `every`: s, score only the last
    estimate of each such interval."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    tracker: Annotated[str | TrackerSpec, GetPydanticSchema(lambda _, schema: schema(StrictStr))] = ""
    tunables: Mapping[str, Any] = field(default_factory=dict)
    smooth: StrictBool = False
    free_height: StrictBool = False
    every: StrictFloat | None = None

    @cached_property
    def spec(self) -> TrackerSpec:
        """The specification; raises UnusableInput for an unknown name. Names of trackers are resolved here alone."""
        return spec_of(self.tracker) if isinstance(self.tracker, str) else self.tracker


@dataclass(frozen=True)
class Condition:
    """One world at one point of the grid; `index` numbers the conditions of a study."""

    index: int
    world: str
    point: Mapping[str, Any]

    @property
    def label(self) -> str:
        """The world and the point, for tables and plots."""
        return ", ".join([self.world, *(f"{short(name)} {value}" for name, value in self.point.items())])

    @property
    def numbers(self) -> dict[str, Any]:
        """The point's values by single names; a grid name may list several, separated by commas, that share a value."""
        return {single.strip(): value for names, value in self.point.items() for single in names.split(",")}


def short(name: str) -> str:
    """The first single name of a grid name, without the prefix of worlds."""
    return name.split(",")[0].strip().removeprefix(WORLD)


@dataclass(frozen=True)
class Study:
    """Worlds × trackers × grid × runs. Trajectory ids are 0 … runs − 1 in all conditions, so differences are paired.
    The first tracker is the reference of comparisons. `grid`: names -> values; all combinations are run. A name is
    `world.` and a parameter of the worlds, a tunable's name or pattern, or several of these separated by commas.
    `measures`: the study's own metrics, functions that return one number per trajectory (n,), NaN for none. `metrics`:
    those in the report's tables. `expected(results)`: printed numbers beside ours, and conclusions. `source`: text of
    the file that declares the study. `declared_in`: the name or file by which it was loaded."""

    name: str
    about: str
    worlds: Mapping[str, World]
    trackers: Mapping[str, TrackerConfig]
    runs: int = 200
    grid: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    seed: int = 0
    measures: Mapping[str, Callable[[TrackedRuns], np.ndarray]] = field(default_factory=dict)
    metrics: Sequence[str] = DEFAULT_METRICS
    # Functions of `Results`, which holds the study: its type stays out of this module.
    expected: Callable[..., Iterable[Claim]] | None = None
    source: str = ""
    declared_in: str = ""

    @cached_property
    def programs(self) -> dict[Any, Any]:
        """The compiled programs of conditions and trackers (`chunk.py`)."""
        return {}

    @property
    def conditions(self) -> list[Condition]:
        """All worlds at all points of the grid."""
        points = [dict(zip(self.grid, values, strict=True)) for values in itertools.product(*self.grid.values())]
        return [Condition(k, w, p) for k, (w, p) in enumerate(itertools.product(self.worlds, points))]

    @property
    def chunk(self) -> int:
        """Trajectories per chunk: at most half of the runs, so that an interrupted small study loses little."""
        return min(max(CHUNK, self.runs // CHUNKS), LARGEST_CHUNK, math.ceil(self.runs / 2))

    @property
    def chunks(self) -> int:
        """Number of chunks of each condition."""
        return math.ceil(self.runs / self.chunk)

    def condition(self, world: str, **point: Any) -> Condition:
        """The condition of a world at a point of the grid, as `**{"world.rate_hz": 5}`; raises KeyError."""
        matches = [c for c in self.conditions if c.world == world and point.items() <= c.point.items()]
        if len(matches) != 1:
            raise KeyError(f"{len(matches)} conditions have world '{world}' and {point}; expected one")
        return matches[0]

    def numbers(self, condition: Condition) -> dict[str, Any]:
        """The parameters of the world in a condition."""
        varied = {k.removeprefix(WORLD): v for k, v in condition.numbers.items() if k.startswith(WORLD)}
        return {**self.worlds[condition.world].numbers, **varied}


def checked(study: Study) -> Study:
    """The study; raises UnusableInput for empty parts, unknown trackers and metrics."""
    where, names = f"study '{study.name}'", (*METRICS, *STUDIES, *study.measures)
    for fits, words in (
        (re.fullmatch(r"\w[^/\\]*", study.name), "expected a name that a folder can have, without / and \\; rename it"),
        (study.worlds and study.trackers, "expected at least a table [worlds.NAME] and one [trackers.NAME]"),
        (1 <= study.runs <= 10**9, f"runs = {study.runs}; expected a whole number from 1 to 1e9"),
        (0 <= study.seed < 2**63, f"seed = {study.seed}; expected a whole number from 0 to 2^63 - 1"),
        *((metric in names, f"metrics: no metric {metric!r}{near(str(metric), names)}; names: {', '.join(names)}")
          for metric in study.metrics),
        *((len(values) and not isinstance(values, str), f"grid '{name}' is empty; expected a list of values")
          for name, values in study.grid.items()),
    ):  # fmt: skip
        if not fits:
            raise UnusableInput(f"{where}: {words}")
    for config in study.trackers.values():
        _ = config.spec
    return study
