"""The carry of a recursive tracker between two time steps: its parts, its forms, and how a track begins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from trackwright.trackers.core.filters.filter import AbstractFilter, Innovation
from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.covariance import AnyCovariance, Gaussian, as_scalars, matrix, with_covariances
from trackwright.trackers.core.model.keys import RawKey
from trackwright.trackers.core.model.sensor import AbstractSensor, Row
from trackwright.trackers.core.model.start import AbstractStart
from trackwright.trackers.core.run.track_loss import AbstractTrackLoss


class StepInfo(NamedTuple):
    """Per-step diagnostics: log-likelihood, NIS and its degrees of freedom, ambiguous wraps, `Status`."""

    log_likelihood: Scalar
    nis: Scalar
    nis_dof: Scalar
    wrapped: Scalar
    status: Scalar


class Carry(NamedTuple):
    """The carry between two time steps: belief, track status, statistic of track loss, s since the last measurement."""

    belief: Any
    running: Scalar
    started: Scalar
    loss_statistic: Scalar
    time_since_measurement: Scalar


@runtime_checkable
class RecursiveTracker(Protocol):
    """The attributes of a `Tracker` that the scan uses."""

    @property
    def sensors(self) -> Mapping[str, AbstractSensor]: ...
    @property
    def start(self) -> AbstractStart: ...
    @property
    def filter(self) -> AbstractFilter[Any]: ...
    @property
    def track_loss(self) -> AbstractTrackLoss: ...
    def predict(self, belief: Any, row: Row) -> Any: ...
    def update(self, belief: Any, row: Row) -> tuple[Any, Innovation]: ...
    def advance(self, carry: Carry, row: Row, belief: Any, innovation: Innovation) -> tuple[Carry, StepInfo]: ...
    def moments(self, belief: Any) -> tuple[Any, AnyCovariance]: ...


def carry_axes(tracker: RecursiveTracker) -> Carry:
    """The axis of trajectories in each part of the carry: last, but first in a belief with a particle axis."""
    return Carry(0 if tracker.filter.has_particle_axis else -1, -1, -1, -1, -1)


def initial_carry(tracker: RecursiveTracker, candidate: Any, row: Row) -> Carry:
    """The carry after a row that starts a track."""
    return carry_of(tracker, tracker.start.belief(candidate, row), row.key, row.number)


def carry_of(tracker: RecursiveTracker, prior: Gaussian, key: RawKey, number: Scalar) -> Carry:
    """The carry of a track that begins with this prior at row `number` of a trajectory with this random key."""
    one = jnp.ones_like(prior.cov[0])
    # A new key for every start of a trajectory; XLA drops it where the filter draws no random numbers.
    key = jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(jnp.asarray(key)), number))
    return Carry(tracker.filter.init(prior, key), one > 0, one > 0, one * tracker.track_loss.initial, one * 0)


def in_form(carry: Carry, few: bool) -> Carry:
    """The carry of one trajectory with its covariances in the form for few trajectories, or for many."""
    return carry._replace(belief=with_covariances(carry.belief, matrix if few else as_scalars))


def empty_carry(tracker: RecursiveTracker, row: Row, few: bool) -> Carry:
    """The carry before the first row: zeros, no track running."""

    def started(row: Row) -> Carry:
        return in_form(initial_carry(tracker, tracker.start.candidate(tracker.sensors, row), row), few)

    shape = jax.eval_shape(started, row)
    return jax.tree_util.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), shape)
