"""The library's own gradient of a log-likelihood, trajectory by trajectory, and what it costs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker, Tracker
from tuning.marginal_score import marginal_scores
from tuning.objectives import NegativeLogLikelihood
from tuning.parameters import flatten, select_parameters
from tuning.problem import Problem

AT_ONCE = 64
"""Trajectories of 2,000 particles that run together: they then fit the cache; of fewer particles as many more."""


class Gradients(NamedTuple):
    """Of n trajectories: log L (n,), its derivatives (p, n) by unconstrained numbers, and seconds for one of them."""

    values: np.ndarray
    slopes: np.ndarray
    seconds: float


def gradients(tracker: AbstractTracker, batch: Batch, patterns: str | Sequence[str]) -> Gradients:
    """log L and its gradient as `tune` computes them, by the tunables that the patterns name.

    The time is without that of compiling.
    """
    parameters = select_parameters(tracker, patterns)
    n_workers = max(1, AT_ONCE * 2000 // getattr(getattr(tracker, "filter", None), "n_particles", 2000))
    problem = Problem(tracker, [batch], NegativeLogLikelihood(), parameters, n_workers)
    vector = flatten(parameters)[None, :]
    problem.evaluate(vector, parts=[0])
    started = time.perf_counter()
    found = problem.evaluate(vector)
    seconds = (time.perf_counter() - started) / batch.size
    return Gradients(-found.terms[0, 0, : batch.size], -found.slopes[0, 0, :, : batch.size], seconds)


def marginal_gradients(tracker: Tracker, batch: Batch, patterns: str | Sequence[str]) -> Gradients:
    """The same by the marginal score; the time includes that of compiling."""
    started = time.perf_counter()
    found = marginal_scores(tracker, batch, patterns)
    return Gradients(found.values, found.scores.T, (time.perf_counter() - started) / batch.size)
