"""Sensors: measurement models with their noise, as a prediction and a whitened residual.

Masks, angle wrapping, reported covariances and singular noise are handled here; filters use whitened residuals alone. A
sensor draws no noise: simulated worlds (`sim`) and the models of trackers are different objects.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.special import gammaln

from trackwright.trackers.core.model.algebra import Scalar, Vector, total
from trackwright.trackers.core.model.inputs import Input, Inputs
from trackwright.trackers.core.model.motion import Noise

LOG_2PI = 1.8378770664093453


class Channel(NamedTuple):
    """One number of a reading: its name, its unit, and whether it is an angle that wraps."""

    name: str
    unit: str
    wraps: bool = False


class Reading(NamedTuple):
    """One row of one sensor: values, their mask, and noise reported by the device (empty for most sensors).

    All three are sequences of scalars. Masked values are finite.
    """

    values: Any
    seen: Any
    reported: Any = ()


class Row(NamedTuple):
    """One time step of one trajectory.

    `dt`: s since the previous step. `key` (2,): random key of the trajectory. `number`: index of the time step.
    """

    dt: Scalar
    valid: Scalar
    readings: dict[str, Reading]
    inputs: Inputs
    key: Any
    number: Scalar


class Residual(NamedTuple):
    """A whitened residual: the log density of the reading is log_scale − ½ Σ whitened².

    For Student's t of `dof` ν it is log_scale − ½ (ν + 1) Σ log(1 + whitened²/ν). `log_scale`: the log density at zero
    residual.

    `whitened`: unit covariance, zero for masked channels; `rest`: the sum of squares of normal ones that no state
    changes. `nis_dof`: the rank of all.
    `wrapped`: whether the sign of an angle's residual is ambiguous (near half a turn). `dof`: degrees of freedom ν of
    Student's t, the same for each channel; None for normal noise.
    """

    whitened: Sequence[Scalar]
    log_scale: Scalar
    nis_dof: Scalar
    wrapped: Scalar = False
    dof: Scalar | None = None
    rest: Scalar = 0.0

    @property
    def log_density(self) -> Scalar:
        """The log density of the reading."""
        if self.dof is None:
            return self.log_scale - 0.5 * (total(r * r for r in self.whitened) + self.rest)
        dof = self.dof
        return self.log_scale - 0.5 * (dof + 1.0) * total(jnp.log1p(r * r / dof) for r in self.whitened)


class AbstractSensor(eqx.Module):
    """A source of readings with a fixed number of channels.

    `view_fields`: the fields of `motion.view` that `measure` needs, as `("position", "velocity")`. `curved`: whether
    there are positions about which its readings bend within the spread of a position, as angles below a station.
    """

    view_fields: ClassVar[tuple[str, ...]] = ()
    curved: ClassVar[bool] = False

    @property
    @abstractmethod
    def channels(self) -> tuple[Channel, ...]:
        """Name, unit and wrapping of each channel, in the order of a reading's values."""

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The known inputs that `measure` reads; none by default."""
        return ()

    @property
    def reported(self) -> tuple[Channel, ...]:
        """The noise columns that `residual` reads where a device reports its noise; by default it reads none."""
        return ()

    @abstractmethod
    def measure(self, view: Any, inputs: Inputs) -> Sequence[Scalar]:
        """The noise-free reading, one scalar per channel, of a `motion.view` of a state."""

    @abstractmethod
    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """The whitened residual of a reading from a prediction, with the log of its density's scale."""

    def residual_near(self, view: Any, reading: Reading, inputs: Inputs) -> Callable[[Any], Residual]:
        """The residual of a reading as a function of views near `view`; what no state changes may be its `rest`."""
        return lambda near: self.residual(reading, list(self.measure(near, inputs)))


class AbstractDelayedSensor(AbstractSensor):
    """A sensor that measures the state `latency` s before the row of its reading.

    `latency_std` s: the standard deviation of a latency that is not known; 0 for one that is.
    """

    latency: eqx.AbstractVar[Noise]
    latency_std: eqx.AbstractVar[Noise]


def position_in_space(position: Vector, inputs: Inputs) -> Vector:
    """The position in three dimensions; a planar one is completed by the known height `inputs["height"]`, m."""
    return position if len(position) == 3 else Vector(*position, inputs["height"])


def delayed_position(view: Any, inputs: Inputs, late: Any | None) -> Vector:
    """The position in three dimensions `late` s before a view's with a velocity, for straight motion; None: 0.

    A view without a velocity has its position alone.
    """
    position = view.position
    if late is not None and hasattr(view, "velocity"):
        position = Vector.of(p - v * late.value for p, v in zip(position, view.velocity, strict=True))
    return position_in_space(position, inputs)


def rounding_variance(reading: Scalar) -> Scalar:
    """The square of the spacing of numbers at a reading, the variance of its rounding."""
    return (float(jnp.finfo(jnp.result_type(reading)).eps) * reading) ** 2


def student_t_log_peak(dof: Scalar) -> Scalar:
    """The log density of Student's t of unit scale at zero; it replaces −½ log 2π in a log_scale."""
    return gammaln(0.5 * (dof + 1.0)) - gammaln(0.5 * dof) - 0.5 * jnp.log(jnp.pi * dof)


def independent(
    differences: Sequence[Scalar], sigmas: Sequence[Scalar], seen: Sequence[Scalar], dof: Scalar | None = None
) -> Residual:
    """The residual of channels with independent noise; `differences`: reading − prediction, wrapped where it wraps.

    `dof`: degrees of freedom of Student's t with these scales, by default normal noise.
    """
    peak = -0.5 * LOG_2PI if dof is None else student_t_log_peak(dof)
    whitened = [jnp.where(s, d / sigma, 0.0) for d, sigma, s in zip(differences, sigmas, seen, strict=True)]
    log_scale = total(jnp.where(s, peak - jnp.log(jnp.asarray(x)), 0.0) for x, s in zip(sigmas, seen, strict=True))
    return Residual(whitened, log_scale, total(jnp.where(s, 1.0, 0.0) for s in seen), dof=dof)
