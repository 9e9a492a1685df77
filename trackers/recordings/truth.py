"""Ground truth of a recording: true paths by tag, and their interpolation at the times of estimates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import HOLE_M, HOLE_S, first_not_before
from trackwright.trackers.recordings.columns import TableRows, TagRows, require_columns
from trackwright.trackers.recordings.kinds import QUATERNION

PIECE_S, PIECE_M = 5.0, 1.0
"""Least duration, s, and way, m, of a piece of time: errors of different pieces count as independent."""


class TruthStatus(IntEnum):
    """Whether an estimate is scored against truth, and the reason if it is not."""

    SCORED = 0
    NO_ESTIMATE = 1
    NO_TRUTH = 2
    HOLE = 3


class TruePaths:
    """The true paths of tags: positions at sorted times, no two of them equal, between which they are interpolated.

    `tags`: of the paths. `starts` (paths + 1,): the first row of each path, then their number n. `times` (n,) s and
    `positions` (n, 3) m: z is NaN where there is no height. `attitudes`: the quaternions (n, 4) of the bodies, NaN
    where they are not known, read with the first heading; None for none.
    """

    def __init__(
        self,
        tags: Sequence[str],
        starts: np.ndarray,
        times: np.ndarray,
        positions: np.ndarray,
        attitudes: Callable[[], np.ndarray] | None = None,
    ) -> None:
        self.number = {tag: k for k, tag in enumerate(tags)}
        self.starts, self.times, self.positions, self._attitudes = starts, times, positions, attitudes
        self._latest: list[tuple[Sequence[str], np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    @classmethod
    def none(cls) -> TruePaths:
        """No path at all."""
        return cls([], np.zeros(1, int), np.zeros(0), np.zeros((0, 3)))

    @classmethod
    def of_table(cls, truth: pl.DataFrame, recording: str) -> TruePaths:
        """The paths of a table with columns t_s, tag, x_m, y_m and optionally z_m; rows without x or y are left out.

        `recording`: its name, for messages. Raises UnusableInput.
        """
        require_columns(truth, ["t_s", "tag", "x_m", "y_m"], f"the truth of recording '{recording}'")
        present = truth.with_columns(pl.col("tag").cast(pl.String)).filter(
            pl.all_horizontal(pl.col("t_s", "x_m", "y_m").is_finite())
        )
        rows = TableRows(present)
        later = np.diff(rows.times) > 0
        later[rows.starts[1:-1] - 1] = True
        if not later.all():
            distinct = present.unique(["tag", "t_s"], keep="first", maintain_order=True)
            rows = TableRows(distinct.sort("t_s", maintain_order=True))
        return cls.of_rows(rows)

    @classmethod
    def of_rows(cls, rows: TagRows) -> TruePaths:
        """The paths of rows by tag, at sorted times, no two of a tag equal."""
        attitudes = partial(rows.floats, QUATERNION) if QUATERNION[0] in rows else None
        return cls(rows.tags, rows.starts, rows.times, rows.floats(("x_m", "y_m", "z_m")), attitudes)

    @cached_property
    def headings(self) -> np.ndarray | None:
        """The headings (n,) of the bodies about the vertical, rad, NaN where they are not known; None for all."""
        if self._attitudes is None:
            return None
        w, x, y, z = self._attitudes().T
        return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))

    def of_tag(self, tag: str) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) s and positions (n, 3) m of one path."""
        number = self.number[tag]
        part = slice(self.starts[number], self.starts[number + 1])
        return self.times[part], self.positions[part]

    def headings_at(self, tags: Sequence[str], starts: np.ndarray, times: np.ndarray) -> np.ndarray:
        """True headings (N,), rad, linearly interpolated, of rows as in `at`; NaN where they are not known.

        Nor are they between attitudes further apart than a hole of the truth may be long, whatever the way covered.
        """
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
        """True positions (N, 3), m, linearly interpolated at `times` (N,), s, and their `TruthStatus` (N,).

        The rows `starts[k]` … `starts[k + 1] − 1` are of tag `tags[k]`. NaN without a path, outside its span, in its
        holes, and at a time that is NaN. The results for the latest few sets of times are kept.
        """
        for known_tags, known_starts, known_times, positions, status in self._latest:
            if (
                np.array_equal(known_times, times, equal_nan=True)
                and np.array_equal(known_starts, starts)
                and list(known_tags) == list(tags)
            ):
                return positions, status
        positions, status = self._interpolated(tags, starts, times)
        self._latest = [*self._latest[-3:], (tags, starts, times, positions, status)]
        return positions, status

    def _interpolated(
        self, tags: Sequence[str], starts: np.ndarray, times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        number, lengths = np.array([self.number.get(tag, -1) for tag in tags], int), np.diff(starts)
        if len(self.times) and (number >= 0).all() and np.array_equal(lengths, np.diff(self.starts)[number]):
            rows = np.arange(len(times)) + np.repeat(self.starts[number] - starts[:-1], lengths)
            if np.array_equal(self.times[rows], times):
                return self.positions.take(rows, axis=0), np.full(len(times), TruthStatus.SCORED, np.uint8)
        path = np.repeat(number, lengths)
        status = np.full(len(times), TruthStatus.NO_TRUTH, np.uint8)
        position = np.full((len(times), 3), np.nan)
        if not len(self.times):
            return position, status
        first, last = self.starts[:-1][path], self.starts[1:][path] - 1
        inside = (path >= 0) & (times >= self.times[first]) & (times <= self.times[last])
        if not inside.all():
            path, times = path[inside], times[inside]
        after = self._first_not_before(path, times)
        inside_position, inside_status = self.positions[after], np.zeros(len(times), np.uint8)
        between = np.flatnonzero(self.times[after] != times)
        if len(between):
            inside_position[between], inside_status[between] = self._between(after[between], times[between])
        position[inside], status[inside] = inside_position, inside_status
        return position, status

    def _between(self, after: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and status at `times` between the rows before and at `after`."""
        before = after - 1
        span = self.times[after] - self.times[before]
        here, there = self.positions[before], self.positions[after]
        # In the order of np.interp.
        positions = (there - here) / span[:, None] * (times - self.times[before])[:, None] + here
        long = np.flatnonzero(span > HOLE_S)
        moved = np.sqrt(np.nansum((there[long] - here[long]) ** 2, axis=1))
        status = np.full(len(times), TruthStatus.SCORED, np.uint8)
        status[long[moved > HOLE_M]] = TruthStatus.HOLE
        positions[status == TruthStatus.HOLE] = np.nan
        return positions, status

    def _first_not_before(self, path: np.ndarray, times: np.ndarray) -> np.ndarray:
        """The first row of each path that is not before `times`, which lie within its span."""
        first = self.starts[:-1]
        lengths = np.diff(self.starts)
        if (lengths == lengths[0]).all():
            table = self.times.reshape(len(first), -1)
            if (table == table[0]).all():
                return first[path] + np.searchsorted(table[0], times)
        return first_not_before(self.times, first[path], self.starts[1:][path] - 1, times)


def independent_pieces(times: np.ndarray, positions: np.ndarray, starts: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The number of each row's piece of time (n,): a new one after `PIECE_S` and `PIECE_M`, the same for all tags.

    A tag that stands still stays in one piece, since its readings have the errors of one place. `times` (n,) s
    and `positions` (n, d) m of the tags, whose rows stand one after another from `starts` (tags + 1,); `known` (n,):
    where there is a position.
    """
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
