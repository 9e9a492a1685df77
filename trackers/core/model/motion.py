"""Motions: process models, the change of a state over an interval `dt`, driven by unit white noise.

A motion is one function, `step`; Jacobians, particles and simulation are derived from it, so that F and Q cannot
disagree. Contract: for `dt = 0` the state is unchanged, whatever the noise.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from trackwright.trackers.core.model.algebra import Scalar, Vector, total
from trackwright.trackers.core.model.inputs import Input, Inputs
from trackwright.trackers.core.model.state import State
from trackwright.trackers.core.model.tunable import AbstractTunable, Axis, Constant, Role, Scale

Noise = AbstractTunable | Constant


def as_scale(value: float | Noise, unit: str, role: Role | None = None, axis: Axis | None = None) -> Noise:
    """The value as a positive tunable with this unit and role; a tunable keeps the unit and role that it has.

    A `Constant` is returned unchanged.
    """
    if isinstance(value, Scale) and value.role is None:
        return eqx.tree_at(lambda scale: scale.raw, Scale(1.0, value.unit, role, axis), value.raw)
    return value if isinstance(value, Noise) else Scale(value, unit, role, axis)


def process_noise(value: float | Noise, unit: str, axis: Axis | None = None) -> Noise:
    """A level of a motion's driving noise; see `as_scale`."""
    return as_scale(value, unit, "process noise", axis)


class AbstractMotion(eqx.Module):
    """A process model, driven by `noise_dimension` numbers of unit white noise per step."""

    @property
    @abstractmethod
    def noise_dimension(self) -> int:
        """The number of independent standard normal numbers per step."""

    @abstractmethod
    def step(self, state: State, inputs: Inputs, dt: Scalar, w: Vector) -> State:
        """The state `dt` s later, given the known inputs and the noise draw `w`."""

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The known inputs that `step` reads; none by default."""
        return ()

    @property
    def stages(self) -> tuple[Callable[[State, Any, Scalar, Vector], State], ...]:
        """`step` as a composition of functions with sparse Jacobians; covariances are predicted stage by stage."""
        return (self.step,)

    def at(self, belief: Any) -> AbstractMotion:
        """This motion with belief-dependent parameters held constant during linearisation.

        For filters that linearise; `belief`: a `Gaussian`. By default the motion itself, linearised in full.
        """
        return self

    def log_density(self, state: State, inputs: Inputs, dt: Scalar, w: Vector) -> Scalar:
        """The log density of the noise draw of one step, in physical units, up to terms without tunables.

        Differentiated for the score of a particle filter with the draw held fixed: the next state may have no density,
        as at a speed clipped at zero. A draw s·w of scale s has the density `draw_log_density(w, s)`. Only tuning of a
        particle filter needs it; raises ValueError for a motion without it.
        """
        raise ValueError(
            f"the motion {type(self).__name__} has no log_density, which a particle filter needs for derivatives with "
            "respect to the motion's tunables; tune with an ExtendedKalman, or define it"
        )

    def view(self, state: State) -> Any:
        """The quantities of the state that sensors and outputs use, by field name (`position`, `azimuth`, …).

        By default the state itself.
        """
        return state


def draw_log_density(w: Scalar, scale: Scalar) -> Scalar:
    """The log density of a normal draw of standard deviation `scale` at `scale`·w, the value of the draw held fixed.

    Up to a constant: factors of the scale that are no tunables may be omitted.
    """
    unit = w * (jax.lax.stop_gradient(scale) / scale)
    return -jnp.log(scale) - 0.5 * unit * unit


class Kinematic(NamedTuple):
    """Position and velocity in any number of dimensions, metres and metres per second (or radians, per second)."""

    position: Vector
    velocity: Vector


class Accelerated(NamedTuple):
    """Position, velocity and acceleration, SI units."""

    position: Vector
    velocity: Vector
    acceleration: Vector


class Placed(NamedTuple):
    """A position alone, metres."""

    position: Vector


class ConstantVelocity(AbstractMotion):
    """Straight motion disturbed by white acceleration noise, exact for any interval (Bar-Shalom 2001, section 6.2.2).

    `sigma_a`: root of the noise's power density, m/s² per √Hz. Two steps in a row are one long step.
    """

    sigma_a: Noise
    dimensions: int = eqx.field(static=True)

    def __init__(self, sigma_a: float | Noise, dimensions: int):
        self.sigma_a = process_noise(sigma_a, "m/s^2/sqrt(Hz)", "all")
        self.dimensions = dimensions

    @property
    def noise_dimension(self) -> int:
        return 2 * self.dimensions

    def step(self, state: Kinematic, inputs: Inputs, dt: Scalar, w: Vector) -> Kinematic:
        n = self.dimensions
        kick = self.sigma_a.value * jnp.sqrt(dt)
        along, across = Vector(*w.parts[:n]), Vector(*w.parts[n:])
        position = state.position + state.velocity * dt + along * (0.5 * kick * dt) + across * (kick * dt / 12**0.5)
        return Kinematic(position, state.velocity + along * kick)

    def log_density(self, state: Kinematic, inputs: Inputs, dt: Scalar, w: Vector) -> Scalar:
        return total(draw_log_density(x, self.sigma_a.value) for x in w)


class ConstantPosition(AbstractMotion):
    """A position that drifts as a random walk; `sigma_v`: m per √s."""

    sigma_v: Noise
    dimensions: int = eqx.field(static=True)

    def __init__(self, sigma_v: float | Noise, dimensions: int):
        self.sigma_v = process_noise(sigma_v, "m/sqrt(s)", "all")
        self.dimensions = dimensions

    @property
    def noise_dimension(self) -> int:
        return self.dimensions

    def step(self, state: Placed, inputs: Inputs, dt: Scalar, w: Vector) -> Placed:
        return Placed(state.position + w * (self.sigma_v.value * jnp.sqrt(dt)))

    def log_density(self, state: Placed, inputs: Inputs, dt: Scalar, w: Vector) -> Scalar:
        return total(draw_log_density(x, self.sigma_v.value) for x in w)


class GroundMotion(AbstractMotion):
    """Constant velocity over the floor, and a height that drifts as a random walk: people, trolleys, tools on a belt.

    `sigma_a`: m/s² per √Hz, horizontal. `sigma_z`: m per √s, vertical. A state whose position has two components
    moves over the floor alone, at a known height, with the same horizontal noise.
    """

    sigma_a: Noise
    sigma_z: Noise

    def __init__(self, sigma_a: float | Noise, sigma_z: float | Noise):
        self.sigma_a = process_noise(sigma_a, "m/s^2/sqrt(Hz)", "horizontal")
        self.sigma_z = process_noise(sigma_z, "m/sqrt(s)", "vertical")

    @property
    def noise_dimension(self) -> int:
        return 5

    def step(self, state: Kinematic, inputs: Inputs, dt: Scalar, w: Vector) -> Kinematic:
        floor = Kinematic(Vector(*state.position.parts[:2]), state.velocity)
        moved = ConstantVelocity(self.sigma_a, 2).step(floor, inputs, dt, Vector(*w.parts[:4]))
        drift = w[4] * (self.sigma_z.value * jnp.sqrt(dt))
        heights = [z + drift for z in state.position.parts[2:]]
        return Kinematic(Vector(*moved.position, *heights), moved.velocity)

    def log_density(self, state: Kinematic, inputs: Inputs, dt: Scalar, w: Vector) -> Scalar:
        across = total(draw_log_density(x, self.sigma_a.value) for x in w.parts[:4])
        return across + draw_log_density(w[4], self.sigma_z.value) if len(state.position) == 3 else across
