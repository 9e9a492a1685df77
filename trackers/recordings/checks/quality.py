"""How the columns of signal quality go with the errors of the readings against truth."""

from __future__ import annotations

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.recordings.checks.check_result import CheckResult
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS

LEAST_ROWS = 40
"""Least number of readings with a true value and a quality."""

MOST_MARKS, MARKED, CERTAIN = 4, 0.1, 5.0
"""Most values of a column that marks readings; how much more often marked ones repeat, at least, and in deviations."""


def check_quality(recording: RecordingFolder, name: str) -> list[CheckResult]:
    """A line for each column of quality of a table; none without truth."""
    kind = KINDS[name]
    if kind.predicted is None or not kind.averaged or "truth" not in recording.tables:
        return []
    columns = kind.layout(recording.tables[name].columns).quality
    if not columns:
        return []
    rows = recording.rows(name)
    measured = kind.measured(recording.rig, rows).usable
    errors = measured.errors(recording.paths.at(rows.tags, rows.starts, rows.times)[0])
    for sensor in np.unique(measured.sensors.number[:, 0]):
        part = measured.sensors.number[:, 0] == sensor
        errors[part] -= known_median(errors[part])
    unit, factor = kind.shown
    results = []
    for column, quality in zip(columns, rows.floats(columns).T, strict=True):
        known = [np.isfinite(quality) & np.isfinite(e) for e in errors.T]
        parts = [
            f"{value} {_relation(quality[k], factor * e[k], unit)}"
            for value, k, e in zip(measured.columns, known, errors.T, strict=True)
            if k.sum() >= LEAST_ROWS and np.ptp(quality[k]) > 0.0
        ]
        if parts:
            message = f"{column} and errors against truth less the median of each {kind.noun}: {'; '.join(parts)}"
            results.append(CheckResult("info", name, message))
    return results


def check_marks(recording: RecordingFolder, name: str) -> list[CheckResult]:
    """A warning for each value of a column of quality with which readings repeat the one before more than with others.

    So do exchanges that failed, whose readings are old ones.
    """
    table, layout = recording.tables[name], KINDS[name].layout(recording.tables[name].columns)
    same = pl.all_horizontal(pl.col(value) == pl.col(value).shift() for value in layout.values).over(*layout.ids)
    repeats = table.select(same.fill_null(False)).to_series().to_numpy()
    results = []
    for column in layout.quality:
        values = table[column].drop_nulls().unique().sort()
        for value in values if 2 <= len(values) <= MOST_MARKS else ():
            marked = (table[column] == value).fill_null(False).to_numpy()
            share, rest = repeats[marked].mean(), repeats[~marked].mean()
            deviation = np.sqrt(repeats.var() * (1 / marked.sum() + 1 / (~marked).sum()))
            if share - rest > max(MARKED, CERTAIN * deviation):
                rows = f"{100 * share:.0f} % of the {marked.sum()} rows with {column} = {value:g} repeat the row before"
                ask = "exchanges that failed? leave them out by where of a mapping"
                results.append(CheckResult("warning", name, f"{rows}, {100 * rest:.0f} % of the others: {ask}"))
    return results


def _relation(quality: Float[np.ndarray, " n"], errors: Float[np.ndarray, " n"], unit: str) -> str:
    ranks = [float(np.corrcoef(_ranks(quality), _ranks(e))[0, 1]) for e in (np.abs(errors), errors)]
    low, high = np.quantile(quality, [0.25, 0.75])
    # A root mean square would be that of a few wild values.
    sizes = [float(np.quantile(np.abs(errors[part]), 0.6827)) for part in (quality <= low, quality >= high)]
    return (
        f"rank correlation {ranks[0]:+.2f} (size), {ranks[1]:+.2f} (with sign), 68th percentile of the size "
        f"{sizes[0]:.2g}{unit} in the lowest quarter, {sizes[1]:.2g}{unit} in the highest"
    )


def _ranks(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Ranks, ties averaged."""
    return pl.Series(x).rank().to_numpy()
