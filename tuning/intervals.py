"""95 % intervals of tuned numbers, by one of three ways that trust the quadratic model less and less."""

from __future__ import annotations

import numpy as np

from trackers.core.errors import UnusableInput
from tuning import FitResult, bootstrap, profile
from tuning.objectives import AbstractObjective
from tuning.profiles import FEWEST, percentile_intervals

Interval = tuple[np.ndarray, np.ndarray]
"""Lowest and highest value."""


def intervals_of(result: FitResult, kind: str = "curvature") -> dict[str, Interval]:
    """The intervals by label; none of a fit that was stopped, or did not come to rest where its objective is least.

    `curvature`: by the curvature of a likelihood or by the scatter of trajectories or blocks of rows, whichever is
    wider. `profile`: where the likelihood, all other numbers fitted anew, has fallen by 1.92. `bootstrap`: of fits to
    trajectories drawn with replacement. NaN for what rests on a bound. Raises UnusableInput where there can be none.
    """
    sure = result.uncertainty
    if sure is None or not sure.settled:
        return {}
    try:
        if kind == "bootstrap":
            return _drawn_anew(result)
        if kind == "profile":
            return _profiled(result)
    except ValueError as error:
        raise UnusableInput(f"--intervals {kind}: {error}") from error
    return dict(sure.intervals())


def require_possible(kind: str, goal: AbstractObjective, trajectories: int) -> None:
    """Raise UnusableInput, before any work, for a kind of interval that there can't be of so many trajectories."""
    if kind == "profile" and not goal.is_likelihood:
        raise UnusableInput("--intervals profile: a profile is of a likelihood; use --objective nll, or bootstrap")
    if kind == "bootstrap" and trajectories < FEWEST:
        raise UnusableInput(
            f"--intervals bootstrap: found {trajectories} pieces of recordings, expected at least {FEWEST} to draw "
            "from; make --piece-rows smaller, or give more recordings"
        )


def _drawn_anew(result: FitResult) -> dict[str, Interval]:
    assert result.uncertainty is not None
    held = result.uncertainty.held
    vectors = bootstrap(result.problem, result.uncertainty.optimum, held=held)
    return percentile_intervals(result.parameters, np.where(held, np.nan, vectors))


def _profiled(result: FitResult) -> dict[str, Interval]:
    """Of single numbers; a matrix keeps the intervals of its curvature, since its entries are no parameters."""
    assert result.uncertainty is not None
    found, at = intervals_of(result), 0
    for parameter in result.parameters:
        shape = np.shape(parameter.example.raw)
        size = int(np.prod(shape, dtype=int))
        if len(shape) < 2:
            ends = np.array([_ends(result, at + k) for k in range(size)])
            found[parameter.label] = np.reshape(ends[:, 0], shape), np.reshape(ends[:, 1], shape)
        at += size
    return found


def _ends(result: FitResult, component: int) -> tuple[float, float]:
    sure = result.uncertainty
    assert sure is not None
    if sure.held[component]:
        return np.nan, np.nan
    found = profile(result.problem, sure.optimum, component, held=sure.held)
    return found.low, found.high
