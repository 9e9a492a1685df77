"""Starts: the prior of a track from one row of measurements."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import equinox as eqx

from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Input
from trackwright.trackers.core.model.sensor import AbstractSensor, Row


class AbstractStart(eqx.Module):
    """The prior of a track, from the measurements of a single row; used at the start and after track loss.

    `smooth`: the candidate is differentiable with respect to the sensors' parameters (a weighted mean is, an argmax
    is not). `known`: the belief is known before the first row, whose measurements update it; else they are its source.
    """

    smooth: ClassVar[bool] = False
    known: ClassVar[bool] = False

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
        """The expensive search, run only for trajectories that need it; differentiated only if `smooth`."""

    @abstractmethod
    def belief(self, candidate: Any, row: Row) -> Gaussian:
        """The prior at this row, given the result of `candidate`; `filter.init` turns it into the filter's belief."""
