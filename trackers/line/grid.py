"""Grid filter (point-mass filter) of arclength and speed on a known path: Bayes' rule, exact up to the grid.

Its likelihood is deterministic and differentiable in every noise level; it is the oracle of the particle filter with
the same motion.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from trackwright.trackers.core.filters.filter import AbstractFilter, Innovation
from trackwright.trackers.core.filters.particle.filter import particle_residuals, weighted_moments, weighted_nis
from trackwright.trackers.core.model.algebra import Scalar, compute_once, total
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import AnyArray, Inputs, RawKey
from trackwright.trackers.core.model.linearise import covariance_of
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading
from trackwright.trackers.core.model.state import State
from trackwright.trackers.line.motion import HaltingMotion, LineMotion, PathOutputMap, PathState

LAPS = 2  # laps of a closed path, in either direction, over which the initial normal distribution is summed

NO_MASS = 1e-15  # a probability that does not count: a quotient of smaller ones has no derivative


class GridBelief(NamedTuple):
    """Probabilities of travelling (cells, speeds) and of resting (cells,), which sum to 1."""

    travelling: jax.Array
    resting: jax.Array


class GridFilter(AbstractFilter[GridBelief]):
    """`cells` arclengths along the path, the first and last at its ends, and `speeds` from 0 to `fastest` m/s.

    On a closed path the cell after the last is the first. The motion is a `LineMotion` or a `HaltingMotion`. Travel
    divides a cell's probability between the two cells nearest to its destination; a change of speed is the discrete
    heat kernel, whose mean and variance are exact however small the change. Sensors measure the
    position. Speeds are clipped to `fastest`.
    """

    output_map: PathOutputMap
    cells: int = eqx.field(static=True)
    speeds: int = eqx.field(static=True)
    fastest: float = eqx.field(static=True)

    has_particle_axis: ClassVar[bool] = True

    @property
    def line(self) -> Polyline:
        """The path."""
        return self.output_map.line

    def init(self, belief: Gaussian, key: RawKey) -> GridBelief:
        """The cells' probabilities of a normal prior with independent components; the tails go to the edges."""
        arclength, speed = belief.mean.arclength, belief.mean.speed
        cov = covariance_of(belief.mean, belief.cov, lambda state: (state.arclength, state.speed))
        sigmas = [jnp.sqrt(jnp.maximum(cov[k, k], 1e-12)) for k in range(2)]
        cells, speeds = self._axes(arclength.dtype)
        fast = _bin_masses(speeds, speed, sigmas[1])
        bins = self._wrapped_masses if self.line.closed else _bin_masses
        along = bins(cells, arclength, sigmas[0])
        resting = belief.mean.resting if hasattr(belief.mean, "resting") else 0.0
        return GridBelief(along[:, None] * fast[None, :] * (1.0 - resting), along * resting)

    def predict(self, belief: GridBelief, motion: AbstractMotion, inputs: Inputs, dt: Scalar) -> GridBelief:
        """The belief `dt` seconds later."""
        if not isinstance(motion, (LineMotion, HaltingMotion)):
            raise TypeError(f"GridFilter supports LineMotion and HaltingMotion, found {type(motion).__name__}")
        along, fast = self._axes(belief.resting.dtype)
        travelling, resting = belief
        if isinstance(motion, HaltingMotion):
            travelling, halted = self._split_at_joins(travelling, motion, along, fast * dt)
            leaving = motion.leaving(dt)
            departing = _bin_masses(fast, 0.0 * dt, motion.sigma_departure.value)
            departing = compute_once(departing.at[1:].add(departing[1:]).at[0].set(2.0 * departing[0] - 1.0))
        travelling = self._advanced(travelling, fast * (dt / along[1]))
        if isinstance(motion, HaltingMotion) and motion.travel is not None:
            stopped = travelling * motion.stopping(dt)
            travelling, halted = travelling - stopped, halted + jnp.sum(stopped, axis=1)
        transition = self._speed_transition(motion.sigma_a.value * jnp.sqrt(dt) / fast[1])
        travelling = jnp.matmul(travelling, transition, precision="highest")
        if isinstance(motion, HaltingMotion):
            travelling = travelling + (leaving * resting)[:, None] * departing[None, :]
            resting = (1.0 - leaving) * resting + halted
        return compute_once(GridBelief(travelling, resting))

    def update(
        self, belief: GridBelief, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
    ) -> tuple[GridBelief, Innovation]:
        """The belief given one reading, and its innovation."""
        along, _ = self._axes(belief.resting.dtype)
        seen = particle_residuals(PathState(along, jnp.zeros_like(along)), motion, sensor, reading, inputs)
        densities = seen.log_density
        probabilities = jnp.sum(belief.travelling, axis=1) + belief.resting
        # Relative to the best cell that has any probability: beside a wild reading's foot all others would underflow.
        possible = probabilities > jnp.finfo(probabilities.dtype).tiny
        top = jax.lax.stop_gradient(jnp.max(jnp.where(possible, densities, -jnp.inf)))
        factor = jnp.exp(jnp.where(possible, densities - top, -jnp.inf))
        likelihood = jnp.sum(probabilities * factor)
        factor = factor / likelihood
        nis = weighted_nis(seen.whitened, probabilities, seen.dof)
        wrapped = jnp.zeros_like(nis) if seen.wrapped is None else jnp.sum(probabilities * seen.wrapped)
        innovation = Innovation(jnp.log(likelihood) + top, nis, seen.nis_dof, wrapped)
        return compute_once(GridBelief(belief.travelling * factor[:, None], belief.resting * factor)), innovation

    def moments(self, belief: GridBelief) -> tuple[State, tuple[Scalar, ...]]:
        """Position and velocity at the mean arclength and speed, and their covariance on the floor."""
        along, fast = self._axes(belief.resting.dtype)
        mass, first, second = (jnp.sum(belief.travelling * fast[None] ** k, axis=1) for k in range(3))
        # Two speeds for each cell, of which one is zero, have the moments of all; a cell without any has the speed 1.
        speed = (second + NO_MASS) / (first + NO_MASS)
        moving = first / speed
        states = PathState(jnp.tile(along, 2), jnp.concatenate([speed, jnp.zeros_like(speed)]))
        return weighted_moments(states, jnp.concatenate([moving, mass - moving + belief.resting]), self.output_map)

    def _wrapped_masses(self, cells: AnyArray, mean: Scalar, sigma: Scalar) -> jax.Array:
        """The probabilities of a wrapped normal distribution in the cells of a closed path."""
        lower = cells - 0.5 * cells[1]
        edges = jnp.append(lower, lower[0] + self.line.length)
        laps = [ndtr((edges + (k * self.line.length - mean)) / sigma) for k in range(-LAPS, LAPS + 1)]
        masses = total(jnp.diff(edges) for edges in laps)
        return masses / jnp.sum(masses)

    def _axes(self, dtype: Any) -> tuple[jax.Array, jax.Array]:
        """The arclengths (cells,), m, and the speeds (speeds,), m/s."""
        spacing = jnp.asarray(self.line.length, dtype) / (self.cells if self.line.closed else self.cells - 1)
        steps = jnp.arange(self.speeds, dtype=dtype) * (self.fastest / (self.speeds - 1))
        return jnp.arange(self.cells, dtype=dtype) * spacing, steps

    def _advanced(self, travelling: AnyArray, shift: AnyArray) -> jax.Array:
        """Each column shifted by `shift` (speeds,) cells; probability stops at the end of an open path."""
        whole = jnp.minimum(jnp.floor(shift), self.cells)
        fraction = jnp.clip(shift - whole, 0.0, 1.0)[None, :]
        source = jnp.arange(self.cells, dtype=jnp.int32)[:, None] - whole.astype(jnp.int32)[None, :]
        if self.line.closed:
            shifted = [jnp.take_along_axis(travelling, s % self.cells, axis=0) for s in (source, source - 1)]
            return (1.0 - fraction) * shifted[0] + fraction * shifted[1]
        shifted = [
            jnp.where(s >= 0, jnp.take_along_axis(travelling, jnp.maximum(s, 0), axis=0), 0.0)
            for s in (source, source - 1)
        ]
        advanced = (1.0 - fraction) * shifted[0] + fraction * shifted[1]
        # A sum of what arrives: the rounding of a difference is a probability there, which a wild reading brings out.
        reached = jnp.arange(self.cells, dtype=shift.dtype)[:, None] + shift[None, :]
        arrived = jnp.clip(reached - (self.cells - 2), 0.0, 1.0)
        return advanced.at[-1].set(jnp.sum(travelling * arrived, axis=0))

    def _speed_transition(self, sigma: Scalar) -> jax.Array:
        """The transition matrix (speeds, speeds) of max(0, speed + a), with `sigma` of a in grid steps.

        The discrete heat kernel e^(σ²Δ/2), with the mass beyond either end added to the last speed there.
        """
        n = self.speeds
        angles = 2 * np.pi * np.arange(4 * n) / (4 * n)
        lags = np.arange(2 * n)
        cosines = jnp.asarray(np.cos(np.outer(lags, angles)) / (4 * n), sigma.dtype)
        decay = jnp.exp(sigma**2 * jnp.asarray(np.cos(angles) - 1.0, sigma.dtype))
        # Less the rounding of the sum, which would be a probability of every speed.
        kernel = jnp.maximum(jnp.matmul(cosines, decay, precision="highest") - jnp.finfo(sigma.dtype).eps, 0.0)
        # The mass beyond j steps, by cumulative sums from the far end, which stay positive.
        beyond = jnp.matmul(jnp.asarray(np.triu(np.ones((2 * n, 2 * n))), sigma.dtype), kernel, precision="highest")
        difference = np.abs(np.arange(n)[None, :] - np.arange(n)[:, None])
        transition = kernel[difference]
        transition = transition.at[:, 0].set(beyond[np.arange(n)]).at[:, n - 1].set(beyond[n - 1 - np.arange(n)])
        return transition / jnp.sum(transition, axis=1, keepdims=True)

    def _split_at_joins(
        self, travelling: jax.Array, motion: HaltingMotion, along: jax.Array, steps: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The mass that travels on (cells, speeds), and by cell the mass halted at joins within `steps` (speeds,) m."""
        tolerance = 1e-3 * along[1]
        ahead = self.line.next_join(along + tolerance) - tolerance
        halting = jnp.where(ahead[:, None] <= along[:, None] + steps[None, :], travelling * motion.halting.value, 0.0)
        there = jnp.ceil(jnp.where(jnp.isfinite(ahead), ahead, 0.0) / along[1]).astype(jnp.int32) % self.cells
        return travelling - halting, jnp.zeros_like(along).at[there].add(jnp.sum(halting, axis=1))


def _bin_masses(grid: AnyArray, mean: Scalar, sigma: Scalar) -> jax.Array:
    """The probabilities of a normal distribution in the cells of a uniform grid; the tails go to the end cells."""
    edges = ndtr((0.5 * (grid[1:] + grid[:-1]) - mean) / sigma)
    return jnp.diff(edges, prepend=jnp.zeros_like(edges[:1]), append=jnp.ones_like(edges[:1]))
