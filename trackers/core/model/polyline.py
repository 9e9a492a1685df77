"""A known path on the floor: a polyline, parametrised by arclength."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike

from trackwright.trackers.core.model.algebra import Scalar, Vector, total
from trackwright.trackers.core.model.rig import checked_knots
from trackwright.trackers.core.model.state import wrap

FEW = 16  # most segments for which a position is a sum over the joins; with more, its segment is looked up

LOOK_UP = "scan_unrolled"  # binary search, unrolled: fast on accelerators and for batches of particles


class Polyline(eqx.Module):
    """The path through `knots` (k, 2) m, by arclength d in m from its first knot, clipped at its ends.

    A path whose last knot equals its first is closed: d and d + length are the same position. With few segments a
    position is a sum over the joins sₖ, so that thousands of particles need no look-up: x(d) = x₀ + u₀·d +
    Σ (uₖ − uₖ₋₁)·max(d − sₖ, 0), which is (2.5) of the thesis for its five segments. Raises ValueError for a knot that
    is not finite or repeats the previous one.
    """

    knots: Float[Array | np.ndarray, "k 2"]
    directions: Float[Array | np.ndarray, "k-1 2"]
    starts: Float[Array | np.ndarray, " k-1"]
    lengths: Float[Array | np.ndarray, " k-1"]
    length: Scalar
    closed: bool = eqx.field(static=True)

    def __init__(self, knots: ArrayLike):
        knots = checked_knots(knots)
        steps = np.diff(knots, axis=0)
        lengths = np.sqrt((steps**2).sum(axis=1))
        self.knots = knots
        self.directions = steps / lengths[:, None]
        self.starts = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
        self.lengths = lengths
        self.length = float(lengths.sum())
        self.closed = bool(np.array_equal(knots[0], knots[-1]))

    @property
    def joins(self) -> Float[Array | np.ndarray, " joins"]:
        """The arclengths at which two segments meet, m, in order, including the end of a closed path."""
        return jnp.append(self.starts[1:], self.length) if self.closed else self.starts[1:]

    def next_join(self, arclength: Float[Array, "*rows"]) -> Float[Array, "*rows"]:
        """The first join beyond these arclengths, m; infinite where there is none."""
        joins = self.joins
        if len(joins) > FEW:
            return jnp.append(joins, jnp.inf)[jnp.searchsorted(joins, arclength, side="right", method=LOOK_UP)]
        ahead = jnp.full_like(arclength, jnp.inf)
        for k in reversed(range(len(joins))):
            ahead = jnp.where(arclength < joins[k], joins[k], ahead)
        return ahead

    def on_path(self, arclength: Scalar) -> Scalar:
        """The arclength within 0 … `length`: clipped, or modulo the length of a closed path."""
        if self.closed:
            arclength = arclength - self.length * jnp.floor(arclength / self.length)
        return jnp.clip(arclength, 0.0, self.length)

    def gathered(self, arclength: Float[Array, " N"], weights: Float[Array, " N"]) -> Float[Array, " N"]:
        """Arclengths (N,) that can be averaged: unwrapped about their circular mean if the path is closed."""
        if not self.closed:
            return arclength
        angle = arclength * (2.0 * jnp.pi / self.length)
        mean = jnp.arctan2(jnp.sum(weights * jnp.sin(angle)), jnp.sum(weights * jnp.cos(angle)))
        return (mean + wrap(angle - mean)) * (self.length / (2.0 * jnp.pi))

    def position(self, arclength: Scalar) -> Vector:
        """The position at this arclength, m."""
        along = self.on_path(arclength)
        if len(self.starts) > FEW:
            k = self._segment(along)
            corner, ahead = jnp.asarray(self.knots)[k], jnp.asarray(self.directions)[k]
            beyond = along - jnp.asarray(self.starts)[k]
            return Vector.of(corner[..., a] + ahead[..., a] * beyond for a in (0, 1))
        joins, (x0, _), (_, y1) = self.starts[1:], self.knots[0], self.knots[-1]
        turns = [b - a for a, b in zip(self.directions[:-1], self.directions[1:], strict=True)]
        # y from the far end: terms shared by both sums would go through memory, one array of particles each.
        x = x0 + self.directions[0][0] * along
        y = y1 - self.directions[-1][1] * (self.length - along)
        for turn, s in zip(turns, joins, strict=True):
            x, y = x + turn[0] * jnp.maximum(along - s, 0.0), y + turn[1] * jnp.maximum(s - along, 0.0)
        return Vector(x, y)

    def direction(self, arclength: Scalar) -> Vector:
        """The unit vector of the segment at this arclength; at a join, of the segment that begins there."""
        along = self.on_path(arclength)
        if len(self.starts) > FEW:
            directions = jnp.asarray(self.directions)[self._segment(along)]
            return Vector(directions[..., 0], directions[..., 1])
        here = [jnp.where(along >= s, 1.0, 0.0) for s in self.starts[1:]]
        turns = [b - a for a, b in zip(self.directions[:-1], self.directions[1:], strict=True)]
        return Vector.of(
            self.directions[0][a] + total(t[a] * h for t, h in zip(turns, here, strict=True)) for a in (0, 1)
        )

    def _segment(self, along: Float[Array, "*rows"]) -> Int[Array, "*rows"]:
        return jnp.searchsorted(self.starts[1:], along, side="right", method=LOOK_UP)
