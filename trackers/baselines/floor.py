"""The floor plan as a potential that removes particles whose move crosses a wall, and the tracker of fixes with it."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from trackwright.trackers.core.filters.particle.filter import AbstractPotential, ParticleFilter
from trackwright.trackers.core.filters.particle.resampling import LOG_ZERO
from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.core.model.motion import ConstantVelocity
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.fixes import ELSEWHERE, FIXES, FixSensor, FixStart


def floor_tracker(
    walls: Walls, sigma_a: float = 1.0, sigma_horizontal: float = 0.1, dof: float | None = 4.0, n_particles: int = 1000
) -> Tracker:
    """Planar constant velocity from fixes by particles, with weight zero for a particle that crosses a wall.

    The model of a planar `fix_tracker` with a floor plan (reference [25] of the thesis). `sigma_a` m/s² per √Hz,
    `sigma_horizontal` m; `dof`: degrees of freedom of Student's t, None for normal noise. Once no particle is left the
    track restarts at the next fix, and where later fixes agree on another place. Gradients are score-function
    estimates: `trackers/core/filters/particle/filter.py`.
    """
    sensor = FixSensor(sigma_horizontal, sigma_horizontal, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), True, 2)
    particles = ParticleFilter(n_particles, potential=walls)
    return Tracker(ConstantVelocity(sigma_a, 2), {FIXES: sensor}, start, particles, ELSEWHERE, FIXES)


class Walls(AbstractPotential):
    """A floor plan: weight zero for a straight move that crosses a wall, or starts or ends outside the outline.

    `segments` (n, 4): walls, x1, y1, x2, y2 in m. `outline` (m, 2): the floor's corners in order, m; its edges are
    walls. A position on a wall counts as on its right side, seen from the first end; walls that share an end leave no
    gap. Raises ValueError if there is neither, and for walls that are not finite or have no length.
    """

    view_fields: ClassVar[tuple[str, ...]] = ("position",)

    segments: AnyArray
    outline: AnyArray

    def __init__(self, segments: ArrayLike = (), outline: ArrayLike = ()):
        edges = np.asarray(outline, float).reshape(-1, 2) if np.size(outline) else np.zeros((0, 2))
        if 0 < len(edges) < 3:
            raise ValueError(f"an outline has at least three corners [x, y], found {len(edges)}")
        walls = np.asarray(segments, float) if np.size(segments) else np.zeros((0, 4))
        if walls.ndim != 2 or walls.shape[1] != 4:
            raise ValueError(f"walls are a list of [x1, y1, x2, y2], found an array of shape {walls.shape}")
        walls = np.vstack([walls, np.hstack([edges, np.roll(edges, -1, axis=0)])])
        if len(walls) == 0:
            raise ValueError("a floor plan has walls or an outline, found neither")
        if not np.all(np.isfinite(walls)):
            raise ValueError(f"wall {int(np.argmin(np.isfinite(walls).all(axis=1)))} is not finite")
        lengths = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
        if not np.all(lengths > 0):
            k = int(np.argmin(lengths))
            raise ValueError(f"wall {k}, {walls[k].tolist()}, has no length; leave it out")
        self.segments, self.outline = walls, edges

    def log_weight(self, before: Any, after: Any) -> Scalar:
        start, end = tuple(before.position)[:2], tuple(after.position)[:2]
        first, last = self.segments[:, :2].T, self.segments[:, 2:].T
        crosses = (_left(first, last, start) != _left(first, last, end)) & (
            _left(start, end, first) != _left(start, end, last)
        )
        blocked = jnp.any(crosses)
        if len(self.outline):
            # The start as well: the first particles of a track are drawn from a prior without walls.
            blocked = blocked | ~self._inside(start) | ~self._inside(end)
        return jnp.where(blocked, LOG_ZERO, 0.0).astype(start[0].dtype)

    def _inside(self, position: Any) -> Scalar:
        """Whether a position lies inside the outline: a ray in +x crosses an odd number of its edges."""
        a, b = self.outline.T, jnp.roll(self.outline, -1, axis=0).T
        passes = ((a[1] > position[1]) != (b[1] > position[1])) & (_left(a, b, position) == (b[1] > a[1]))
        return jnp.sum(passes.astype(jnp.int32)) % 2 == 1


def _left(a: Any, b: Any, p: Any) -> Any:
    """Whether p lies to the left of the line from a to b."""
    return (b[0] - a[0]) * (p[1] - a[1]) > (b[1] - a[1]) * (p[0] - a[0])
