"""Trackers of fixes: Kalman filters of constant velocity and of Singer's model, moving average and median."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.errors import is_count, require
from trackwright.trackers.core.model.algebra import Vector, triangle
from trackwright.trackers.core.model.motion import GroundMotion, Placed
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker, Tracker
from trackwright.trackers.parts.fixes import FIXES, PATIENT, FixSensor, FixStart
from trackwright.trackers.parts.median import nan_median


def fix_tracker(
    sigma_a: float = 1.0, sigma_z: float = 0.3, sigma_horizontal: float = 0.1, sigma_vertical: float = 0.3,
    dof: float | None = 4.0, planar: bool = False,
) -> Tracker:  # fmt: skip
    """Constant velocity in x and y, from fixes; the height is a random walk, or known and not estimated if `planar`.

    `sigma_a` m/s² per √Hz, `sigma_z` m per √s; the sensor's sigmas m. `dof`: degrees of freedom of Student's t, None
    for normal noise.
    """
    sensor = FixSensor(sigma_horizontal, sigma_vertical, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), planar, 2)
    return Tracker(GroundMotion(sigma_a, sigma_z), {FIXES: sensor}, start, track_loss=PATIENT, latency_of=FIXES)


def singer_tracker(
    sigma_a: float = 1.0, tau: float = 1.0, sigma_horizontal: float = 0.1, sigma_vertical: float = 0.3,
    dof: float | None = 4.0, planar: bool = False,
) -> Tracker:  # fmt: skip
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
