"""Columns of tables as arrays: numbers, rows by tag with their masks, runs of equal keys, required columns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput

NUMERIC_ENDINGS = ("_s", "_m", "_m2", "_rad", "nis", "nis_dof")
"""Endings of the names of numeric columns in tables of estimates and of truth."""


def float_column(frame: pl.DataFrame, name: str) -> np.ndarray:
    """The column as float64 (n,), NaN where a value is missing; all NaN if the table has no such column."""
    if name not in frame.columns:
        return np.full(len(frame), np.nan)
    column = frame[name].cast(pl.Float64)
    # polars plans a query for each `fill_null`.
    return (column.fill_null(np.nan) if column.null_count() else column).to_numpy()


class TagRows(ABC):
    """The rows of a table as columns, one tag after another, each tag's in the order of the table.

    `tags`: in order of first appearance. `starts` (tags + 1,): the first of the N rows of each tag, then N. `times`
    (N,): s.
    """

    tags: list[str]
    starts: np.ndarray
    times: np.ndarray

    @abstractmethod
    def __contains__(self, name: str) -> bool:
        """Whether the table has a column of this name."""

    @abstractmethod
    def floats(self, names: Sequence[str]) -> np.ndarray:
        """The columns (N, m) as float64, NaN where a value is missing; all NaN for a column that the table lacks."""

    @abstractmethod
    def codes(self, name: str, ids: Sequence[str]) -> np.ndarray:
        """The numbers in `ids` of the ids in a column (N,)."""

    def count(self, name: str, ids: Sequence[str]) -> int:
        """How many of `ids` occur in a column."""
        return int(np.count_nonzero(np.bincount(self.codes(name, ids))))

    def values(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """The columns as values (N, m), zero where one is missing, and the mask (N, m) of the values present."""
        values = self.floats(names)
        seen = np.isfinite(values)
        return values if seen.all() else np.where(seen, values, 0.0), seen

    def variances(self, names: Sequence[str]) -> np.ndarray:
        """The squares of standard deviations (N, m), zero where none is reported."""
        if not any(name in self for name in names):
            return np.zeros((len(self.times), len(names)))
        return np.nan_to_num(self.floats(names)) ** 2

    def of_each(self, per_tag: np.ndarray) -> np.ndarray:
        """A number of every tag (tags, …), repeated in each of its rows (N, …)."""
        return np.repeat(per_tag, np.diff(self.starts), axis=0)


class TableRows(TagRows):
    """The rows of a data frame by tag; a column is brought into their order when it is first read."""

    def __init__(self, table: pl.DataFrame) -> None:
        tags = table["tag"].cast(pl.String)
        self.tags = tags.unique(maintain_order=True).to_list()
        number = codes(tags, self.tags)
        self.starts = np.concatenate([[0], np.cumsum(np.bincount(number, minlength=len(self.tags)))]).astype(int)
        self._order: Any = slice(None) if len(self.tags) == 1 else stable_order(number)
        self._table = table
        self.times = float_column(table, "t_s")[self._order]
        self._by_ids: dict[tuple[str, tuple[str, ...]], np.ndarray] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._table.columns

    def floats(self, names: Sequence[str]) -> np.ndarray:
        values = np.empty((len(names), len(self.times)))
        for column, name in zip(values, names, strict=True):
            column[:] = float_column(self._table, name)[self._order]
        # Each column is contiguous.
        return values.T

    def codes(self, name: str, ids: Sequence[str]) -> np.ndarray:
        key = name, tuple(ids)
        if key not in self._by_ids:
            self._by_ids[key] = codes(self._table[name], key[1])[self._order].astype(int)
        return self._by_ids[key]


def stable_order(numbers: np.ndarray) -> np.ndarray:
    """The order (N,) of numbers that are not negative; equal ones keep theirs."""
    # Numbers of two bytes are sorted without comparisons.
    return np.argsort(numbers.astype(np.uint16) if numbers.max(initial=0) < 2**16 else numbers, kind="stable")


def within_groups(counts: np.ndarray) -> np.ndarray:
    """0, 1, 2 … (N,) in each of the groups of `counts` (g,) rows, one group after another."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


def codes(column: pl.Series, ids: Sequence[str]) -> np.ndarray:
    """The numbers in `ids` of the ids in a column (N,)."""
    return column.cast(pl.Enum(ids)).to_physical().to_numpy()


def run_starts(rows: pl.DataFrame, keys: list[str]) -> np.ndarray:
    """Start indices (g + 1,) of the g runs of equal `keys` in sorted rows; the last entry is the number of rows."""
    if len(rows) == 0:
        return np.zeros(1, int)
    group = rows.select(pl.struct(keys).rle_id()).to_series().to_numpy()
    return np.concatenate([[0], np.flatnonzero(np.diff(group)) + 1, [len(rows)]])


def require_columns(frame: pl.DataFrame, columns: list[str], what: str) -> None:
    """Raises UnusableInput for a missing column, text in a numeric one, or numbers in `status`; `what`: the table."""
    missing = [name for name in columns if name not in frame.columns]
    if missing:
        raise UnusableInput(
            f"{what}: no column {', '.join(missing)}; found {', '.join(frame.columns) or 'none'}; "
            f"expected {', '.join(columns)}; give the table written by `trackwright track` or the truth of a recording"
        )
    text = [name for name in frame.columns if name.endswith(NUMERIC_ENDINGS) and not _is_numeric(frame.schema[name])]
    if text:
        raise UnusableInput(
            f"{what}: column {text[0]} holds {frame.schema[text[0]]}; expected numbers; convert the column"
        )
    if _is_numeric(frame.schema.get("status", pl.String())):
        raise UnusableInput(
            f"{what}: column status holds {frame.schema['status']}; expected words such as ok, lost, waiting; "
            "write the words or leave the column out"
        )


def _is_numeric(kind: pl.DataType) -> bool:
    return kind.is_numeric() or kind == pl.Null
