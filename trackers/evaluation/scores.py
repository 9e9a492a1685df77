"""Scores: sums over rows from which all error metrics follow, of groups of rows, and which add up.

A group is a track, a recording, a trajectory of a study or many of them. Counts, means, root mean squares, shares and
largest errors are exact. So are percentiles while the values are at hand; without them they are interpolated in
histograms with bins of 2 %, so that a million rows need no more memory than a thousand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from trackwright.trackers.core.data.consistency import chi_square_quantile

SMALLEST, BIN_WIDTH, BINS = 1e-6, 0.02, 1201
"""Bins from 1e-6 to 2.6e4 (m, rad or NEES), of relative width BIN_WIDTH; other values fall in the end bins."""

EDGES = SMALLEST * np.exp(BIN_WIDTH * np.arange(BINS))
"""Upper edges of the bins."""

EXACT = 2000
"""Values that are kept beside the histogram: of more rows a percentile differs little by its bins."""

SHARES = (0.5, 0.9, 0.95, 0.99)
"""Quantiles that are metrics: only at their ranks are values in order."""

LEVELS = (50, 68, 90, 95, 99)
"""Levels, %, of the ellipses whose share of the truth is a metric."""

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Values:
    """All values of some kind (n,), those of each of g groups in any order; `starts` (g + 1,) of the groups.

    They are ordered when the first quantile is asked for: few ask for those of every track.
    """

    values: np.ndarray
    starts: np.ndarray

    @cached_property
    def _ordered(self) -> np.ndarray:
        """Those of each group in ascending order; of a single one only those at the ranks of `SHARES` in their places.

        That takes a third of the time.
        """
        ordered, lengths = np.array(self.values, float), np.diff(self.starts)
        if len(lengths) == 1 and len(ordered):
            lower = np.floor(_ranks(np.array(SHARES), lengths)).astype(int)
            ordered.partition(np.append(lower, np.minimum(lower + 1, len(ordered) - 1)))
        elif len(lengths) and (lengths == lengths[0]).all():
            ordered.reshape(len(lengths), -1).sort(axis=1)
        else:
            for a, b in pairwise(self.starts.tolist()):
                ordered[a:b].sort()
        return ordered

    def quantile(self, share: float) -> np.ndarray:
        """The quantile (g,), linear between order statistics, NaN of none; ValueError for none of `SHARES`."""
        if share not in SHARES:
            raise ValueError(f"the quantile {share} is none of {SHARES}: add it to SHARES in {__name__}")
        count = np.diff(self.starts)
        rank = _ranks(share, count)
        quantiles, some = np.full(len(count), np.nan), count > 0
        lower = np.floor(rank[some]).astype(int)
        first = self.starts[:-1][some]
        below = self._ordered[first + lower]
        above = self._ordered[first + np.minimum(lower + 1, count[some] - 1)]
        # An infinite value above one of rank 0 has no weight.
        part = rank[some] - lower
        quantiles[some] = np.where(part > 0, below + part * (above - below), below)
        return quantiles


def _ranks(share: float | np.ndarray, count: np.ndarray) -> np.ndarray:
    """The ranks from 0 of quantiles of so many values (Hyndman & Fan 1996, definition 7)."""
    return 100 * share * ((count - 1) / 100.0)


@dataclass(frozen=True)
class Scores:
    """Sums over the rows of each of g groups.

    `sums` (g,) by name. By kind of error, `largest` (g,), NaN of none. By kind of error, and `nees` and `nees_3d`:
    `histograms` (g, BINS), and `values`, all of them where they are at hand.
    """

    sums: Arrays
    largest: Arrays
    histograms: Arrays = field(default_factory=dict)
    values: Mapping[str, Values] = field(default_factory=dict)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.sums[name]

    def quantile(self, name: str, share: float) -> np.ndarray:
        """The quantile (g,) of errors of a kind or of NEES; NaN of none."""
        if name in self.values:
            return self.values[name].quantile(share)
        # One interpolated in the bin of the largest error may lie beyond it.
        return np.fmin(quantile(self.histograms[name], share), self.largest.get(name, np.inf))

    def __add__(self, other: Scores) -> Scores:
        """The scores of one group from those of two parts, which have histograms."""
        return Scores(
            {name: x + other.sums[name] for name, x in self.sums.items()},
            {name: np.fmax(x, other.largest[name]) for name, x in self.largest.items()},
            {name: x + other.histograms[name] for name, x in self.histograms.items()},
            {
                name: Values(np.concatenate([x.values, other.values[name].values]), np.array([0, n]))
                for name, x in self.values.items()
                if name in other.values and (n := len(x.values) + len(other.values[name].values)) <= EXACT
            },
        )

    def grouped(self, starts: np.ndarray) -> Scores:
        """The scores of groups of the groups, which have their values; `starts` (h + 1,): their first, then g."""
        groups = Groups(starts)
        return Scores(
            {name: groups.sum(x) for name, x in self.sums.items()},
            {name: groups.max(x) for name, x in self.largest.items()},
            {},
            {name: Values(x.values, x.starts[starts]) for name, x in self.values.items()},
        )

    def condensed(self) -> Scores:
        """The same with histograms, and with values only where they are few."""
        histograms = {
            name: np.stack([np.bincount(bins(x.values[a:b]), minlength=BINS) for a, b in pairwise(x.starts)])
            for name, x in self.values.items()
        }
        few = {name: x for name, x in self.values.items() if len(x.values) <= EXACT}
        return Scores(self.sums, self.largest, histograms, few)

    def total(self) -> Scores:
        """The scores of all groups as one, from their histograms."""
        sums = np.stack([*self.sums.values()], axis=-1).sum(axis=0)
        return Scores(
            {name: x[None] for name, x in zip(self.sums, sums, strict=True)},
            {name: np.fmax.reduce(x, keepdims=True) for name, x in self.largest.items()},
            {name: x.sum(axis=0, keepdims=True) for name, x in self.histograms.items()},
        )

    def weighted(self, weights: np.ndarray) -> Scores:
        """The scores of r groups in which group k of these occurs `weights[:, k]` times, (r, g), from histograms."""
        sums, there = (weights @ np.stack([*self.sums.values()], axis=-1)).T, weights > 0
        largest = {
            name: np.where(there, np.nan_to_num(x, nan=-np.inf), -np.inf).max(axis=1)
            for name, x in self.largest.items()
        }
        return Scores(
            dict(zip(self.sums, sums, strict=True)),
            {name: np.where(np.isinf(x), np.nan, x) for name, x in largest.items()},
            {name: weights @ x for name, x in self.histograms.items()},
        )

    def plain(self) -> dict[str, Any]:
        """The scores of one group as JSON holds them, of histograms the filled bins."""
        return {
            "sums": {name: x.item() for name, x in self.sums.items()},
            "largest": {name: x.item() for name, x in self.largest.items()},
            "histograms": {
                name: [(filled := np.flatnonzero(x[0])).tolist(), x[0, filled].tolist()]
                for name, x in self.histograms.items()
            },
            "values": {name: x.values.tolist() for name, x in self.values.items()},
        }

    @classmethod
    def from_plain(cls, content: Mapping[str, Mapping[str, Any]]) -> Scores:
        """The scores that `plain` returned."""
        histograms = {name: np.zeros((1, BINS), np.int64) for name in content["histograms"]}
        for name, (cells, counts) in content["histograms"].items():
            histograms[name][0, cells] = counts
        return cls(
            {name: np.array([x]) for name, x in content["sums"].items()},
            {name: np.array([x], float) for name, x in content["largest"].items()},
            histograms,
            {name: Values(np.array(x, float), np.array([0, len(x)])) for name, x in content["values"].items()},
        )


class Rows(Protocol):
    """How rows form groups."""

    @property
    def count(self) -> np.ndarray:
        """The number of rows (g,)."""

    def sum(self, values: np.ndarray) -> np.ndarray:
        """The sums (g,) of values of the rows."""

    def max(self, values: np.ndarray) -> np.ndarray:
        """The largest values (g,), NaN of none."""


class Groups:
    """Rows that stand one after the other in g groups; `starts` (g + 1,): the first of each, then their number."""

    def __init__(self, starts: np.ndarray) -> None:
        self.starts, self.count = starts, np.diff(starts)
        self._even = len(self.count) > 0 and bool((self.count == self.count[0]).all()) and self.count[0] > 0

    def sum(self, values: np.ndarray) -> np.ndarray:
        """The sums (g,) of values (n,)."""
        return self._reduced(np.add, values.view(np.int8) if values.dtype == bool else values, 0)

    def max(self, values: np.ndarray) -> np.ndarray:
        """The largest (g,) of values (n,), NaN of none."""
        return self._reduced(np.fmax, values, np.nan)

    def where(self, mask: np.ndarray, values: np.ndarray) -> tuple[Groups, np.ndarray]:
        """The groups of the rows in the mask (n,) alone, and those of the values (n,)."""
        return (self, values) if mask.all() else (Groups(np.append(0, np.cumsum(mask))[self.starts]), values[mask])

    def _reduced(self, how: np.ufunc, values: np.ndarray, first: float) -> np.ndarray:
        if self._even:
            reduced: np.ndarray = how.reduce(values.reshape(len(self.count), -1), axis=1)
            return reduced
        places, rows = self._padded
        padded = np.full(len(rows), first, values.dtype)
        padded[rows] = values
        return how.reduceat(padded, places)

    @cached_property
    def _padded(self) -> tuple[np.ndarray, np.ndarray]:
        """The first place of each group, which is no row's, and the mask of the places of rows.

        So empty groups have a sum, and others are added as np.sum adds them.
        """
        first = self.starts[:-1] + np.arange(len(self.count))
        rows = np.ones(int(self.starts[-1]) + len(first), bool)
        rows[first] = False
        return first, rows


def error_sums(kind: str, size: np.ndarray, rows: Rows) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The sums of errors of a kind and of this size, and the largest."""
    sums = {f"n {kind}": rows.count, f"sum {kind}": rows.sum(size), f"squares {kind}": rows.sum(size * size)}
    return sums, {kind: rows.max(size)}


def nees_sums(name: str, values: np.ndarray, dof: int, rows: Rows) -> dict[str, np.ndarray]:
    """The sums of NEES, `nees` or `nees_3d`, and how often the ellipse of each of the `LEVELS` has the truth."""
    inside = {p: rows.sum(values <= chi_square_quantile(p / 100, dof)) for p in LEVELS}
    return {
        f"n {name}": rows.count,
        f"sum {name}": rows.sum(values),
        **{f"inside {p} {name}": n for p, n in inside.items()},
    }


def bins(values: np.ndarray) -> np.ndarray:
    """The bin number of each value."""
    with np.errstate(divide="ignore"):
        at = np.ceil(np.log(np.maximum(values, 0.0) / SMALLEST) / BIN_WIDTH)
    return np.clip(at, 0, BINS - 1).astype(np.int64)


def quantile(histogram: np.ndarray, share: float) -> np.ndarray:
    """The quantile at `share` of histograms (..., BINS), as np.quantile defines it; NaN for empty ones.

    Between the two values nearest in rank, each taken from its bin, whose values are spread evenly on a logarithmic
    scale: off by less than a bin however few they are.
    """
    below = np.cumsum(histogram, axis=-1)
    rank = share * np.maximum(below[..., -1] - 1.0, 0.0)
    lower, upper = (_of_rank(histogram, below, whole) for whole in (np.floor(rank), np.ceil(rank)))
    return lower + (rank - np.floor(rank)) * (upper - lower)


def _of_rank(histogram: np.ndarray, below: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """The values of a rank from 0 of histograms (..., BINS) with cumulative sums `below`; NaN for empty ones."""
    at = np.argmax(below > rank[..., None], axis=-1)[..., None]
    inside = np.take_along_axis(np.asarray(histogram, float), at, -1)[..., 0]
    after = np.take_along_axis(below, at, -1)[..., 0] - rank - 0.5
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.where(below[..., -1] > 0, after / inside, np.nan)
    return EDGES[at[..., 0]] * np.exp(-BIN_WIDTH * part)
