"""Draws of worlds, and what they give: simulated trajectories, and recording folders of their arrays in memory."""

from __future__ import annotations

from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, ClassVar

import equinox as eqx
import jax
import numpy as np
import polars as pl
from jaxtyping import Bool, Float, Int, Shaped

from trackwright.sim.corruptions import Corruption
from trackwright.sim.keys import Keys, namespace, stream, trajectory_keys
from trackwright.sim.paths import PATHS, WALK, PathFunction, Positions, Times
from trackwright.trackers import catalogue
from trackwright.trackers.core.data.recording import Recording
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.columns import TagRows, TruePaths
from trackwright.trackers.recordings.folder import RecordingFolder, Tables
from trackwright.trackers.recordings.tracks import known_height

AXES = ("x_m", "y_m", "z_m")  # the columns of a position

Ids = Shaped[np.ndarray, " n"]
Names = Mapping[str, tuple[Int[np.ndarray, "..."], Sequence[str]]]

static = partial(eqx.field, static=True)
"""A field of a draw that programs do not trace, as what decides shapes."""

by_name = partial(eqx.field, converter=OrderedDict)
"""A field of corruptions by name, which is the random stream, in order; programs trace their levels."""


class ArrayRows(TagRows):
    """The rows of a simulated table: one per tag, time and further place where `seen` (n, T, *places).

    `times` (T,) s. `ids` (n,) of the tags; those without a row are left out. `columns`: by their names, values (n, T,
    *places, m), NaN where one is missing. `names`: by column, the numbers, that broadcast to `seen`, of ids, and these.
    """

    def __init__(
        self,
        times: Float[np.ndarray, " T"],
        ids: Ids,
        columns: Mapping[Any, Float[np.ndarray, "n T *places m"]],
        seen: Bool[Any, "n T *places"] | None = None,
        names: Names = MappingProxyType({}),
    ) -> None:
        seen = np.ones((len(ids), len(times)), bool) if seen is None else seen
        tag, row, *_ = np.nonzero(seen)
        counts, every = np.bincount(tag, minlength=len(ids)), bool(seen.all())
        self.tags, self.times = [str(i) for i in ids[counts > 0]], times[row]
        self.starts = np.concatenate([[0], np.cumsum(counts[counts > 0])])
        self._columns = {of: x.reshape(-1, x.shape[-1]) if every else x[seen] for of, x in columns.items()}
        self._ids = {name: (np.broadcast_to(k, seen.shape)[seen], [*known]) for name, (k, known) in names.items()}

    def __contains__(self, name: str) -> bool:
        return name in ("t_s", "tag", *self._ids) or any(name in names for names in self._columns)

    def floats(self, names: Sequence[str]) -> Float[np.ndarray, "N m"]:
        if tuple(names) in self._columns:
            return self._columns[tuple(names)]
        places = {name: values[:, k] for of, values in self._columns.items() for k, name in enumerate(of)}
        missing = np.full(len(self.times), np.nan)
        return np.stack([places.get(name, missing) for name in names], axis=1)

    def codes(self, name: str, ids: Sequence[str]) -> Int[np.ndarray, " N"]:
        numbers, stored_ids = self._ids[name]
        return np.array([list(ids).index(x) for x in stored_ids])[numbers]

    def frame(self) -> pl.DataFrame:
        """The table, sorted by time."""
        tags = pl.Series(self.tags).gather(self.of_each(np.arange(len(self.tags))))
        columns: dict[str, Any] = {"t_s": self.times, "tag": tags}
        columns |= {name: pl.Series(ids).gather(numbers) for name, (numbers, ids) in self._ids.items()}
        for names, values in self._columns.items():
            columns |= {name: pl.Series(values[:, k], nan_to_null=True) for k, name in enumerate(names)}
        return pl.DataFrame(columns).sort("t_s", maintain_order=True)


class SimulatedTables(Tables):
    """Tables whose rows are arrays; a data frame is made of them when it is first read. `draw`: what drew them."""

    def __init__(self, rows: Mapping[str, ArrayRows], draw: AbstractDraw) -> None:
        super().__init__({})
        self._arrays, self.draw = rows, draw
        self._rows = {(name, 0.0): of for name, of in rows.items()}

    def __getitem__(self, name: str) -> pl.DataFrame:
        if name not in self._frames:
            self._frames[name] = self._arrays[name].frame()
        return self._frames[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def paths(self, recording: str) -> TruePaths:
        if self._paths is None:
            self._paths = TruePaths(self._arrays["truth"])
        return self._paths


@contextmanager
def as_numpy() -> Iterator[None]:
    """Broadcasting and promotion of traced arrays by the rules of NumPy."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


class AbstractDraw(eqx.Module):
    """What draws the trajectories of a world: called with keys (n,), it returns its arrays (n, …) by name.

    It works in NumPy and, if it has `measured`, inside a traced program. Its levels may be traced; what decides shapes
    is static.
    """

    measured: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """By the name of an array of readings, that of the mask, of all its axes or the first ones, of those there are."""

    size: ClassVar[int] = 256
    """Trajectories drawn together in NumPy."""

    @property
    @abstractmethod
    def times(self) -> Float[np.ndarray, " T"]:
        """The times of the array `positions` (n, T, 3), the truth, s."""

    @abstractmethod
    def arrays(self, keys: Keys) -> dict[str, Any]:
        """The arrays of the trajectories with these keys (n,), readings that are not there included."""

    @abstractmethod
    def folder(self, world: SimulatedWorld) -> RecordingFolder:
        """The recording folder of trajectories that it drew."""

    def __call__(self, keys: Keys) -> dict[str, Any]:
        """The arrays, with the rules of NumPy for shapes and types, whatever jax is set to."""
        with as_numpy():
            return self.arrays(keys)

    def there(self, arrays: Mapping[str, Any]) -> dict[str, Any]:
        """Which of the readings there are, by their name and of their shape."""
        of = {name: (arrays[name].shape, arrays[mask]) for name, mask in self.measured.items()}
        return {k: namespace(x).broadcast_to(x[(..., *[None] * (len(n) - x.ndim))], n) for k, (n, x) in of.items()}

    def world(self, arrays: dict[str, np.ndarray], ids: Int[np.ndarray, " n"], name: str = "world") -> SimulatedWorld:
        """The simulated world of these arrays."""
        return SimulatedWorld(name, self, ids, given=arrays)

    def drawn(self, n: int | Sequence[int] | np.ndarray = 1, seed: int = 0, name: str = "world") -> SimulatedWorld:
        """The world of `n` trajectories, or of those with the ids `n`, each a function of the seed and its id alone."""
        ids = np.arange(n) if isinstance(n, int | np.integer) else np.asarray(n)
        if not 0 < len({*ids.tolist()}) == len(ids):
            raise ValueError(f"ids = {n!r}: expected one or more, each once")
        return SimulatedWorld(name, self, ids, seed)


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedWorld:
    """Simulated trajectories with truth, drawn when they are first used: the arrays of their draw are attributes.

    As attributes, readings that are not seen are zero. `name`: of the recording folder; `ids` (n,) and `seed`: of the
    trajectories; `given`: their arrays, if these are known.
    """

    name: str
    draw: AbstractDraw
    ids: Int[np.ndarray, " n"]
    seed: int = 0
    given: Mapping[str, np.ndarray] | None = None

    @cached_property
    def arrays(self) -> Mapping[str, np.ndarray]:
        """The arrays (n, …) of the draw by name, drawn in blocks that fit the cache."""
        arrays: dict[str, np.ndarray] = {}
        # All blocks have one shape, so that nothing is compiled twice.
        n, size = len(self.ids), min(self.draw.size, len(self.ids))
        for first in range(0, 0 if self.given is not None else n, size):
            ids = self.ids[np.minimum(np.arange(first, first + size), n - 1)]
            block = self.draw(trajectory_keys(self.seed, ids))
            arrays = arrays or {array: np.empty((n, *x.shape[1:]), x.dtype) for array, x in block.items()}
            for array, x in block.items():
                arrays[array][first : first + size] = x[: n - first]
        return self.given or arrays

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        """The times of `positions` (n, T, 3), s."""
        return self.draw.times

    def __getattr__(self, name: str) -> np.ndarray:
        arrays = self.arrays if "draw" in self.__dict__ else {}
        if name not in arrays:
            raise AttributeError(f"a simulated world has no array {name!r}; it has {', '.join(arrays)}")
        values, there = arrays[name], self.draw.there(arrays)
        return np.where(there[name], values, values.dtype.type(0)) if name in there else values

    def folder(self, name: str | None = None) -> RecordingFolder:
        """The recording folder in memory: tables, rig and truth, one tag per trajectory."""
        return self.draw.folder(self if name is None else replace(self, name=name))

    def recordings(self, tracker: str | None = None, free_height: bool = False) -> list[Recording]:
        """The rows that a tracker reads, one recording per trajectory or, for bearings, per trajectory and station.

        `tracker`: a name of `trackers.catalogue`, by default the one that fits the folder. `free_height`: heights are
        estimated even where they are known. Raises UnusableInput for a tracker that lacks a table here.
        """
        folder = self.folder()
        name = tracker or catalogue.fitting(folder)
        batches, found = catalogue.spec_of(name).batches([folder], name, free_height), []
        for one in (one for batch in batches for one in batch.trajectories):
            # The input `height` only where the rig gives the tag one.
            unknown = {"height"} if known_height(folder, one.tag) is None else set()
            inputs = {key: x for key, x in one.recording.inputs.items() if key not in unknown}
            found.append(replace(one.recording, inputs=inputs))
        return found

    def truth(self) -> ArrayRows:
        """The table of the true positions."""
        return ArrayRows(self.times, self.ids, {AXES: self.positions})

    def recorded(
        self, tables: Mapping[str, ArrayRows], tags: Mapping[str, Tag] | None = None, **geometry: Any
    ) -> RecordingFolder:
        """The recording folder of these tables; `tags` by name, or one without a known height for each id.

        `geometry`: further fields of the rig.
        """
        known = {str(i): Tag() for i in self.ids} if tags is None else tags
        rig = Rig(self.name, tags=known, about="Simulated, see manifest.json.", **geometry)
        return RecordingFolder(self.name, None, rig, SimulatedTables(tables, self.draw))

    def __repr__(self) -> str:
        return f"<SimulatedWorld '{self.name}': {len(self.ids)} trajectories, {type(self.draw).__name__}>"


class AbstractRigDraw(AbstractDraw):
    """Tags that move by `path`, a name of `PATHS` or a function, among the anchors and stations of a rig.

    `corruptions`: of the readings at `n_points` times, by name, in order.
    """

    rig: Rig = static()
    path: str | PathFunction = static(default=WALK)
    corruptions: Mapping[str, Corruption] = by_name(default_factory=dict)
    rate_hz: float = static(default=10.0)
    n_points: int = static(default=200)

    size = 32

    @property
    def times(self) -> Times:
        return np.arange(self.n_points) / self.rate_hz

    @abstractmethod
    def rows(self, world: SimulatedWorld) -> dict[str, ArrayRows]:
        """The table of the readings, by its name."""

    def positions(self, keys: Keys, times: Times) -> Positions:
        """The true positions (n, T, 3), m."""
        return (PATHS[self.path] if isinstance(self.path, str) else self.path)(stream(keys, "path"), times)

    def folder(self, world: SimulatedWorld, **more: ArrayRows) -> RecordingFolder:
        """The readings, truth in space, and `more` tables; constant heights beside anchors are in the rig."""
        heights = [float(z[0]) if self.rig.anchors and np.ptp(z) == 0 else None for z in world.positions[..., 2]]
        tags = {str(i): Tag(height) for i, height in zip(world.ids, heights, strict=True)}
        tables = {**self.rows(world), "truth": world.truth(), **more}
        return world.recorded(tables, tags, anchors=self.rig.anchors, stations=self.rig.stations)
