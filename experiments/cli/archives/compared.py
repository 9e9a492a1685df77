"""Trackers of an archive side by side: medians over recordings, and paired differences from the first tracker."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import polars as pl

from trackwright.experiments.cli.archives.tables import Run
from trackwright.experiments.pages.reports.comparison import BEARING_NAMES, Contrast, Table, adjusted, difference_table
from trackwright.experiments.text.wording import Unit, fixed, length_unit
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.comparison import LEAST_PIECES, METRICS, Difference, jackknifed

SHOWN = tuple(name for name in METRICS if "3d" not in name)
"""The metrics that are compared, those of the error first."""


def compared(runs: Sequence[Run]) -> list[Table]:
    """The trackers over the recordings that all have scored, of which each counts once; empty without one.

    The intervals are those of `paired_differences`, with recordings for pieces.
    """
    if len(runs) < 2 or len({run.bearing for run in runs}) > 1:
        return []
    bearing, names = runs[0].bearing, [run.short for run in runs]
    metrics = [BEARING_NAMES.get(name, name) if bearing else name for name in SHOWN]
    values = {name: found for name in metrics if (found := _common(runs, name)).size}
    rmse = values.get(metrics[0])
    if rmse is None:
        return []
    medians = {name: np.median(values[name], axis=1) for name in metrics[:3]}
    unit = Unit("°", 180 / math.pi) if bearing else length_unit(float(medians[metrics[0]].min()))
    lowest = (rmse == rmse.min(axis=0)).mean(axis=1)
    rows = [
        [name, *(fixed(own[k] * unit.factor, 2) for own in medians.values()), f"{100 * lowest[k]:.0f} %"]
        for k, name in enumerate(names)
    ]
    what = "Angles between directions" if bearing else "Horizontal position errors"
    head = ("tracker", "RMSE", "median", "p95", "lowest RMSE in")
    note = f"Medians over the {counted(rmse.shape[1], 'recording')} that all trackers have."
    over = Table(f"{what} in {unit.name}", head, 1, rows, note)
    contrasts = [
        Contrast("", metric, name, one := _difference(found[0], own), one.p)
        for metric, found in values.items()
        for name, own in zip(names[1:], found[1:], strict=True)
    ]
    differences = difference_table(names[0], adjusted(contrasts), unit)
    note = differences.note if rmse.shape[1] >= LEAST_PIECES else f"No intervals with fewer than {LEAST_PIECES}."
    return [over, differences._replace(title=f"Means over recordings, and differences from {names[0]}", note=note)]


def _common(runs: Sequence[Run], metric: str) -> np.ndarray:
    """The metric (k, n) of the k trackers in the n recordings in which all have it."""
    found = [
        run.recordings.frame.select("recording", pl.col(metric).cast(pl.Float64).alias(str(k)))
        for k, run in enumerate(runs)
    ]
    joined = found[0]
    for other in found[1:]:
        joined = joined.join(other, on="recording")
    return joined.drop("recording").drop_nulls().to_numpy().T


def _difference(first: np.ndarray, second: np.ndarray) -> Difference:
    """The difference of the means of paired values (n,)."""
    differences = second - first
    without = (differences.sum() - differences) / max(len(differences) - 1, 1)
    return jackknifed(float(first.mean()), float(second.mean()), without)._replace(kind="recordings")
