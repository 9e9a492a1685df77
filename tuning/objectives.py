"""What a fit makes small: sums over rows and trajectories, so that any number of recordings adds up to one figure.

e  estimate − truth of a quantity, d numbers        S  its reported covariance        NEES  eᵀS⁻¹e
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from trackers.core.algebra import Scalar, cholesky, full, times, total, triangle
from trackers.core.estimates import Status
from trackers.core.linearise import linearise
from trackers.core.scan import Output
from trackers.core.sensor import LOG_2PI
from trackers.core.state import coordinates

Truth = dict[str, tuple[Any, Any]]
"""The truth of a row by quantity: its components, each (B,), and where it is known (B,)."""


class MissingQuantityError(ValueError):
    """A tracker's states do not show the quantity whose truth they are to be judged by."""


class AbstractObjective(eqx.Module):
    """A figure made of sums: `terms` of every row are added over rows and trajectories, `value` is made of the sums."""

    @property
    @abstractmethod
    def size(self) -> int:
        """How many terms a row has."""

    @property
    @abstractmethod
    def needs_truth(self) -> bool:
        """Whether rows count only where their truth is known."""

    @abstractmethod
    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        """Numbers per trajectory of one row."""

    @abstractmethod
    def value(self, sums: Any) -> Scalar:
        """The figure, from the sums (one number per term)."""

    def log_likelihood_units(self, sums: Any) -> float:
        """What the figure is to be multiplied with to be a negative log-likelihood in nats; NaN: most are none."""
        return math.nan

    @property
    def is_likelihood(self) -> bool:
        """Whether the figure is a negative log-likelihood in some unit."""
        return math.isfinite(self.log_likelihood_units([1.0] * self.size))

    def informed(self, tracker: Any) -> AbstractObjective:
        """The objective with what it has to know of the tracker whose rows it judges; most know enough."""
        return self


class NegativeLogLikelihood(AbstractObjective):
    """The mean negative log-likelihood per number read, nats; needs no truth."""

    @property
    def size(self) -> int:
        return 2

    @property
    def needs_truth(self) -> bool:
        return False

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        return -output.log_likelihood, output.nis_dof

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

    @property
    def size(self) -> int:
        return 2

    @property
    def needs_truth(self) -> bool:
        return True

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        errors, counts = errors_of(output, truth, self.quantity, self.dimensions)
        square = total(e * e for e in errors)
        return jnp.where(counts, square, 0.0), jnp.where(counts, jnp.ones_like(square), 0.0)

    def value(self, sums: Any) -> Scalar:
        return jnp.sqrt(sums[0] / sums[1])


class StateLogLikelihood(AbstractObjective):
    """The mean negative log density of the truth under each row's mean and covariance, nats per row.

    Fields as of `RootMeanSquareError`. Unlike an RMSE it is worse for a filter that is too sure of itself, or not sure
    enough. Rows of one track are wrong together, so that it is no likelihood of a recording.
    """

    quantity: str = eqx.field(static=True, default="position")
    dimensions: int = eqx.field(static=True, default=2)

    @property
    def size(self) -> int:
        return 2

    @property
    def needs_truth(self) -> bool:
        return True

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        judged = judged_error(output, truth, self.quantity, self.dimensions)
        density = -0.5 * (judged.nees + judged.log_determinant + self.dimensions * LOG_2PI)
        return jnp.where(judged.counts, -density, 0.0), jnp.where(judged.counts, jnp.ones_like(density), 0.0)

    def value(self, sums: Any) -> Scalar:
        return sums[0] / sums[1]


class Weighted(AbstractObjective):
    """A sum of objectives, each times its weight; trajectories without one of them have no say in any."""

    parts: tuple[AbstractObjective, ...]
    weights: tuple[float, ...] = eqx.field(static=True)

    def __check_init__(self) -> None:
        if len(self.parts) != len(self.weights) or not all(0 < w < float("inf") for w in self.weights):
            raise ValueError(f"each of {len(self.parts)} objectives has a weight above zero, found {self.weights}")

    @property
    def size(self) -> int:
        return sum(part.size for part in self.parts)

    @property
    def needs_truth(self) -> bool:
        return any(part.needs_truth for part in self.parts)

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        return tuple(x for part in self.parts for x in part.terms(output, truth))

    def value(self, sums: Any) -> Scalar:
        return total(
            w * part.value(own) for w, part, own in zip(self.weights, self.parts, self.shares(sums), strict=True)
        )

    def log_likelihood_units(self, sums: Any) -> float:
        if len(self.parts) > 1:
            return float("nan")
        return self.parts[0].log_likelihood_units(sums) / self.weights[0]

    def informed(self, tracker: Any) -> Weighted:
        return Weighted(tuple(part.informed(tracker) for part in self.parts), self.weights)

    def shares(self, sums: Any) -> list[Any]:
        """The sums of each objective."""
        found, start = [], 0
        for part in self.parts:
            found.append(sums[start : start + part.size])
            start += part.size
        return found


class Judged(NamedTuple):
    """An error in the light of its covariance: NEES, log det S, and whether the row counts; all (B,)."""

    nees: Scalar
    log_determinant: Scalar
    counts: Scalar


def errors_of(output: Output, truth: Truth, quantity: str, dimensions: int) -> tuple[list[Scalar], Scalar]:
    """Estimate less truth of a quantity's first components, and whether the row has both; or `MissingQuantityError`."""
    if not hasattr(output.mean, quantity):
        raise MissingQuantityError(f"the tracker's state is a {type(output.mean).__name__}, which shows no {quantity}")
    true, known = truth[quantity]
    usable = (output.status == Status.OK) | (output.status == Status.RESTARTED) | (output.status == Status.LOST)
    components = list(getattr(output.mean, quantity))[:dimensions]
    return [m - t for m, t in zip(components, true[:dimensions], strict=True)], usable & known


def judged_error(output: Output, truth: Truth, quantity: str, dimensions: int) -> Judged:
    """The error of a quantity's first components in the light of the reported covariance.

    By a Cholesky factor over scalars. NaN where the covariance of a row that counts is not positive definite.
    """
    errors, counts = errors_of(output, truth, quantity, dimensions)
    S = covariance_of(output, quantity, dimensions)
    one = jnp.ones_like(errors[0])
    # What doesn't count gets the unit matrix: a row that waits has no covariance, and NaN has no derivative.
    cov = {(i, j): jnp.where(counts, S[i, j], one if i == j else 0.0) for i, j in triangle(dimensions)}
    L = cholesky(cov, range(dimensions), 0.0)
    parts: list[Scalar] = []
    for i, e in enumerate(errors):
        pivot = jnp.where(L[i, i] > 0, L[i, i], jnp.nan)
        parts.append((jnp.where(counts, e, 0.0) - total(L[i, j] * parts[j] for j in range(i))) / pivot)
    return Judged(total(p * p for p in parts), 2.0 * total(jnp.log(L[i, i]) for i in range(dimensions)), counts)


def covariance_of(output: Output, quantity: str, dimensions: int) -> dict[tuple[int, int], Scalar]:
    """The covariance of a quantity's first components, upper triangle by index, to first order in the state's."""

    def one(mean: Any, cov: Any) -> dict[tuple[int, int], Scalar]:
        point, rebuild = coordinates(mean)
        _, rows = linearise(lambda *x: list(getattr(rebuild(x), quantity))[:dimensions], point)
        P = full(cov, len(point))
        return {
            (i, j): total(times(times(a, P[m][n]), b) for m, a in rows[i].items() for n, b in rows[j].items())
            for i, j in triangle(dimensions)
        }

    # States are written for one trajectory: a leaf of theirs that is a vector is no vector of trajectories.
    each = jax.vmap(one, in_axes=-1, out_axes=-1) if jnp.ndim(output.status) else one
    return each(output.mean, output.cov)
