"""95 % intervals of tuned numbers, and the values fitted without a recording, or without a block of time of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from trackwright.trackers.recordings.trajectories import Trajectory
from trackwright.tuning.data import FitData
from trackwright.tuning.fitting import FitResult
from trackwright.tuning.parameters import by_label
from trackwright.tuning.problem import Problem
from trackwright.tuning.uncertainty import MIN_TRAJECTORIES, Uncertainty, refit

Interval = tuple[np.ndarray, np.ndarray]
"""Lowest and highest value."""


def intervals_of(result: FitResult) -> dict[str, Interval]:
    """The intervals by label: the wider of the posterior's and of the scatter of trajectories.

    Empty for a fit that was interrupted or is not at its optimum; NaN for numbers at a bound.
    """
    uncertainty = result.uncertainty
    return {} if uncertainty is None or not uncertainty.at_optimum else dict(uncertainty.intervals())


def without_intervals(uncertainty: Uncertainty | None, intervals: Mapping[str, Interval]) -> list[str]:
    """Why a fit at its optimum has no interval of a number that is not at a bound, in words; empty for other fits."""
    known = any(np.isfinite(ends).any() for ends in intervals.values())
    if uncertainty is None or not uncertainty.at_optimum or known or uncertainty.at_bound.all():
        return []
    if not np.isfinite(uncertainty.optimum.hessian).all():
        return ["no 95 % intervals: the objective has no finite curvature at these values; tune fewer numbers"]
    if np.isnan(uncertainty.observed).any() and np.isnan(uncertainty.sandwich).any():
        return [
            "no 95 % intervals: of an objective that is not a likelihood they come from the scatter over trajectories "
            f"and take {MIN_TRAJECTORIES}; found {uncertainty.clusters}; give more recordings or --objective nll"
        ]
    return []


MOST_FOLDS = 10
"""Fits at most: of more recordings several are left out at once."""


LEFT_OUT_ROUNDS = 8
"""Steps of each fit from the optimum of all recordings."""


def _model(result: FitResult) -> Uncertainty | None:
    """The model of the objective from which a few steps fit a part of the recordings; None without one."""
    known = None if result.problem.stochastic else result.uncertainty
    return known if known is None or np.all(np.isfinite(known.optimum.hessian)) else None


def left_out_values(result: FitResult) -> dict[str, dict[str, np.ndarray]]:
    """For each recording, the values by label that are fitted to the others, all at once.

    Numbers at a bound, and those that keep their starting values, stay there. Empty for one recording, for an
    interrupted fit, and for particle filters, whose gradients are too noisy for a few steps.
    """
    uncertainty, names = _model(result), list(dict.fromkeys(name for name in result.recordings if name))
    if uncertainty is None or len(names) < 2:
        return {}
    folds = [names[k::MOST_FOLDS] for k in range(min(len(names), MOST_FOLDS))]
    recordings = np.asarray(result.recordings)
    weights = np.stack([uncertainty.optimum.used & ~np.isin(recordings, fold) for fold in folds]).astype(float)
    starts = np.tile(result.vector, (len(folds), 1))
    vectors = refit(
        result.problem, starts, uncertainty.optimum.hessian, ~uncertainty.at_bound, weights, LEFT_OUT_ROUNDS
    ).vectors
    values = [by_label(result.parameters, np.clip(vector, *result.limits)) for vector in vectors]
    return {
        name: of_fold
        for fold, of_fold, others in zip(folds, values, weights, strict=True)
        for name in fold
        if others.any()
    }


BLOCKS = 4
"""Blocks of time of a single recording."""


def left_out_blocks(result: FitResult, data: FitData) -> list[tuple[float, float, dict[str, np.ndarray]]]:
    """Blocks of time with as many true positions each: start, stop, and the values by label fitted without its truth.

    `data`: what was fitted to. With the compiled programs of the fit, since only truth is hidden. Empty as
    `left_out_values`, and where the objective needs no truth.
    """
    uncertainty, quantity = _model(result), next(iter(data.training[0].recording.truth))
    if uncertainty is None or not data.objective.needs_truth:
        return []
    known = [t.recording.times[t.recording.truth[quantity][1]] for t in data.training]
    edges = np.quantile(np.concatenate(known), np.linspace(0, 1, BLOCKS + 1))
    edges[[0, -1]] = -np.inf, np.inf
    blocks, fitted, free = list[tuple[float, float, dict[str, np.ndarray]]](), result.problem, ~uncertainty.at_bound

    def hidden(trajectory: Trajectory) -> Trajectory:
        recording = trajectory.recording
        values, seen = recording.truth[quantity]
        rest = seen & ((recording.times < start) | (recording.times >= stop))
        return replace(trajectory, recording=replace(recording, truth={quantity: (values, rest)}))

    for start, stop in pairwise(edges.tolist()):
        part = replace(data, training=[hidden(trajectory) for trajectory in data.training])
        problem = Problem(fitted.tracker, part.batches(), fitted.objective, fitted.parameters, weights=part.weights())
        problem.moving, problem.prior, problem.discount = fitted.moving, fitted.prior, fitted.discount
        refitted = refit(problem, result.vector[None], uncertainty.optimum.hessian, free, None, LEFT_OUT_ROUNDS)
        vector = np.clip(refitted.vectors[0], *result.limits)
        blocks.append((start, stop, by_label(result.parameters, vector)))
    return blocks
