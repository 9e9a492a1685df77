"""Percentiles from histograms with bins of 2 %: a million rows of a study need no more memory than a thousand."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import polars as pl

from trackwright.trackers.evaluation.metrics import QUANTILES

SMALLEST, BIN_WIDTH, BINS = 1e-6, 0.02, 1201
"""Bins from 1e-6 to 2.6e4 (m, rad or NEES), of relative width BIN_WIDTH; other values fall in the end bins."""

EDGES = SMALLEST * np.exp(BIN_WIDTH * np.arange(BINS))
"""Upper edges of the bins."""


def with_quantiles(whole: pl.DataFrame, histograms: Mapping[str, np.ndarray]) -> pl.DataFrame:
    """Sums (g,) with quantiles from histograms (g, BINS) by kind of error, whose largest is known."""
    for name in QUANTILES:
        share, _, kind = name.partition(" ")
        if kind in histograms:
            found = pl.Series(name, quantile(histograms[kind], float(share)), nan_to_null=True)
            # A value interpolated in the bin of the largest error may lie beyond it.
            whole = whole.with_columns(found).with_columns(pl.min_horizontal(name, f"largest {kind}").alias(name))
    return whole


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
