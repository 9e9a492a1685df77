"""A filter on a grid of arclength and speed: Bayes' rule cell by cell, exact up to the grid, and differentiable.

No particles, so no scatter: its likelihood has a gradient in every noise level, and it is the oracle of the particle
filter on the same motion.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr

from trackers.core.algebra import Scalar, compute_once, total
from trackers.core.ekf import Gaussian, Innovation
from trackers.core.motion import AbstractMotion
from trackers.core.particle.filter import particle_residuals, weighted_moments, weighted_nis
from trackers.core.polyline import Polyline
from trackers.core.sensor import AbstractSensor, Reading
from trackers.core.state import State
from trackers.line.motion import HaltingMotion, LineMotion, OnFloor, OnLine

ROUNDS = 2
"""Rounds of a closed path that a belief may reach either way when it begins."""


class Discrete(NamedTuple):
    """A belief: probabilities of travelling (cells, speeds) and of resting (cells,), which add to 1."""

    travelling: Any
    resting: Any


class GridFilter(eqx.Module):
    """`cells` places along the path, the first and last at its ends, and `speeds` from 0 to `fastest` m/s.

    Of a closed path the place after the last is the first.

    The motion is a `LineMotion` or a `HaltingMotion`, whose steps are copied law for law: travel shares a cell's
    probability between the two cells it falls between, a change of speed is the heat kernel of the grid, whose mean and
    variance are right however small the change. Sensors read the position. Nothing is faster than `fastest`.
    """

    output_map: OnFloor
    cells: int = eqx.field(static=True)
    speeds: int = eqx.field(static=True)
    fastest: float = eqx.field(static=True)

    @property
    def line(self) -> Polyline:
        """The path."""
        return self.output_map.line

    @property
    def has_particle_axis(self) -> bool:
        """True: the belief has an axis of its own."""
        return True

    def init(self, belief: Gaussian, key: Any) -> Discrete:
        """The probabilities of a normal belief with independent components; what is off the grid counts at its edge."""
        variances = belief.cov[0], belief.cov[len(belief.mean)]
        (place, speed), sigmas = belief.mean[:2], [jnp.sqrt(jnp.maximum(v, 1e-12)) for v in variances]
        cells, fast = self._axes(place.dtype)
        fast = _masses(fast, speed, sigmas[1])
        along = self._around(cells, place, sigmas[0]) if self.line.closed else _masses(cells, place, sigmas[0])
        resting = belief.mean.resting if hasattr(belief.mean, "resting") else 0.0
        return Discrete(along[:, None] * fast[None, :] * (1.0 - resting), along * resting)

    def predict(self, belief: Discrete, motion: AbstractMotion, inputs: Any, dt: Scalar) -> Discrete:
        """The belief `dt` seconds later."""
        if not isinstance(motion, (LineMotion, HaltingMotion)):
            raise TypeError(f"a grid on a line knows LineMotion and HaltingMotion, found {type(motion).__name__}")
        along, fast = self._axes(belief.resting.dtype)
        travelling, resting = belief
        if isinstance(motion, HaltingMotion):
            travelling, halted = self._halted(travelling, motion, along, fast * dt)
            leaving = motion.leaving(dt)
            departing = _masses(fast, 0.0 * dt, motion.sigma_departure.value)
            departing = departing.at[1:].add(departing[1:]).at[0].set(2.0 * departing[0] - 1.0)
        travelling = self._moved(travelling, fast * (dt / along[1]))
        changes = self._changes(motion.sigma_a.value * jnp.sqrt(dt) / fast[1])
        travelling = jnp.matmul(travelling, changes, precision="highest")
        if isinstance(motion, HaltingMotion):
            travelling = travelling + (leaving * resting)[:, None] * departing[None, :]
            resting = (1.0 - leaving) * resting + halted
        return compute_once(Discrete(travelling, resting))

    def update(
        self, belief: Discrete, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Any
    ) -> tuple[Discrete, Innovation]:
        """The belief after one reading, and what the reading said."""
        along, _ = self._axes(belief.resting.dtype)
        seen = particle_residuals(OnLine(along, jnp.zeros_like(along)), motion, sensor, reading, inputs)
        densities = seen.log_density
        places = jnp.sum(belief.travelling, axis=1) + belief.resting
        top = jnp.max(densities)
        factor = jnp.exp(densities - top)
        likelihood = jnp.sum(places * factor)
        factor = factor / likelihood
        nis = weighted_nis(seen.whitened, places, seen.dof)
        wrapped = jnp.zeros_like(nis) if seen.wrapped is None else jnp.sum(places * seen.wrapped)
        innovation = Innovation(jnp.log(likelihood) + top, nis, seen.nis_dof, wrapped)
        return compute_once(Discrete(belief.travelling * factor[:, None], belief.resting * factor)), innovation

    def moments(self, belief: Discrete) -> tuple[State, tuple[Scalar, ...]]:
        """Place and velocity at the mean arclength and speed, and the spread of both over the floor about them."""
        along, fast = self._axes(belief.resting.dtype)
        still = jnp.zeros_like(along)
        states = OnLine(
            jnp.concatenate([jnp.repeat(along, self.speeds), along]),
            jnp.concatenate([jnp.tile(fast, self.cells), still]),
        )
        weights = jnp.concatenate([belief.travelling.reshape(-1), belief.resting])
        return weighted_moments(states, weights, self.output_map)

    def _around(self, cells: Any, mean: Scalar, sigma: Scalar) -> Any:
        """The probabilities of a normal number in the cells of a closed path, rounds of which are the same."""
        middles = cells - 0.5 * cells[1]
        edges = jnp.append(middles, middles[0] + self.line.length)
        rounds = [ndtr((edges + (k * self.line.length - mean)) / sigma) for k in range(-ROUNDS, ROUNDS + 1)]
        masses = total(jnp.diff(edges) for edges in rounds)
        return masses / jnp.sum(masses)

    def _axes(self, dtype: Any) -> tuple[Any, Any]:
        """The places (cells,), m, and the speeds (speeds,), m/s."""
        spacing = jnp.asarray(self.line.length, dtype) / (self.cells if self.line.closed else self.cells - 1)
        steps = jnp.arange(self.speeds, dtype=dtype) * (self.fastest / (self.speeds - 1))
        return jnp.arange(self.cells, dtype=dtype) * spacing, steps

    def _moved(self, travelling: Any, shift: Any) -> Any:
        """Every column moved on by its own number of cells, (speeds,); at the end of a path with ends it stays."""
        whole = jnp.minimum(jnp.floor(shift), self.cells)
        part = jnp.clip(shift - whole, 0.0, 1.0)[None, :]
        source = jnp.arange(self.cells, dtype=jnp.int32)[:, None] - whole.astype(jnp.int32)[None, :]
        if self.line.closed:
            pieces = [jnp.take_along_axis(travelling, s % self.cells, axis=0) for s in (source, source - 1)]
            return (1.0 - part) * pieces[0] + part * pieces[1]
        pieces = [
            jnp.where(s >= 0, jnp.take_along_axis(travelling, jnp.maximum(s, 0), axis=0), 0.0)
            for s in (source, source - 1)
        ]
        moved = (1.0 - part) * pieces[0] + part * pieces[1]
        rest = jnp.sum(travelling, axis=0) - jnp.sum(moved[:-1], axis=0)
        return moved.at[-1].set(jnp.maximum(rest, 0.0))

    def _changes(self, sigma: Scalar) -> Any:
        """The matrix (speeds, speeds) of max(0, speed + a), a of `sigma` grid steps: e^(σ²Δ/2), folded at both ends."""
        n = self.speeds
        angles = 2 * np.pi * np.arange(4 * n) / (4 * n)
        reach = np.arange(2 * n)
        cosines = jnp.asarray(np.cos(np.outer(reach, angles)) / (4 * n), sigma.dtype)
        decay = jnp.exp(sigma**2 * jnp.asarray(np.cos(angles) - 1.0, sigma.dtype))
        kernel = jnp.maximum(jnp.matmul(cosines, decay, precision="highest"), 0.0)
        # Beyond j steps, by running sums from the far end, which stay positive.
        beyond = jnp.matmul(jnp.asarray(np.triu(np.ones((2 * n, 2 * n))), sigma.dtype), kernel, precision="highest")
        apart = np.abs(np.arange(n)[None, :] - np.arange(n)[:, None])
        changes = kernel[apart]
        changes = changes.at[:, 0].set(beyond[np.arange(n)]).at[:, n - 1].set(beyond[n - 1 - np.arange(n)])
        return changes / jnp.sum(changes, axis=1, keepdims=True)

    def _halted(self, travelling: Any, motion: HaltingMotion, along: Any, steps: Any) -> tuple[Any, Any]:
        """What travels on, and what halts at the first join it reaches in steps of (speeds,) m, by cell."""
        tolerance = 1e-3 * along[1]
        ahead = self.line.next_join(along + tolerance) - tolerance
        halting = jnp.where(ahead[:, None] <= along[:, None] + steps[None, :], travelling * motion.halting.value, 0.0)
        there = jnp.ceil(jnp.where(jnp.isfinite(ahead), ahead, 0.0) / along[1]).astype(jnp.int32) % self.cells
        return travelling - halting, jnp.zeros_like(along).at[there].add(jnp.sum(halting, axis=1))


def _masses(grid: Any, mean: Scalar, sigma: Scalar) -> Any:
    """The probabilities of a normal number in the cells of an even grid, what is beyond its ends in the last ones."""
    edges = ndtr((0.5 * (grid[1:] + grid[:-1]) - mean) / sigma)
    return jnp.diff(edges, prepend=jnp.zeros_like(edges[:1]), append=jnp.ones_like(edges[:1]))
