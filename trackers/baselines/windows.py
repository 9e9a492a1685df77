"""Moving windows over the last fixes: their mean, and their median axis by axis. Neither knows how uncertain it is."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from trackers.core.algebra import Vector, triangle
from trackers.core.estimates import Status
from trackers.core.motion import Placed
from trackers.core.recording import Batch
from trackers.core.scan import Output
from trackers.core.tracker import AbstractEpochwiseTracker
from trackers.parts.fixes import FIXES
from trackers.parts.median import nan_median


class MovingWindow(AbstractEpochwiseTracker):
    """The mean or `median` of each axis over the last `window` rows in which it was seen, from the first such row on.

    It lags behind a moving tag by half its window. No covariance (NaN). `planar`: x and y alone.
    """

    window: int = eqx.field(static=True)
    median: bool = eqx.field(static=True)
    planar: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        if self.window < 1:
            raise ValueError(f"a window holds at least one row, found {self.window}")

    def scan(self, batch: Batch) -> Output:
        reading = batch.readings[FIXES]
        axes = 2 if self.planar else 3
        values, seen = jnp.asarray(reading.values)[:, :axes], jnp.asarray(reading.seen)[:, :axes]
        seen = seen & jnp.asarray(batch.valid)[:, None]
        empty = jnp.full((self.window, *values.shape[1:]), jnp.nan, values.dtype)

        def push(last: Any, row: Any) -> tuple[Any, Any]:
            value, saw = row
            last = jnp.where(saw, jnp.concatenate([last[1:], value[None]]), last)
            return last, nan_median(last) if self.median else jnp.nanmean(last, axis=0)

        place = jax.lax.scan(push, empty, (values, seen))[1]
        known = jnp.isfinite(place).all(axis=1)
        zero = jnp.zeros_like(place[:, 0])
        mean = Placed(Vector(*(jnp.where(known, place[:, k], 0.0) for k in range(axes))))
        cov = tuple(zero + jnp.nan for _ in triangle(axes))
        status = jnp.where(jnp.asarray(batch.valid), jnp.where(known, Status.OK, Status.WAITING), Status.PADDING)
        return Output(mean, cov, zero, zero, zero, zero, status.astype(jnp.int8))
