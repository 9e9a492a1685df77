"""Columns of tables as arrays: numbers, rows by tag with their masks, and the true paths between rows of truth."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.data import HOLE_M, HOLE_S
from trackwright.trackers.core.errors import UnusableInput

QUATERNION = ("qw", "qx", "qy", "qz")

PIECE_S, PIECE_M = 5.0, 1.0  # least duration and way of a piece of time with independent errors
_NUMERIC = ("_s", "_m", "_m2", "_rad", "nis", "nis_dof")  # endings of numeric columns of estimates and truth


def float_column(frame: pl.DataFrame, name: str) -> np.ndarray:
    """The column as float64 (n,), NaN where a value is missing; all NaN if the table has no such column."""
    if name not in frame.columns:
        return np.full(len(frame), np.nan)
    column = frame[name].cast(pl.Float64)
    return (column.fill_null(np.nan) if column.null_count() else column).to_numpy()


class TagRows:
    """The rows of a table as columns, one tag after another, each tag's in the order of the table.

    `tags`: by first appearance. `starts` (tags + 1,): first of the N rows of each tag, then N. `times` (N,): s.
    """

    def __init__(self, table: pl.DataFrame) -> None:
        tags = table["tag"].cast(pl.String)
        self.tags = tags.unique(maintain_order=True).to_list()
        number = codes(tags, self.tags)
        self.starts = np.concatenate([[0], np.cumsum(np.bincount(number, minlength=len(self.tags)))]).astype(int)
        self._order: Any = slice(None) if len(self.tags) == 1 else stable_order(number)
        self._table = table
        self.times = float_column(table, "t_s")[self._order]

    def __contains__(self, name: str) -> bool:
        return name in self._table.columns

    def floats(self, names: Sequence[str]) -> np.ndarray:
        """The columns (N, m) as float64, NaN where a value is missing; all NaN for a column that the table lacks."""
        # Each column is contiguous.
        return np.array([float_column(self._table, name)[self._order] for name in names]).T

    def codes(self, name: str, ids: Sequence[str]) -> np.ndarray:
        """The numbers in `ids` of the ids in a column (N,)."""
        return codes(self._table[name], ids)[self._order].astype(int)

    def values(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """The columns as values (N, m), zero where one is missing, and the mask (N, m) of the values present."""
        values = self.floats(names)
        seen = np.isfinite(values)
        return values if seen.all() else np.where(seen, values, 0.0), seen

    def variances(self, names: Sequence[str]) -> np.ndarray:
        """The squares of standard deviations (N, m), zero where none is reported."""
        return np.nan_to_num(self.floats(names)) ** 2

    def of_each(self, per_tag: np.ndarray) -> np.ndarray:
        """A number of every tag (tags, …), repeated in each of its rows (N, …)."""
        return np.repeat(per_tag, np.diff(self.starts), axis=0)


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


def require_columns(frame: pl.DataFrame, columns: list[str], what: str) -> None:
    """Raises UnusableInput for a missing column, text in a numeric one, or numbers in `status`; `what`: the table."""
    numeric = {name: kind.is_numeric() or kind == pl.Null for name, kind in frame.schema.items()}
    wrong = [f"no column {name}" for name in columns if name not in numeric]
    wrong += [f"column {name} holds text" for name in numeric if name.endswith(_NUMERIC) and not numeric[name]]
    wrong += ["column status holds numbers, no words such as ok, lost, waiting"] * numeric.get("status", False)
    if wrong:
        found = ", ".join(numeric) or "none"
        raise UnusableInput(f"{what}: {wrong[0]}; found {found}; expected the table of `track` or a truth; correct it")


class TruthStatus(IntEnum):
    """Whether an estimate is scored against truth, and the reason if it is not."""

    SCORED = 0
    NO_ESTIMATE = 1
    NO_TRUTH = 2
    HOLE = 3


class TruePaths:
    """The true paths of rows by tag: positions at sorted times, no two of a tag equal, interpolated between them.

    `starts` (paths + 1,): the first row of each of `tags`, then their number n. `positions` (n, 3) m: z is NaN where
    unknown.
    """

    def __init__(self, rows: TagRows) -> None:
        self.number = {tag: k for k, tag in enumerate(rows.tags)}
        self.starts, self.times, self.positions = rows.starts, rows.times, rows.floats(("x_m", "y_m", "z_m"))
        self._rows = rows

    @classmethod
    def of_table(cls, truth: pl.DataFrame, recording: str) -> TruePaths:
        """The paths of a truth; rows without x or y are left out. `recording`: its name in refusals (UnusableInput)."""
        require_columns(truth, ["t_s", "tag", "x_m", "y_m"], f"the truth of recording '{recording}'")
        known = pl.all_horizontal(pl.col("t_s", "x_m", "y_m").is_finite())
        present = truth.with_columns(pl.col("tag").cast(pl.String)).filter(known)
        present = present.unique(["tag", "t_s"], keep="first", maintain_order=True)
        return cls(TagRows(present.sort("t_s", maintain_order=True)))

    @cached_property
    def headings(self) -> np.ndarray | None:
        """The headings (n,) of the bodies about the vertical, rad, NaN where they are not known; None for all."""
        if QUATERNION[0] not in self._rows:
            return None
        w, x, y, z = self._rows.floats(QUATERNION).T
        return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))

    def headings_at(self, tags: Sequence[str], starts: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Headings (N,), rad, interpolated at rows as in `at`; NaN where unknown, also in holes of the attitudes."""
        result = np.full(len(times), np.nan)
        for tag, first, end in zip(tags, starts[:-1], starts[1:], strict=True):
            if self.headings is None or tag not in self.number:
                continue
            part = slice(*self.starts[self.number[tag] :][:2])
            known = np.isfinite(self.headings[part])
            if known.any():
                angles = np.unwrap(self.headings[part][known])
                known_times, asked = self.times[part][known], times[first:end]
                before, after = (np.searchsorted(known_times, asked, side) for side in ("left", "right"))
                gaps = np.diff(known_times, prepend=-np.inf, append=np.inf)
                values = np.interp(asked, known_times, angles, np.nan, np.nan)
                result[first:end] = np.where((before == after) & (gaps[before] > HOLE_S), np.nan, values)
        return result

    def at(self, tags: Sequence[str], starts: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """True positions (N, 3), m, of tag k at rows from `starts[k]`, NaN if unknown, and `TruthStatus` (N,)."""
        number, lengths = np.array([self.number.get(tag, -1) for tag in tags], int), np.diff(starts)
        if len(self.times) and (number >= 0).all() and np.array_equal(lengths, np.diff(self.starts)[number]):
            rows = np.arange(len(times)) + np.repeat(self.starts[number] - starts[:-1], lengths)
            if np.array_equal(self.times[rows], times):  # as in studies
                return self.positions.take(rows, axis=0), np.full(len(times), TruthStatus.SCORED, np.uint8)
        path = np.repeat(number, lengths)
        status, position = np.full(len(times), TruthStatus.NO_TRUTH, np.uint8), np.full((len(times), 3), np.nan)
        if not len(self.times):
            return position, status
        first, last = self.starts[:-1][path], self.starts[1:][path] - 1
        inside = np.flatnonzero((path >= 0) & (times >= self.times[first]) & (times <= self.times[last]))
        asked = times[inside]
        after = first_not_before(self.times, first[inside], last[inside], asked)
        before = np.where(self.times[after] == asked, after, after - 1)
        span, here, there = self.times[after] - self.times[before], self.positions[before], self.positions[after]
        # In the order of np.interp.
        slope = (there - here) / np.where(span > 0.0, span, 1.0)[:, None]
        position[inside] = slope * (asked - self.times[before])[:, None] + here
        hole = (span > HOLE_S) & (np.sqrt(np.nansum((there - here) ** 2, axis=1)) > HOLE_M)
        position[inside[hole]] = np.nan
        status[inside] = np.where(hole, TruthStatus.HOLE, TruthStatus.SCORED)
        return position, status


def independent_pieces(times: np.ndarray, positions: np.ndarray, starts: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The piece of time of each row (n,): a new one after `PIECE_S` and `PIECE_M` of the tag that moves most."""
    # The way of the tag that moves most stands for all of them: tags on one body move together.
    ways = []
    for begin, end in pairwise(starts):
        index = begin + np.flatnonzero(known[begin:end])
        if len(index) > 1:
            steps = np.linalg.norm(np.diff(positions[index], axis=0), axis=1)
            ways.append((times[index], np.append(0.0, np.cumsum(steps))))
    if not ways:
        return np.zeros(len(times), int)
    of_most, way = max(ways, key=lambda pair: pair[1][-1])
    begins, last = [of_most[0]], (of_most[0], 0.0)
    for time, gone in zip(of_most, way, strict=True):
        if time - last[0] >= PIECE_S and gone - last[1] >= PIECE_M:
            begins.append(time)
            last = (time, gone)
    return np.searchsorted(np.array(begins), times, side="right")


def first_not_before(times: np.ndarray, low: np.ndarray, high: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The first index in `low` … `high` (N,) of a time that is not before `wanted` (N,); `high` where all are before.

    `times` (n,): sorted between each pair of `low` and `high`.
    """
    for _ in range(int((high - low).max(initial=0)).bit_length()):
        middle = (low + high) // 2
        earlier = times[middle] < wanted
        low, high = np.where(earlier & (low < high), middle + 1, low), np.where(earlier, high, middle)
    return high
