"""Log-likelihood and gradient of every trajectory as the library computes them, with their computing time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.filters.particle.filter import AbstractParticleFilter
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.tuning.marginal_score import marginal_scores
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

MAX_BATCH = 64
"""Trajectories of 2,000 particles per chunk, which fit the cache; more in proportion for fewer particles."""


class Gradients(NamedTuple):
    """log L (n,) of n trajectories, its gradient (p, n) by unconstrained parameters, and seconds per trajectory."""

    values: np.ndarray
    gradient: np.ndarray
    seconds: float


def gradients(tracker: AbstractTracker, batch: Batch, patterns: str | Sequence[str]) -> Gradients:
    """log L and its gradient as `tune` computes them, by the tunables that match the patterns.

    The time excludes compiling.
    """
    parameters = select_parameters(tracker, patterns)
    particles = tracker.filter if isinstance(tracker, Tracker) else None
    n_particles = particles.bootstrap.n_particles if isinstance(particles, AbstractParticleFilter) else 2000
    problem = Problem(tracker, [batch], NegativeLogLikelihood(), parameters, max(1, MAX_BATCH * 2000 // n_particles))
    vector = flatten(parameters)[None, :]
    problem.evaluate(vector, subset=[0])
    started = time.perf_counter()
    found = problem.evaluate(vector)
    seconds = (time.perf_counter() - started) / batch.size
    return Gradients(-found.terms[0, 0, : batch.size], -found.term_gradients[0, 0, :, : batch.size], seconds)


def marginal_gradients(tracker: Tracker, batch: Batch, patterns: str | Sequence[str]) -> Gradients:
    """The same by the marginal score; the time includes compiling."""
    started = time.perf_counter()
    found = marginal_scores(tracker, batch, patterns)
    return Gradients(found.values, found.scores.T, (time.perf_counter() - started) / batch.size)
