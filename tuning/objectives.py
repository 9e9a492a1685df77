"""Objectives of a fit, each a function of sums over rows and trajectories of any number of recordings; their names.

e  estimate − truth of a quantity, (d,)        S  its reported covariance        NEES  eᵀS⁻¹e
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.algebra import Scalar, cholesky, total, triangle
from trackwright.trackers.core.model.linearise import covariance_of
from trackwright.trackers.core.model.sensor import LOG_2PI
from trackwright.trackers.core.run.scan import Output

Truth = dict[str, tuple[Any, Any]]  # of a row by quantity: its components, each (B,), and whether it is known (B,)


def name_of(objective: object) -> str:
    """The name of an objective, or of its class, for messages."""
    return objective if isinstance(objective, str) else type(objective).__name__


class AbstractObjective(eqx.Module):
    """A function of sums: `terms` of all rows are added over rows and trajectories, `value` maps sums to a number.

    `size`: number of terms of a row. `needs_truth`: whether only rows with known truth count.
    """

    size: eqx.AbstractClassVar[int]
    needs_truth: eqx.AbstractClassVar[bool]

    @abstractmethod
    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        """The terms of one row, each a number per trajectory."""

    @abstractmethod
    def value(self, sums: Any) -> Scalar:
        """The objective, from the sums (one number per term)."""

    def squares(self, output: Output, truth: Truth) -> tuple[Scalar, Scalar]:
        """The square of a row's error by its covariance, and its dof: their correlation discounts a likelihood."""
        return output.nis, output.nis_dof

    def nats_per_unit(self, sums: Any) -> float:
        """The factor from the objective to a negative log-likelihood in nats; NaN for objectives that are none."""
        return math.nan

    @property
    def is_likelihood(self) -> bool:
        """Whether the objective is a negative log-likelihood in some unit."""
        return math.isfinite(self.nats_per_unit([1.0] * self.size))

    @property
    def of_position(self) -> bool:
        """Whether its terms need no covariance of an estimate, or the position's alone."""
        return False

    @property
    def horizontal(self) -> bool:
        """Whether it judges the position over the floor alone, which hardly depends on vertical noise."""
        return False


class NegativeLogLikelihood(AbstractObjective):
    """The mean negative log-likelihood per measured number, nats; needs no truth."""

    size: ClassVar[int] = 2
    needs_truth: ClassVar[bool] = False
    of_position: ClassVar[bool] = True

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        return -output.log_likelihood, output.nis_dof

    def value(self, sums: Any) -> Scalar:
        return sums[0] / sums[1]

    def nats_per_unit(self, sums: Any) -> float:
        return float(sums[1])


class AbstractErrorObjective(AbstractObjective):
    """An objective of the errors of `quantity`, a vector field of the state, in its first `dimensions` components."""

    quantity: str = eqx.field(static=True, default="position")
    dimensions: int = eqx.field(static=True, default=2)
    size: ClassVar[int] = 2
    needs_truth: ClassVar[bool] = True

    @property
    def horizontal(self) -> bool:
        return self.quantity == "position" and self.dimensions <= 2


class RootMeanSquareError(AbstractErrorObjective):
    """The root mean square error of a quantity of the state, in the quantity's unit.

    `quantity`: a vector field of the state, such as `position`; `dimensions`: the number of its components that count.
    """

    of_position: ClassVar[bool] = True

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        errors, scored = errors_of(output, truth, self.quantity, self.dimensions)
        square = total(e * e for e in errors)
        return jnp.where(scored, square, 0.0), jnp.where(scored, jnp.ones_like(square), 0.0)

    def value(self, sums: Any) -> Scalar:
        return jnp.sqrt(sums[0] / sums[1])


class StateLogLikelihood(AbstractErrorObjective):
    """The mean negative log density of the truth under each row's mean and covariance, nats per row.

    Fields as in `RootMeanSquareError`. Unlike an RMSE it penalises overconfident and underconfident covariances. Errors
    of consecutive rows are correlated: as a likelihood it counts for fewer rows. `height_weight`: the power of the
    density of a third component given the other two (composite likelihood).
    """

    height_weight: float = eqx.field(static=True, default=1.0)

    @property
    def of_position(self) -> bool:
        return self.quantity == "position"

    def terms(self, output: Output, truth: Truth) -> tuple[Scalar, ...]:
        weights = (1.0, 1.0, self.height_weight)[: self.dimensions]
        nees, log_determinant, scored = normalised_error(output, truth, self.quantity, self.dimensions, weights)
        density = -0.5 * (nees + log_determinant + sum(weights) * LOG_2PI)
        return jnp.where(scored, -density, 0.0), jnp.where(scored, jnp.ones_like(density), 0.0)

    def value(self, sums: Any) -> Scalar:
        return sums[0] / sums[1]

    def squares(self, output: Output, truth: Truth) -> tuple[Scalar, Scalar]:
        nees, _, scored = normalised_error(output, truth, self.quantity, self.dimensions)
        return nees, jnp.where(scored, float(self.dimensions), 0.0)

    def nats_per_unit(self, sums: Any) -> float:
        return float(sums[1])


def errors_of(output: Output, truth: Truth, quantity: str, dimensions: int) -> tuple[list[Scalar], Scalar]:
    """Estimate − truth of a quantity's first components, and whether the row has both; or UnusableInput."""
    if not hasattr(output.mean, quantity):
        raise UnusableInput(f"the tracker's state is a {type(output.mean).__name__}, which has no {quantity}")
    true, known = truth[quantity]
    if len(true) < dimensions:
        raise UnusableInput(
            f"the truth of the {quantity} has {len(true)} components, and {dimensions} are judged; give the truth its "
            "height, or use a tracker over the floor"
        )
    components = list(getattr(output.mean, quantity))[:dimensions]
    estimated = (output.status == Status.OK) | (output.status == Status.RESTARTED) | (output.status == Status.LOST)
    return [m - t for m, t in zip(components, true[:dimensions], strict=True)], estimated & known


def normalised_error(
    output: Output, truth: Truth, quantity: str, dimensions: int, weights: Sequence[float] = (1.0, 1.0, 1.0)
) -> tuple[Scalar, Scalar, Scalar]:
    """NEES and log det S (B,) of a quantity's first components, and whether the row is scored.

    By a Cholesky factor over scalars; NaN where the covariance of a scored row is not positive definite. `weights`: of
    the components in NEES and log det S, each given those before it.
    """
    errors, scored = errors_of(output, truth, quantity, dimensions)
    S = _covariance_of(output, quantity, dimensions)
    unit = jnp.ones_like(errors[0])
    # Other rows get the unit matrix: before a track starts there is no covariance, and NaN has no derivative.
    cov = {(i, j): jnp.where(scored, S[i, j], unit if i == j else 0.0) for i, j in triangle(dimensions)}
    L = cholesky(cov, range(dimensions), 0.0)
    parts: list[Scalar] = []
    for i, e in enumerate(errors):
        pivot = jnp.where(L[i, i] > 0, L[i, i], jnp.nan)
        parts.append((jnp.where(scored, e, 0.0) - total(L[i, j] * parts[j] for j in range(i))) / pivot)
    weighted = list(zip(weights, parts, strict=False))
    logs = [w * jnp.log(L[i, i]) for i, (w, _) in enumerate(weighted)]
    return total(w * p * p for w, p in weighted), 2.0 * total(logs), scored


def _covariance_of(output: Output, quantity: str, dimensions: int) -> dict[tuple[int, int], Scalar]:
    """The covariance of a quantity's first components, upper triangle by index."""

    def of_trajectory(mean: Any, cov: Any) -> dict[tuple[int, int], Scalar]:
        return covariance_of(mean, cov, lambda state: list(getattr(state, quantity))[:dimensions])

    # States are written for one trajectory: vmap tells their vector leaves from vectors of trajectories.
    each = jax.vmap(of_trajectory, in_axes=-1, out_axes=-1) if jnp.ndim(output.status) else of_trajectory
    return each(output.mean, output.cov)


# Weight of an estimated height beside each coordinate of the plane in `state-nll`. Noise levels that act on the height
# alone are fitted to it all the same; those that it shares with the plane follow the plane's two coordinates, four
# times as heavy.
HEIGHT_WEIGHT = 0.5

OBJECTIVES: Mapping[str, Callable[[str, int], AbstractObjective]] = {
    "nll": lambda quantity, dimensions: NegativeLogLikelihood(),
    "rmse": RootMeanSquareError,
    "state-nll": lambda quantity, d: StateLogLikelihood(quantity, d, HEIGHT_WEIGHT if d == 3 else 1.0),
}
"""Constructors by name, each of a quantity and its number of components."""


def parse_objective(name: str, quantity: str = "position", dimensions: int = 2) -> AbstractObjective:
    """The objective of this name; raises UnusableInput for an unknown one."""
    if name not in OBJECTIVES:
        raise UnusableInput(f"objective {name}: '{name}' is no objective; expected one of {', '.join(OBJECTIVES)}")
    return OBJECTIVES[name](quantity, dimensions)
