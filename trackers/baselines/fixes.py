"""Trackers of fixes: Kalman filters of constant velocity and of Singer's model, moving average and median.

Of particles with a floor plan, a potential removes those whose move crosses a wall.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.errors import is_count, require
from trackwright.trackers.core.filters.particle.filter import AbstractPotential, ParticleFilter
from trackwright.trackers.core.filters.particle.resampling import LOG_ZERO
from trackwright.trackers.core.model.algebra import Scalar, Vector, triangle
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.core.model.motion import ConstantVelocity, GroundMotion, Placed
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker, Tracker
from trackwright.trackers.parts.fixes import ELSEWHERE, FIXES, PATIENT, FixSensor, FixStart
from trackwright.trackers.parts.median import nan_median


def fix_tracker(
    sigma_a: float = 1.0,
    sigma_z: float = 0.3,
    sigma_horizontal: float = 0.1,
    sigma_vertical: float = 0.3,
    dof: float | None = 4.0,
    planar: bool = False,
) -> Tracker:
    """Constant velocity in x and y, from fixes; the height is a random walk, or known and not estimated if `planar`.

    `sigma_a` m/s² per √Hz, `sigma_z` m per √s; the sensor's sigmas m. `dof`: degrees of freedom of Student's t, None
    for normal noise.
    """
    sensor = FixSensor(sigma_horizontal, sigma_vertical, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), planar, 2)
    return Tracker(GroundMotion(sigma_a, sigma_z), {FIXES: sensor}, start, track_loss=PATIENT, latency_of=FIXES)


def singer_tracker(
    sigma_a: float = 1.0,
    tau: float = 1.0,
    sigma_horizontal: float = 0.1,
    sigma_vertical: float = 0.3,
    dof: float | None = 4.0,
    planar: bool = False,
) -> Tracker:
    """Singer's motion (1970) from fixes, in three dimensions or, if `planar`, in x and y.

    `sigma_a` m/s² and `tau` s: standard deviation and time constant of the acceleration; the sensor's sigmas m.
    """
    from trackwright.trackers.parts.singer import Singer

    n = 2 if planar else 3
    sensor = FixSensor(sigma_horizontal, sigma_vertical, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), planar, n, n)
    return Tracker(Singer(sigma_a, tau, n), {FIXES: sensor}, start, track_loss=PATIENT, latency_of=FIXES)


class MovingWindow(AbstractEpochwiseTracker):
    """The mean, or the `median`, of each axis over its last `window` values, from the first value on.

    It lags behind a moving tag by half the window. The covariance is NaN. `planar`: x and y alone. Raises UnusableInput
    for a window below 1.
    """

    window: int = eqx.field(static=True)
    median: bool = eqx.field(static=True)
    planar: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        least = is_count(self.window) and self.window > 0
        require(least, "MovingWindow", self.window, "a window of at least one row, as MovingWindow(9, median=True)")

    def check_layout(self, layout: Layout) -> None:
        layout.check_readings("MovingWindow", FIXES, 2 if self.planar else 3)

    def scan(self, batch: Batch, initial: Any = None) -> tuple[Output, Any]:
        reading = batch.readings[FIXES]
        axes = 2 if self.planar else 3
        values, seen = jnp.asarray(reading.values)[:, :axes], jnp.asarray(reading.seen)[:, :axes]
        seen = seen & jnp.asarray(batch.valid)[:, None]
        empty = jnp.full((self.window, *values.shape[1:]), jnp.nan, values.dtype)
        before = empty if initial is None else jnp.moveaxis(jnp.asarray(initial), 0, -1)

        def step(window: Any, row: Any) -> tuple[Any, Any]:
            value, value_seen = row
            window = jnp.where(value_seen, jnp.concatenate([window[1:], value[None]]), window)
            return window, nan_median(window) if self.median else jnp.nanmean(window, axis=0)

        after, position = jax.lax.scan(step, before, (values, seen))
        known = jnp.isfinite(position).all(axis=1)
        zero = jnp.zeros_like(position[:, 0])
        mean = Placed(Vector(*(jnp.where(known, position[:, k], 0.0) for k in range(axes))))
        cov = tuple(zero + jnp.nan for _ in triangle(axes))
        status = jnp.where(jnp.asarray(batch.valid), jnp.where(known, Status.OK, Status.WAITING), Status.PADDING)
        output = Output(mean, cov, zero, zero, zero, zero, status.astype(jnp.int8))
        return output, jnp.moveaxis(after, -1, 0)


def floor_tracker(
    walls: Walls,
    sigma_a: float = 1.0,
    sigma_horizontal: float = 0.1,
    dof: float | None = 4.0,
    n_particles: int = 1000,
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
        rises = b[1] > a[1]
        passes = ((a[1] > position[1]) != (b[1] > position[1])) & (_left(a, b, position) == rises)
        return jnp.sum(passes.astype(jnp.int32)) % 2 == 1


def _left(a: Any, b: Any, p: Any) -> Any:
    """Whether p lies to the left of the line from a to b."""
    return (b[0] - a[0]) * (p[1] - a[1]) > (b[1] - a[1]) * (p[0] - a[0])
