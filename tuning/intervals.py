"""95 % intervals of tuned numbers: by curvature and scatter, by profile likelihood, or by bootstrap."""

from __future__ import annotations

import numpy as np

from trackwright.trackers.core.errors import UnusableInput
from trackwright.tuning.fitting import FitResult
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.profiles import MIN_TRAJECTORIES, bootstrap, percentile_intervals, profile
from trackwright.tuning.uncertainty import Uncertainty

Interval = tuple[np.ndarray, np.ndarray]
"""Lowest and highest value."""


def intervals_of(result: FitResult, kind: str = "curvature") -> dict[str, Interval]:
    """The intervals by label; empty for a fit that was interrupted or is not at its optimum.

    `curvature`: the wider of a likelihood's curvature and the scatter of trajectories or blocks of rows. `profile`:
    where the profile likelihood has fallen by 1.92 nats. `bootstrap`: percentiles of fits to resampled trajectories.
    NaN for numbers at a bound. Raises UnusableInput where the kind does not apply.
    """
    uncertainty = result.uncertainty
    if uncertainty is None or not uncertainty.at_optimum:
        return {}
    try:
        if kind == "bootstrap":
            return _bootstrap_intervals(result, uncertainty)
        if kind == "profile":
            return _profile_intervals(result, uncertainty)
    except ValueError as error:
        raise UnusableInput(f"intervals by {kind}: {error}") from error
    return dict(uncertainty.intervals())


def require_possible(kind: str, objective: AbstractObjective, trajectories: int) -> None:
    """Raise UnusableInput, before any work, for a kind of interval that does not apply to so many trajectories."""
    if kind == "profile" and not objective.is_likelihood:
        raise UnusableInput(
            "intervals by profile: a profile is of a likelihood; use the objective nll, or the bootstrap"
        )
    if kind == "bootstrap" and trajectories < MIN_TRAJECTORIES:
        raise UnusableInput(
            f"intervals by bootstrap: found {trajectories} segments of recordings, expected {MIN_TRAJECTORIES} or more "
            "to draw from; cut the recordings into shorter segments, or give more of them"
        )


def _bootstrap_intervals(result: FitResult, uncertainty: Uncertainty) -> dict[str, Interval]:
    at_bound = uncertainty.at_bound
    vectors = bootstrap(result.problem, uncertainty.optimum, at_bound=at_bound)
    return percentile_intervals(result.parameters, np.where(at_bound, np.nan, vectors))


def _profile_intervals(result: FitResult, uncertainty: Uncertainty) -> dict[str, Interval]:
    """Profile intervals of single numbers; a matrix keeps those by curvature, since its entries are no parameters."""
    intervals, start = dict(uncertainty.intervals()), 0
    for parameter in result.parameters:
        if len(parameter.shape) < 2:
            ends = np.array([_ends(result, uncertainty, start + k) for k in range(parameter.size)])
            intervals[parameter.label] = ends[:, 0].reshape(parameter.shape), ends[:, 1].reshape(parameter.shape)
        start += parameter.size
    return intervals


def _ends(result: FitResult, uncertainty: Uncertainty, component: int) -> tuple[float, float]:
    if uncertainty.at_bound[component]:
        return np.nan, np.nan
    found = profile(result.problem, uncertainty.optimum, component, at_bound=uncertainty.at_bound)
    return found.low, found.high
