"""A known path on the floor: straight segments between knots, by the length travelled along it."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, Vector, total


class Polyline(eqx.Module):
    """The path through `knots` (k, 2) m, by arclength d in m from its first knot; beyond its ends it stays there.

    Places are sums over the joins sₖ, so that thousands of particles need no look-up: x(d) = x₀ + u₀·d +
    Σ (uₖ − uₖ₋₁)·max(d − sₖ, 0) with d cut off at the ends, which is (2.5) of the thesis for its five segments. Raises
    ValueError for a knot that is not finite or repeats the one before.
    """

    first: Any
    last: Any
    directions: Any
    starts: Any
    lengths: Any
    length: Any

    def __init__(self, knots: Any):
        knots = np.asarray(knots, float)
        if knots.ndim != 2 or knots.shape[1:] != (2,) or len(knots) < 2:
            raise ValueError(f"a path has at least two knots [x, y], found an array of shape {knots.shape}")
        if not np.all(np.isfinite(knots)):
            raise ValueError(f"knot {int(np.argmin(np.isfinite(knots).all(axis=1)))} of the path is not finite")
        steps = np.diff(knots, axis=0)
        lengths = np.sqrt((steps**2).sum(axis=1))
        if not np.all(lengths > 0):
            k = int(np.argmin(lengths)) + 1
            raise ValueError(f"knot {k} of the path repeats the one before, {knots[k].tolist()}; leave one of them out")
        self.first, self.last = knots[0], knots[-1]
        self.directions = steps / lengths[:, None]
        self.starts = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
        self.lengths = lengths
        self.length = float(lengths.sum())

    @property
    def joins(self) -> list[Scalar]:
        """The arclengths at which two segments meet, m."""
        return [self.starts[k] for k in range(1, np.shape(self.starts)[0])]

    def position(self, arclength: Scalar) -> Vector:
        """The place at this arclength, m."""
        along = jnp.clip(arclength, 0.0, self.length)
        joins, (x0, _), (_, y1) = self.starts[1:], self.first, self.last
        turns = [b - a for a, b in zip(self.directions[:-1], self.directions[1:], strict=True)]
        # y from the far end: terms that both sums share would go through memory, one array of particles each.
        x = x0 + self.directions[0][0] * along
        y = y1 - self.directions[-1][1] * (self.length - along)
        for turn, s in zip(turns, joins, strict=True):
            x, y = x + turn[0] * jnp.maximum(along - s, 0.0), y + turn[1] * jnp.maximum(s - along, 0.0)
        return Vector(x, y)

    def direction(self, arclength: Scalar) -> Vector:
        """The unit vector of the segment at this arclength; at a join that of the segment which begins there."""
        here = [jnp.where(arclength >= s, 1.0, 0.0) for s in self.starts[1:]]
        turns = [b - a for a, b in zip(self.directions[:-1], self.directions[1:], strict=True)]
        return Vector.of(
            self.directions[0][a] + total(t[a] * h for t, h in zip(turns, here, strict=True)) for a in (0, 1)
        )

    def nearest(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The arclengths of the points of the path nearest to `places` (..., 2), and their distances, m; NumPy."""
        first, directions = np.asarray(self.first, float), np.asarray(self.directions, float)
        starts, lengths = np.asarray(self.starts, float), np.asarray(self.lengths, float)
        corners = first + np.concatenate([[[0.0, 0.0]], np.cumsum(directions * lengths[:, None], axis=0)[:-1]])
        apart = np.asarray(places, float)[..., None, :] - corners
        along = np.clip((apart * directions).sum(axis=-1), 0.0, lengths)
        distance = np.sqrt(((apart - along[..., None] * directions) ** 2).sum(axis=-1))
        best = np.argmin(distance, axis=-1)[..., None]
        arclength = np.take_along_axis(starts + along, best, -1)[..., 0]
        return arclength, np.take_along_axis(distance, best, -1)[..., 0]
