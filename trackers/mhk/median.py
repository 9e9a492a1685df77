"""The causal 3-D median of fixes with a speed limit: equations (1) and (2) of Huang et al. 2018."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from trackers.core.algebra import inverse_or_zero
from trackers.core.motion import Noise
from trackers.core.recording import Batch
from trackers.core.sensor import Reading
from trackers.core.tunable import Scale
from trackers.parts.median import middle


class Limiter(NamedTuple):
    """The last values of each axis (window, 3), the last place let through (3,), and the seconds since it."""

    last: Any
    place: Any
    elapsed: Any


class LimitedMedian(eqx.Module):
    """The median of the last `window` fixes, axis by axis, moving no faster than `speed_limit`, m/s.

    There is no median before `window` fixes of every axis, as the paper has it; the first is let through as it is.
    """

    window: int = eqx.field(static=True)
    speed_limit: Noise

    def __init__(self, window: int = 9, speed_limit: float = 4.0):
        if window < 1:
            raise ValueError(f"a window holds at least one fix, found {window}")
        self.window, self.speed_limit = window, Scale(speed_limit, "m/s")

    def readings(self, batch: Batch, reading: Reading) -> Reading:
        """The medians of all rows of a chunk, batch-last; seen on rows with a fix, once the window is full."""
        values, seen = jnp.asarray(reading.values), jnp.asarray(reading.seen)
        seen = seen & jnp.asarray(batch.valid)[:, None]
        blank = jnp.full((self.window, *values.shape[1:]), jnp.nan, values.dtype)
        first = Limiter(blank, blank[0], jnp.zeros_like(values[0, 0]))

        def one(state: Limiter, value: Any, saw: Any, dt: Any) -> tuple[Limiter, tuple[Any, Any]]:
            last = jnp.where(saw[None], jnp.concatenate([state.last[1:], value[None]]), state.last)
            elapsed = state.elapsed + dt
            full = jnp.isfinite(last[0]).all() & saw.any()
            place = limited(state.place, middle(last), self.speed_limit.value * elapsed)
            kept = Limiter(last, jnp.where(full, place, state.place), jnp.where(full, 0.0, elapsed))
            return kept, (jnp.where(full, place, 0.0), jnp.broadcast_to(full, place.shape))

        trajectories = jax.vmap(one, in_axes=-1, out_axes=-1)
        rows = values, seen, jnp.asarray(batch.dt)
        places, known = jax.lax.scan(lambda state, row: trajectories(state, *row), first, rows)[1]
        # What a device reports of one fix is not the noise of a median.
        return Reading(places, known, jnp.zeros((len(values), 0, values.shape[-1]), values.dtype))


def limited(before: Any, now: Any, furthest: Any) -> Any:
    """The place `now` (3,), m, or the one on the way to it that is `furthest` m from `before`; NaN: no place yet.

    Equation (2), whose two cases are printed the wrong way round: the clip is for what moves too fast.
    """
    start = jnp.where(jnp.isfinite(before), before, now)
    way = now - start
    square = jnp.sum(way * way)
    far = square > furthest * furthest
    share = jnp.where(far, furthest * inverse_or_zero(jnp.sqrt(jnp.where(far, square, 1.0))), 1.0)
    return start + way * share
