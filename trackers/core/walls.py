"""Walls that a move cannot cross: a floor plan as a potential over moves, for particle filters."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar
from trackers.core.resampling import NOTHING


class AbstractPotential(eqx.Module):
    """What a move says by itself, without any reading: a factor of the weight of the particle that made it."""

    @abstractmethod
    def log_weight(self, before: Any, after: Any) -> Scalar:
        """The factor's logarithm, from what the motion shows of the states before and after: 0 for a usual move.

        NOTHING (`trackers/core/resampling.py`) for one that is impossible.
        """


class Walls(AbstractPotential):
    """Straight walls: `segments` (n, 4), x1, y1, x2, y2 in m; a particle whose way between two rows crosses one dies.

    The way is a straight line over the floor (Nurminen et al. 2013 and others weigh by maps in this way). A place on a
    wall counts as its right-hand side, seen from the first end to the second, and walls that share an end leave no gap.
    Raises ValueError for segments that aren't finite or have no length.
    """

    segments: Any

    def __init__(self, segments: Any):
        segments = np.asarray(segments, float)
        if segments.ndim != 2 or segments.shape[1:] != (4,) or len(segments) == 0:
            raise ValueError(f"walls are a list of [x1, y1, x2, y2], found an array of shape {segments.shape}")
        if not np.all(np.isfinite(segments)):
            raise ValueError(f"wall {int(np.argmin(np.isfinite(segments).all(axis=1)))} is not finite")
        lengths = np.hypot(*(segments[:, 2:] - segments[:, :2]).T)
        if not np.all(lengths > 0):
            k = int(np.argmin(lengths))
            raise ValueError(f"wall {k}, {segments[k].tolist()}, has no length; leave it out")
        self.segments = segments

    def log_weight(self, before: Any, after: Any) -> Scalar:
        start, end = tuple(before.position)[:2], tuple(after.position)[:2]
        first, last = self.segments[:, :2].T, self.segments[:, 2:].T
        crosses = (_left(first, last, start) != _left(first, last, end)) & (
            _left(start, end, first) != _left(start, end, last)
        )
        return jnp.where(jnp.any(crosses), NOTHING, 0.0).astype(start[0].dtype)


def _left(a: Any, b: Any, p: Any) -> Any:
    """Whether p lies to the left of the way from a to b."""
    return (b[0] - a[0]) * (p[1] - a[1]) > (b[1] - a[1]) * (p[0] - a[0])
