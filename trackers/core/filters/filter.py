"""Starts and filters: the belief of a track, from its first row on, by Bayes' rule for one trajectory and time step.

A start gives the prior. Each filter has its form of belief:

    init     prior -> belief                  predict  belief at a later time
    update   belief after one reading         moments  mean and covariance of a belief

A filter with an RTS recursion is an `AbstractSmoothableFilter`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import equinox as eqx

from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.covariance import AnyCovariance, Gaussian
from trackwright.trackers.core.model.inputs import Input, Inputs, RawKey
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Row
from trackwright.trackers.core.model.state import State

Belief = TypeVar("Belief")


class AbstractStart(eqx.Module):
    """The prior of a track, from the measurements of a single row; used at the start and after track loss.

    `smooth`: the candidate is differentiable with respect to the sensors' parameters (a weighted mean is, an argmax
    is not). `known`: the belief is known before the first row, whose measurements update it; else they are its source.
    `searches`: the candidate takes longer than a step of a filter, and is sought for trajectories in need alone.
    """

    smooth: ClassVar[bool] = False
    known: ClassVar[bool] = False
    searches: ClassVar[bool] = False

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The known inputs that it reads; none by default."""
        return ()

    @property
    def readings(self) -> Mapping[str, int]:
        """The readings that it reads by name, with the smallest number of their channels; none by default."""
        return MappingProxyType({})

    @abstractmethod
    def can_start(self, row: Row) -> Scalar:
        """Whether the row has enough measurements to start a track."""

    @abstractmethod
    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        """Where a track that starts in this row is; differentiated only if `smooth`."""

    @abstractmethod
    def belief(self, candidate: Any, row: Row) -> Gaussian:
        """The prior at this row, given the result of `candidate`; `filter.init` turns it into the filter's belief."""


class Innovation(NamedTuple):
    """Statistics of one reading: log-likelihood, NIS and its degrees of freedom, number of ambiguous wraps."""

    log_likelihood: Scalar
    nis: Scalar
    nis_dof: Scalar
    wrapped: Scalar


class AbstractFilter(eqx.Module, Generic[Belief]):
    """A recursive filter of one trajectory; its belief is a tree of arrays.

    `has_particle_axis`: the belief has a large axis of particles or grid cells. In a batch trajectories are then the
    first axis of the belief, not the last, and a belief is copied or started only where necessary.
    """

    has_particle_axis: ClassVar[bool] = False

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The known inputs that the filter reads; none by default."""
        return ()

    @property
    def view_fields(self) -> tuple[str, ...]:
        """The fields of `motion.view` that the filter reads; none by default."""
        return ()

    @abstractmethod
    def init(self, belief: Gaussian, key: RawKey) -> Belief:
        """The belief of a new track, from its prior; `key` (2,): raw random key."""

    @abstractmethod
    def predict(self, belief: Belief, motion: AbstractMotion, inputs: Inputs, dt: Scalar) -> Belief:
        """The belief `dt` s later, unchanged for `dt` = 0."""

    @abstractmethod
    def update(
        self, belief: Belief, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
    ) -> tuple[Belief, Innovation]:
        """The belief after one reading, and the reading's `Innovation`; masked channels change nothing."""

    @abstractmethod
    def moments(self, belief: Belief) -> tuple[State, AnyCovariance]:
        """The mean state and the upper triangle of its covariance."""


class AbstractSmoothableFilter(AbstractFilter[Belief]):
    """A filter whose beliefs can be smoothed by a recursion backwards in time, as `Smoothed` does.

    The recursion takes all trajectories at once, last in every array, with covariances as arrays (n, n, B).
    """

    @abstractmethod
    def rts_gain(self, belief: Belief, motion: AbstractMotion, connected: Scalar, dt: Scalar, inputs: Inputs) -> Any:
        """The terms of the backward step from the next time step, `dt` s later; `connected`: it continues the track."""

    @abstractmethod
    def rts_step(self, rts_gain: Any, after: Belief) -> Belief:
        """The smoothed belief of a time step, given the next one's."""
