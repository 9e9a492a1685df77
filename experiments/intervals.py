"""95 % intervals of tuned numbers, by one of three ways that trust the quadratic model less and less."""

from __future__ import annotations

import numpy as np

from experiments.errors import UnusableInput
from tuning import FitResult, bootstrap, profile
from tuning.profiles import percentile_intervals

Interval = tuple[np.ndarray, np.ndarray]
"""Lowest and highest value."""


def intervals_of(result: FitResult, kind: str = "curvature") -> dict[str, Interval]:
    """The intervals by label; none of a fit that was stopped. Raises UnusableInput where there can be none.

    `curvature`: from the scatter of trajectories or of blocks of rows where it is known, else from the curvature of a
    likelihood. `profile`: where the likelihood, all other numbers fitted anew, has fallen by 1.92. `bootstrap`: of fits
    to trajectories drawn with replacement.
    """
    sure = result.uncertainty
    if sure is None:
        return {}
    try:
        if kind == "bootstrap":
            return percentile_intervals(result.parameters, bootstrap(result.problem, sure.optimum))
        if kind == "profile":
            return _profiled(result)
    except ValueError as error:
        raise UnusableInput(f"--intervals {kind}: {error}") from error
    return dict(sure.intervals(sandwich=bool(np.all(np.isfinite(sure.sandwich)))))


def _profiled(result: FitResult) -> dict[str, Interval]:
    """Of single numbers; a matrix keeps the intervals of its curvature, since its entries are no parameters."""
    assert result.uncertainty is not None
    found, at = intervals_of(result), 0
    for parameter in result.parameters:
        shape = np.shape(parameter.example.raw)
        size = int(np.prod(shape, dtype=int))
        if len(shape) < 2:
            each = [profile(result.problem, result.uncertainty.optimum, at + k) for k in range(size)]
            low, high = (np.reshape([getattr(p, end) for p in each], shape) for end in ("low", "high"))
            found[parameter.label] = low, high
        at += size
    return found
