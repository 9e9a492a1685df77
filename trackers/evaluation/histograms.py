"""Sums with histograms instead of rows: a million rows need no more memory than a thousand, and parts add up.

Percentiles are interpolated in bins of 2 %; of few values they are exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.evaluation.metrics import LARGEST, QUANTILES, RESIDUALS, sums

SMALLEST, BIN_WIDTH, BINS = 1e-6, 0.02, 1201
"""Bins from 1e-6 to 2.6e4 (m, rad or NEES), of relative width BIN_WIDTH; other values fall in the end bins."""

EDGES = SMALLEST * np.exp(BIN_WIDTH * np.arange(BINS))
"""Upper edges of the bins."""

EXACT = 2000
"""Values that are kept beside a histogram: of more rows a percentile differs little by its bins."""


class Totals:
    """Sums of scored rows of recordings that are added one after another."""

    def __init__(self) -> None:
        self.sums: list[Mapping[str, Any]] = []
        self.histograms: dict[str, np.ndarray] = {}
        self.values: dict[str, list[float]] = {}

    def add(self, part: Mapping[str, Any]) -> None:
        """Adds what `plain_sums` returned."""
        self.sums.append(part["sums"])
        for kind, (cells, counts) in part["histograms"].items():
            histogram = self.histograms.setdefault(kind, np.zeros((1, BINS), np.int64))
            histogram[0, np.array(cells, int)] += np.array(counts, int)
            self.values.setdefault(kind, []).extend(part["values"].get(kind, ()))
            if histogram.sum() > EXACT:
                self.values[kind] = []

    def frame(self) -> pl.DataFrame:
        """The sums of all, as of `metrics.sums`."""
        table, most = pl.DataFrame(self.sums, infer_schema_length=None), {*LARGEST, *RESIDUALS}
        whole = table.select(pl.col(x).max() if x in most else pl.col(x).sum() for x in table.columns)
        exact = {
            name: float(np.quantile(self.values[kind], share))
            for name, (share, kind) in _SHARES.items()
            if self.values.get(kind)
        }
        return with_quantiles(whole, self.histograms).with_columns(**exact)


def plain_sums(rows: pl.DataFrame, ratios: Mapping[str, tuple[float, float]]) -> dict[str, dict[str, Any]]:
    """Sums, histograms and, where they are few, values of the scored rows of one recording, as JSON holds them.

    `ratios`: by recording, its `residual_ratios`.
    """
    whole = sums(rows).drop(*QUANTILES, strict=False).row(0, named=True)
    found = dict.fromkeys(RESIDUALS) | dict(zip(RESIDUALS, next(iter(ratios.values()), ()), strict=False))
    plain: dict[str, dict[str, Any]] = {"sums": whole | found, "histograms": {}, "values": {}}
    for kind in dict.fromkeys(kind for _, kind in _SHARES.values()):
        name = kind if kind.startswith("nees") else f"size_{kind}"
        if name in rows.columns:
            values = rows[name].drop_nulls().to_numpy()
            values = values[np.isfinite(values)]
            cells, counts = np.unique(bins(values), return_counts=True)
            plain["histograms"][kind] = cells.tolist(), counts.tolist()
            if len(values) <= EXACT:
                plain["values"][kind] = values.tolist()
    return plain


_SHARES = {name: (float(share), kind) for name in QUANTILES for share, _, kind in [name.partition(" ")]}


def with_quantiles(whole: pl.DataFrame, histograms: Mapping[str, np.ndarray]) -> pl.DataFrame:
    """Sums (g,) with quantiles from histograms (g, BINS) by kind of error, or NEES."""
    quantiles = {
        name: quantile(histograms[kind], share) for name, (share, kind) in _SHARES.items() if kind in histograms
    }
    # A value interpolated in the bin of the largest error may lie beyond it.
    most = {name: f"largest {kind}" for name, (_, kind) in _SHARES.items() if f"largest {kind}" in whole.columns}
    found = whole.with_columns(pl.Series(name, x, nan_to_null=True) for name, x in quantiles.items())
    return found.with_columns(pl.min_horizontal(name, most[name]).alias(name) for name in quantiles if name in most)


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
