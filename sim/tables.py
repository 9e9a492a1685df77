"""The tables of simulated worlds: recording folders of arrays in memory, one tag per trajectory, named by its id."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, ClassVar

import equinox as eqx
import jax
import numpy as np
import polars as pl
from jaxtyping import Float, Int, Shaped

from trackwright.sim.keys import Keys, in_blocks, trajectory_ids, trajectory_keys
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.columns import TagRows, TruePaths
from trackwright.trackers.recordings.folder import RecordingFolder, Tables
from trackwright.trackers.recordings.kinds import table_kinds


class ArrayRows(TagRows):
    """The rows of a simulated table, from arrays: `columns` (N, m) by their names, NaN where a value is missing.

    `ids`: by name, the number of each row's id (N,) and the ids.
    """

    def __init__(
        self,
        tags: Sequence[str],
        starts: Int[np.ndarray, " ends"],
        times: Float[np.ndarray, " N"],
        columns: Mapping[tuple[str, ...], Float[np.ndarray, "N m"]],
        ids: Mapping[str, tuple[Int[np.ndarray, " N"], Sequence[str]]] = MappingProxyType({}),
    ) -> None:
        self.tags, self.starts, self.times = list(tags), starts, times
        self._columns, self._ids = columns, dict(ids)

    @classmethod
    def regular(
        cls,
        times: Float[np.ndarray, " T"],
        ids: Shaped[np.ndarray, " n"],
        columns: Mapping[tuple[str, ...], Float[np.ndarray, "n T m"]],
    ) -> ArrayRows:
        """A row per tag and time: `times` (T,) s, and columns (n, T, m)."""
        starts = len(times) * np.arange(len(ids) + 1)
        flat = {names: values.reshape(-1, values.shape[-1]) for names, values in columns.items()}
        return cls([str(i) for i in ids], starts, np.tile(times, len(ids)), flat)

    @classmethod
    def of_entries(
        cls,
        tag: Int[np.ndarray, " N"],
        ids: Shaped[np.ndarray, " n"],
        times: Float[np.ndarray, " N"],
        columns: Mapping[tuple[str, ...], Float[np.ndarray, "N m"]],
        names: Mapping[str, tuple[Int[np.ndarray, " N"], Sequence[str]]] = MappingProxyType({}),
    ) -> ArrayRows:
        """Rows in the order of their tags' numbers `tag`; tags without a row are left out."""
        counts = np.bincount(tag, minlength=len(ids))
        starts = np.concatenate([[0], np.cumsum(counts[counts > 0])])
        return cls([str(i) for i in ids[counts > 0]], starts, times, columns, names)

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
        columns |= {name: pl.Series(list(ids)).gather(numbers) for name, (numbers, ids) in self._ids.items()}
        for names, values in self._columns.items():
            columns |= {name: pl.Series(values[:, k], nan_to_null=True) for k, name in enumerate(names)}
        return pl.DataFrame(columns).sort("t_s", maintain_order=True)


@contextmanager
def as_numpy() -> Iterator[None]:
    """Broadcasting and promotion of traced arrays by the rules of NumPy."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


class AbstractDraw(eqx.Module):
    """What draws the trajectories of a world: called with keys (n,), it returns its arrays (n, …) by name.

    It works in NumPy and inside a traced program. Its levels may be traced; what decides shapes is static.
    """

    measured: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """By the name of an array of readings, that of the mask of the same shape that says which there are."""

    size: ClassVar[int] = 256
    """Trajectories drawn together in NumPy."""

    @property
    @abstractmethod
    def times(self) -> Float[np.ndarray, " T"]:
        """The times of the array `positions` (n, T, 3), the truth, s."""

    @abstractmethod
    def arrays(self, keys: Keys) -> dict[str, Any]:
        """The arrays of the trajectories with these keys (n,), readings that are not there included."""

    def __call__(self, keys: Keys) -> dict[str, Any]:
        """The same, with the rules of NumPy for shapes and types, whatever jax is set to."""
        with as_numpy():
            return self.arrays(keys)

    @abstractmethod
    def world(self, arrays: dict[str, np.ndarray], ids: Int[np.ndarray, " n"]) -> Any:
        """The simulated world of these arrays: an object with a method `folder(name)`."""

    def drawn(self, n: int | Sequence[int] | np.ndarray, seed: int) -> Any:
        """The world of `n` trajectories, or of those with the ids `n`."""
        ids = trajectory_ids(n)
        return self.world(in_blocks(self, trajectory_keys(seed, ids), size=self.size), ids)


class SimulatedTables(Tables):
    """Tables whose rows are arrays; a data frame is made of them when it is first read. `draw`: what drew them."""

    def __init__(self, rows: Mapping[str, ArrayRows], draw: AbstractDraw | None = None) -> None:
        super().__init__({})
        self._arrays, self.draw = rows, draw

    def __getitem__(self, name: str) -> pl.DataFrame:
        if name not in self._frames:
            self._frames[name] = self._arrays[name].frame()
        return self._frames[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def rows(self, name: str, interval: float = 0.0) -> TagRows:
        return super().rows(name, interval) if interval and table_kinds()[name].averaged else self._arrays[name]

    def paths(self, recording: str) -> TruePaths:
        if self._paths is None:
            self._paths = TruePaths.of_rows(self._arrays["truth"])
        return self._paths


AXES = ("x_m", "y_m", "z_m")  # the columns of a position


def folder_of(
    name: str,
    tables: Mapping[str, ArrayRows],
    tags: Mapping[str, Tag] | np.ndarray,
    draw: AbstractDraw | None = None,
    **geometry: Any,
) -> RecordingFolder:
    """The recording folder of the tables.

    `tags`: by name, or the ids of tags without a known height or offset. `draw`: what drew the tables. `geometry`:
    further fields of the rig.
    """
    known = tags if isinstance(tags, Mapping) else {str(i): Tag() for i in tags}
    rig = Rig(name, tags=known, about="Simulated, see manifest.json.", **geometry)
    return RecordingFolder(name, None, rig, SimulatedTables(tables, draw))
