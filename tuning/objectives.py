"""What a fit makes small: sums over rows and trajectories, so that any number of recordings adds up to one figure."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from trackers.core.algebra import Scalar, total
from trackers.core.estimates import Status
from trackers.core.tracker import Output


class AbstractObjective(eqx.Module):
    """A figure made of sums: `terms` of every row are added over rows and trajectories, `value` is made of the sums."""

    @abstractmethod
    def terms(self, output: Output, truth: dict[str, tuple[Any, Any]]) -> tuple[Scalar, ...]:
        """Numbers per trajectory of one row."""

    @abstractmethod
    def value(self, sums: Any) -> Scalar:
        """The figure, from the sums (one number per term)."""

    @abstractmethod
    def log_likelihood_units(self, sums: Any) -> float:
        """What the figure is to be multiplied with to be a negative log-likelihood in nats; NaN where it isn't one."""


class NegativeLogLikelihood(AbstractObjective):
    """The mean negative log-likelihood per number read, nats; needs no truth."""

    def terms(self, output: Output, truth: dict[str, tuple[Any, Any]]) -> tuple[Scalar, ...]:
        return -output.log_likelihood, output.count

    def value(self, sums: Any) -> Scalar:
        return sums[0] / sums[1]

    def log_likelihood_units(self, sums: Any) -> float:
        return float(sums[1])


class RootMeanSquareError(AbstractObjective):
    """The root mean square distance between a quantity of the state and its truth, in the quantity's unit.

    `quantity`: a field of the state that is a vector, as `position`; `dimensions`: how many of its components count.
    """

    quantity: str = eqx.field(static=True, default="position")
    dimensions: int = eqx.field(static=True, default=2)

    def terms(self, output: Output, truth: dict[str, tuple[Any, Any]]) -> tuple[Scalar, ...]:
        true, known = truth[self.quantity]
        usable = (output.status == Status.OK) | (output.status == Status.RESTARTED) | (output.status == Status.LOST)
        counts = usable & known
        components = list(getattr(output.mean, self.quantity))[: self.dimensions]
        square = total((m - t) ** 2 for m, t in zip(components, true[: self.dimensions], strict=True))
        return jnp.where(counts, square, 0.0), jnp.where(counts, jnp.ones_like(square), 0.0)

    def value(self, sums: Any) -> Scalar:
        return jnp.sqrt(sums[0] / sums[1])

    def log_likelihood_units(self, sums: Any) -> float:
        return float("nan")
