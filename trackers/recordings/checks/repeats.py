"""Repeated readings: rows whose values are those of the row before of the same tag and anchor or station."""

from __future__ import annotations

import numpy as np

from trackwright.trackers.recordings.checks.check_result import CheckResult, Level
from trackwright.trackers.recordings.checks.readings import Readings
from trackwright.trackers.recordings.kinds import KINDS

FEW, MANY = 0.01, 0.2
"""Share of repeated readings that is reported, and that is a warning."""


def check_repeats(name: str, read: Readings) -> list[CheckResult]:
    """The share of a table's readings that repeat the one before, which a filter takes for new ones."""
    share = repeated_share(read)
    if not share >= FEW:
        return []
    message = (
        f"repeated readings: {100 * share:.2g} % of the rows equal the row before of the same "
        f"{' and '.join(KINDS[name].layout(()).ids)}"
    )
    level: Level = "warning" if share >= MANY else "info"
    return [CheckResult(level, name, message + ("; expected one row per measurement" if share >= MANY else ""))]


def repeated_share(read: Readings) -> float:
    """The share of the readings with a predecessor in their stream that equal it in all columns; NaN without any."""
    seen = np.isfinite(read.values).any(axis=1)
    values, stream = read.values[seen], read.stream[seen]
    follows = stream[1:] == stream[:-1]
    if not follows.any():
        return float("nan")
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    return float(np.mean(same[follows].all(axis=1)))
