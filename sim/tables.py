"""The tables of simulated worlds: recording folders in memory, one tag per trajectory, named by its id."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
import polars as pl
from jaxtyping import Float, Int

from trackers.core.rig import Rig, Tag
from trackers.recordings.folder import RecordingFolder


@runtime_checkable
class Simulated(Protocol):
    """Trajectories simulated as arrays, with truth; `ids` (n,): the trajectory ids, which name the tags."""

    @property
    def ids(self) -> Int[np.ndarray, " n"]: ...

    def folder(self, name: str) -> RecordingFolder:
        """The recording folder `name` with these measurements, their truth and their rig."""
        ...


def named(index: Int[np.ndarray, " n"], names: Iterable[object]) -> pl.Series:
    """The names, as text, that each number of `index` (n,) refers to."""
    texts = [str(name) for name in names]
    return pl.Series(index).replace_strict(range(len(texts)), texts, return_dtype=pl.String)


def table_of(
    times: Float[np.ndarray, " T"], ids: Int[np.ndarray, " n"], columns: Mapping[str, Float[np.ndarray, "n T"]]
) -> pl.DataFrame:
    """A row per tag and time: `t_s`, `tag`, and the columns, each (n, T); NaN becomes an empty cell."""
    rows = {"t_s": np.tile(times, len(ids)), "tag": named(np.repeat(np.arange(len(ids)), len(times)), ids)}
    return pl.DataFrame(rows | {name: pl.Series(values.ravel(), nan_to_null=True) for name, values in columns.items()})


def axes_m(positions: Float[np.ndarray, "n T axes"]) -> dict[str, Float[np.ndarray, "n T"]]:
    """The columns `x_m`, `y_m` and, of three coordinates, `z_m` of positions (n, T, 2 or 3), m."""
    return {f"{axis}_m": values for axis, values in zip("xyz", np.moveaxis(positions, -1, 0), strict=False)}


def folder_of(
    name: str, tables: Mapping[str, pl.DataFrame], tags: Mapping[str, Tag] | np.ndarray, **geometry: Any
) -> RecordingFolder:
    """The recording folder of the tables, sorted by time.

    `tags`: by name, or the ids of tags without a known height or offset. `geometry`: further fields of the rig.
    """
    known = tags if isinstance(tags, Mapping) else {str(i): Tag() for i in tags}
    rig = Rig(name, tags=known, about="Simulated, see manifest.json.", **geometry)
    return RecordingFolder(name, None, rig, {k: t.sort("t_s", maintain_order=True) for k, t in tables.items()})
