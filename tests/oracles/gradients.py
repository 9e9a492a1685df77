"""The gradients of trackers as `tune` computes them, and the particle worlds that they are held against."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from tests.oracles import quadrature
from tests.oracles.marginal_score import marginal_scores
from tests.oracles.particle_worlds import (
    CORRIDOR_TUNABLES,
    HALT_TUNABLES,
    corridor_batch,
    corridor_fixes,
    corridor_tracker,
    halt_batch,
    halt_tracker,
)
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.filters.particle.filter import AbstractParticleFilter, ParticleFilter
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

MAX_BATCH = 64
"""Trajectories of 2,000 particles per chunk, which fit the cache; more in proportion for fewer particles."""


class Gradients(NamedTuple):
    """log L (n,) of n trajectories, and its gradient (p, n) by unconstrained parameters."""

    values: np.ndarray
    gradient: np.ndarray


def gradients(tracker: AbstractTracker, batch: Batch, patterns: str | Sequence[str]) -> Gradients:
    """log L and its gradient as `tune` computes them, by the tunables that match the patterns."""
    parameters = select_parameters(tracker, patterns)
    particles = tracker.filter if isinstance(tracker, Tracker) else None
    n_particles = particles.bootstrap.n_particles if isinstance(particles, AbstractParticleFilter) else 2000
    chunk = max(1, MAX_BATCH * 2000 // n_particles)
    problem = Problem(tracker, [batch], NegativeLogLikelihood(), parameters, chunk)
    evaluation = problem.evaluate(flatten(parameters)[None, :])
    return Gradients(-evaluation.terms[0, 0, : batch.size], -evaluation.term_gradients[0, 0, :, : batch.size])


def marginal_gradients(tracker: Tracker, batch: Batch, patterns: str | Sequence[str]) -> Gradients:
    """The same by the marginal score."""
    values, scores = marginal_scores(tracker, batch, patterns)
    return Gradients(values, scores.T)


class World(NamedTuple):
    """A world of particles: its tunables, log L and gradient by the oracle, and `run(particles, keys)`."""

    name: str
    tunables: Sequence[str]
    value: Callable[[], float]
    slopes: Callable[[], tuple[float, ...]]
    run: Callable[[int, int], Gradients]


def corridor(rows: int) -> World:
    """The corridor, over so many fixes."""
    fixes = corridor_fixes(rows)
    return World(
        f"corridor {rows}",
        CORRIDOR_TUNABLES,
        partial(quadrature.corridor_log_likelihood, fixes),
        partial(quadrature.corridor_gradient, fixes),
        lambda n, keys: gradients(corridor_tracker(n), corridor_batch(rows, keys), CORRIDOR_TUNABLES),
    )


CORRIDOR_25, CORRIDOR_100 = corridor(25), corridor(100)
HALT = World(
    "halt",
    HALT_TUNABLES,
    quadrature.halt_log_likelihood,
    quadrature.halt_gradient,
    lambda n, keys: gradients(halt_tracker(ParticleFilter(n)), halt_batch(keys), HALT_TUNABLES),
)
