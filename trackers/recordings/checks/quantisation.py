"""Quantisation steps, found from the data: the smallest spacing of which nearly all differences are multiples."""

from __future__ import annotations

import math

import numpy as np

from trackwright.trackers.recordings.checks.check_result import CheckResult
from trackwright.trackers.recordings.checks.readings import Readings
from trackwright.trackers.recordings.kinds import unit_of, wrapped

MOST_ROWS = 20_000
"""Readings of a column whose differences are looked at."""

MULTIPLES = 0.95
"""Least share of the differences that are multiples of a step."""

NEAR = 0.02
"""Distance from a multiple, in steps: one in 25 differences of a continuous value is as near."""

CANDIDATES = np.array([0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3])
"""Quantiles of the differences that are tried as steps."""

COARSE = 0.1
"""Least step that is reported, relative to the scatter of the readings: a finer one adds nothing to their noise."""

_LEAST_VALUES = 20


def check_quantisation(name: str, read: Readings, scatter: np.ndarray) -> list[CheckResult]:
    """The quantisation steps of a table's columns that are coarse beside the `scatter` (m,) of their readings."""
    by_step: dict[float, list[str]] = {}
    for k, column in enumerate(read.columns):
        step = quantisation_step(read, k)
        if step is not None and step >= COARSE * scatter[k]:
            by_step.setdefault(float(f"{step:.3g}"), []).append(column)
    return [CheckResult("info", name, _message(step, columns)) for step, columns in by_step.items()]


def _message(step: float, columns: list[str]) -> str:
    unit = unit_of(columns[0])
    degrees = f" ({math.degrees(step):.3g}°)" if unit == "rad" else ""
    return (
        f"quantised: {', '.join(columns)} in steps of {step:.3g} {unit}{degrees}; "
        f"their standard deviation is at least step/√12 = {step / math.sqrt(12):.2g} {unit}"
    )


def quantisation_step(read: Readings, column: int) -> float | None:
    """The quantisation step of a column, in its unit; None where its values are not multiples of one."""
    x, stream = read.values[:MOST_ROWS, column], read.stream[:MOST_ROWS]
    seen = np.isfinite(x)
    x, stream = x[seen], stream[seen]
    # The offsets of streams may differ, as their wraps may.
    differences = np.abs(wrapped(np.diff(x)[:, None], (read.columns[column],))[:, 0][stream[1:] == stream[:-1]])
    resolution = 1e-12 * (1.0 + np.abs(x).max(initial=0.0))
    differences = differences[differences > resolution]
    if len(differences) < _LEAST_VALUES:
        return None
    spacings = np.diff(np.sort(x[stream == np.bincount(stream).argmax()]))
    candidates = np.concatenate([spacings[spacings > resolution], differences])
    # The coarsest first: a few values off the steps, as means of two, are multiples of half a step.
    for candidate in np.unique(np.quantile(candidates, CANDIDATES, method="lower"))[::-1]:
        multiples = np.round(differences / candidate)
        good = (np.abs(differences / candidate - multiples) < NEAR) & (multiples > 0)
        if good.mean() >= MULTIPLES:
            return float(differences[good].sum() / multiples[good].sum())
    return None
