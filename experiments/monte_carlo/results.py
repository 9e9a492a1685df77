"""Metrics of a study with bootstrap intervals, paired over trackers, worlds and points of the grid.

Trajectories are resampled, not rows, since errors of one trajectory are correlated. All trackers and conditions share
the resamplings: their trajectories have the same ids and random numbers, so intervals of differences are paired ones.
Beyond 512 trajectories, blocks of them (id modulo 512) are resampled, at constant memory.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.monte_carlo.declaration import Condition, Study
from trackwright.experiments.monte_carlo.scores import BIN_WIDTH, BINS, EDGES
from trackwright.experiments.text.expectations import Value
from trackwright.trackers.evaluation.metrics import METRICS, QUANTILES, metrics
from trackwright.trackers.recordings.columns import float_column

BLOCKS, REPLICATES, LEVEL = 512, 1000, 0.95


class Totals:
    """The totals of a condition and tracker over the chunks that are added in order, in blocks of trajectories.
    `measures`: name -> (n,) of all trajectories, `bounds` (2,) m, `us_per_row`. `seconds`: computing time of the chunks
    for all trackers, compiling included; only in the totals of a condition's first tracker."""

    def __init__(self, runs: int):
        self.blocks, self.runs = min(runs, BLOCKS), runs
        self.sums: dict[str, np.ndarray] = {}
        self.largest: dict[str, np.ndarray] = {}
        self.histograms: dict[str, np.ndarray] = {}
        self.measures: dict[str, np.ndarray] = {}
        self.bounds, self.us_per_row, self.seconds = np.full(2, np.nan), np.nan, 0.0

    def scores(self, weights: np.ndarray) -> pl.DataFrame:
        """The sums (r,) as of `metrics.sums` where block k counts `weights[:, k]` times, (r, blocks)."""
        sums = dict(zip(self.sums, (weights @ np.stack([*self.sums.values()], axis=-1)).T, strict=True))
        for kind, top in self.largest.items():
            most = np.where(weights > 0, np.nan_to_num(top, nan=-np.inf), -np.inf).max(axis=1)
            sums[f"largest {kind}"] = np.where(np.isinf(most), np.nan, most)
        # Trajectories have no time lost, but rows.
        whole = pl.DataFrame(sums, nan_to_null=True).with_columns(pl.lit(0.0).alias(f"{x} s") for x in ("lost", "span"))
        return with_quantiles(whole, {kind: weights @ x for kind, x in self.histograms.items()})

    def add(self, start: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Add a chunk whose first trajectory is `start`; trajectories beyond the last run are left out."""
        count = min(len(arrays["sum n"]), self.runs - start)
        blocks = (start + np.arange(count)) % self.blocks
        for name, values in arrays.items():
            what, _, rest = name.partition(" ")
            if what == "sum":
                np.add.at(self.sums.setdefault(rest, np.zeros(self.blocks)), blocks, values[:count])
            elif what == "largest":
                np.fmax.at(self.largest.setdefault(rest, np.full(self.blocks, np.nan)), blocks, values[:count])
            elif what == "cells":
                table = self.histograms.setdefault(rest, np.zeros((self.blocks, BINS)))
                cell = np.cumsum(values, dtype=int)
                track, at = np.divmod(cell[cell < count * BINS], BINS)
                # To one axis numbers are added ten times as fast as to two.
                np.add.at(table.ravel(), BINS * blocks[track] + at, arrays[f"counts {rest}"][: len(at)].astype(float))
            elif what == "measure":
                self.measures.setdefault(rest, np.full(self.runs, np.nan))[start : start + count] = values[:count]
        self.bounds = arrays.get("bounds", self.bounds)
        self.us_per_row = float(arrays.get("us_per_row", self.us_per_row))
        self.seconds += float(arrays.get("seconds", 0.0))


CONSTANT = ("bound_m", "bound_3d_m", "us_per_row")
NAMES = (*METRICS, *CONSTANT)


class Results:
    """Metrics of a finished study. `totals`: by condition and tracker."""

    def __init__(self, study: Study, totals: Mapping[tuple[int, str], Totals]):
        self.study, self.totals = study, totals
        self._metrics: dict[tuple[int, str], dict[str, tuple[Any, np.ndarray]]] = {}

    def value(self, metric: str, world: str, tracker: str, **point: Any) -> Value:
        """A metric, or the mean of a measure, with its interval; NaN where no trajectory has it."""
        return self.at(metric, self.study.condition(world, **point), tracker)

    def at(self, metric: str, condition: Condition, tracker: str) -> Value:
        """The same, by condition."""
        return _interval(*self._replicated(metric, condition, tracker))

    def difference(self, metric: str, world: str, tracker: str, other: str, **point: Any) -> Value:
        """A tracker's metric minus another's, paired."""
        return self.compared(np.subtract, metric, self.study.condition(world, **point), tracker, other)

    def ratio(self, metric: str, world: str, tracker: str, other: str, **point: Any) -> Value:
        """A tracker's metric over another's, paired."""
        return self.compared(np.divide, metric, self.study.condition(world, **point), tracker, other)

    def compared(
        self, how: Callable[[Any, Any], Any], metric: str, condition: Condition, tracker: str, other: str
    ) -> Value:
        """`how` of two trackers' metrics in a condition, paired."""
        mine, its = self._replicated(metric, condition, tracker), self._replicated(metric, condition, other)
        return _interval(how(mine[0], its[0]), how(mine[1], its[1]))

    def average(self, metric: str, pairs: Sequence[tuple[str, str]], **point: Any) -> Value:
        """The mean of a metric over pairs of world and tracker, all resampled together."""
        of = [self._replicated(metric, self.study.condition(world, **point), tracker) for world, tracker in pairs]
        return _interval(np.mean([d[0] for d in of]), np.mean([d[1] for d in of], axis=0))

    def main_metrics(self) -> dict[str, dict[tuple[int, str], Value]]:
        """The metrics of the study's tables, each by condition and tracker."""
        pairs = [(c, t) for c in self.study.conditions for t in self.study.trackers]
        return {f: {(c.index, t): self.at(f, c, t) for c, t in pairs} for f in self.study.metrics}

    @property
    def seconds(self) -> float:
        """Computing time of all chunks, over all runs, machines and devices."""
        return sum(totals.seconds for totals in self.totals.values())

    def numbers(self, measure: str, world: str, tracker: str, **point: Any) -> np.ndarray:
        """A measure's numbers (n,), one per trajectory."""
        return self.totals[self.study.condition(world, **point).index, tracker].measures[measure]

    def _replicated(self, metric: str, condition: Condition, tracker: str) -> tuple[Any, np.ndarray]:
        """A metric of all trajectories, and of the resamplings (R,)."""
        totals = self.totals[condition.index, tracker]
        if metric in CONSTANT:
            value = totals.us_per_row if metric == "us_per_row" else totals.bounds[int(metric == "bound_3d_m")]
            return value, np.full(REPLICATES, value)
        weights = resampled(self.study.seed, totals.blocks)
        if metric in totals.measures:
            return _mean_of(totals.measures[metric], weights)
        if metric not in METRICS:
            raise KeyError(f"no metric '{metric}'; there are {', '.join((*NAMES, *totals.measures))}")
        key = (condition.index, tracker)
        if key not in self._metrics:
            # All metrics at once: histograms of all resamplings take megabytes, metrics kilobytes.
            self._metrics[key] = _metrics_of(totals, weights)
        return self._metrics[key].get(metric, (np.nan, np.full(REPLICATES, np.nan)))


def _metrics_of(totals: Totals, weights: np.ndarray) -> dict[str, tuple[Any, np.ndarray]]:
    """All metrics of all trajectories, and of the resamplings (R,)."""
    found = metrics(totals.scores(np.vstack([np.ones(weights.shape[1]), weights]))).drop("lost_s")
    return {name: (x[0], x[1:]) for name in found.columns for x in [float_column(found, name)]}


@functools.lru_cache(maxsize=8)
def resampled(seed: int, count: int) -> np.ndarray:
    """How often each of `count` items occurs in each resampling with replacement (REPLICATES, count)."""
    rng = np.random.default_rng([seed, count])
    return rng.multinomial(count, np.full(count, 1.0 / count), size=REPLICATES).astype(float)


def _mean_of(numbers: np.ndarray, weights: np.ndarray) -> tuple[float, np.ndarray]:
    """The mean of the finite numbers, and of each resampling of blocks."""
    known = np.isfinite(numbers)
    block, count = np.arange(len(numbers)) % weights.shape[1], weights.shape[1]
    sums = np.bincount(block, np.where(known, numbers, 0.0), count)
    sizes = np.bincount(block, known.astype(float), count)
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(sums.sum() / sizes.sum()), (weights @ sums) / (weights @ sizes)


def _interval(value: Any, replicates: np.ndarray) -> Value:
    known = replicates[np.isfinite(replicates)]
    if not len(known) or not np.isfinite(value):
        return Value(float(value) if np.isfinite(value) else np.nan, np.nan, np.nan)
    low, high = np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Value(float(value), float(low), float(high))


def with_quantiles(whole: pl.DataFrame, histograms: Mapping[str, np.ndarray]) -> pl.DataFrame:
    """Sums (g,) with quantiles from histograms (g, BINS) by kind of error, whose largest is known."""
    for name in QUANTILES:
        share, _, kind = name.partition(" ")
        if kind in histograms:
            found = pl.Series(name, quantile(histograms[kind], float(share)), nan_to_null=True)
            # A value interpolated in the bin of the largest error may lie beyond it.
            whole = whole.with_columns(found).with_columns(pl.min_horizontal(name, f"largest {kind}").alias(name))
    return whole


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
