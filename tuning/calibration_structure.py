"""Whether the ranges of an anchor contradict the straight line fitted to their errors."""

from __future__ import annotations

import numpy as np
import polars as pl
from scipy.stats import f_oneway

INTERVALS = 6
"""Intervals of distance with the same number of readings."""

LEAST_READINGS, LEAST_PIECES = 3, 3
"""The least readings of a median, and the least medians of an interval."""

LEVEL = 0.001
"""Level of the test."""


def differs_by_distance(distance: np.ndarray, errors: np.ndarray, piece: np.ndarray, spread: float) -> bool:
    """Whether errors (N,), m, that a line left at distances (N,), m, differ systematically between distances.

    One-way analysis of variance between intervals of distance; its samples are medians of the pieces of time (N,),
    whose errors count as independent. The means of the intervals must also differ by half the `spread` of errors, m.
    """
    known = np.isfinite(errors)
    edges = np.quantile(distance[known], np.linspace(0, 1, INTERVALS + 1)[1:-1]) if known.any() else np.zeros(0)
    interval = np.searchsorted(edges, distance[known])
    rows = pl.DataFrame({"interval": interval, "piece": piece[known], "error": errors[known]})
    medians = rows.group_by("interval", "piece").agg(pl.col("error").median(), pl.len())
    medians = medians.filter(pl.col("len") >= LEAST_READINGS).group_by("interval", maintain_order=True).agg("error")
    samples = [np.array(one) for one in medians["error"].to_list() if len(one) >= LEAST_PIECES]
    if len(samples) < 2:
        return False
    means = [float(np.mean(one)) for one in samples]
    return bool(f_oneway(*samples).pvalue < LEVEL and max(means) - min(means) > 0.5 * spread)
