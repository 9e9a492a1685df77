"""Causal sliding median of fixes, axis by axis, with a speed limit (Huang et al. 2018, equations 1 and 2)."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.algebra import inverse_or_zero
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.core.model.motion import Noise
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.parts.fixes import FIXES
from trackwright.trackers.parts.median import nan_median


class MedianState(NamedTuple):
    """The last values of each axis (window, 3), m, the last output (3,), m, and the time since it, s.

    `ages` (window,): times since the fixes of the window, s. `age`: of its middle fix at the last output.
    """

    window: AnyArray
    position: AnyArray
    elapsed: AnyArray
    ages: AnyArray
    age: AnyArray


class LimitedMedian(eqx.Module):
    """The median of the last `window` fixes, axis by axis, its speed limited to `speed_limit`, m/s.

    As in the paper there is no output before `window` fixes of every axis. The first output is not limited. Raises
    ValueError for a window below 1.
    """

    window: int = eqx.field(static=True)
    speed_limit: Noise

    def __init__(self, window: int = 9, speed_limit: float = 4.0):
        if window < 1:
            raise ValueError(f"a window holds at least one fix, found {window}")
        self.window, self.speed_limit = window, Scale(speed_limit, "m/s")

    def medians(self, batch: Batch, initial: MedianState | None = None) -> tuple[Reading, Any, MedianState]:
        """The medians of all rows of a chunk, batch-last, seen on rows with a fix once the window is full.

        Also the ages (T, B), s: the time from the middle fix of the window to its last; and the final state,
        trajectories first in every array, the `initial` of later rows.
        """
        reading = batch.readings[FIXES]
        values, seen = jnp.asarray(reading.values), jnp.asarray(reading.seen)
        seen = seen & jnp.asarray(batch.valid)[:, None]
        empty = jnp.full((self.window, *values.shape[1:]), jnp.nan, values.dtype)
        if initial is None:
            zero = jnp.zeros_like(values[0, 0])
            before = MedianState(empty, empty[0], zero, jnp.zeros_like(empty[:, 0]), zero)
        else:
            before = jax.tree_util.tree_map(lambda x: jnp.moveaxis(jnp.asarray(x), 0, -1), initial)

        def step(state: MedianState, value: Any, value_seen: Any, dt: Any) -> tuple[MedianState, tuple[Any, ...]]:
            window = jnp.where(value_seen[None], jnp.concatenate([state.window[1:], value[None]]), state.window)
            elapsed = state.elapsed + dt
            full = jnp.isfinite(window[0]).all() & value_seen.any()
            ages = state.ages + dt
            ages = jnp.where(value_seen.any(), jnp.append(ages[1:], 0.0 * dt), ages)
            # Between two outputs the filter predicts, from a position of this age.
            age = jnp.where(full, ages[self.window - 1 - self.window // 2], state.age)
            position = speed_limited(state.position, nan_median(window), self.speed_limit.value * elapsed)
            position, elapsed = jnp.where(full, position, state.position), jnp.where(full, 0.0, elapsed)
            after = MedianState(window, position, elapsed, ages, age)
            return after, (jnp.where(full, position, 0.0), jnp.broadcast_to(full, position.shape), age)

        trajectories = jax.vmap(step, in_axes=-1, out_axes=-1)
        rows = values, seen, jnp.asarray(batch.dt)
        scanned = jax.lax.scan(lambda state, row: trajectories(state, *row), before, rows)
        after, (positions, median_seen, ages) = scanned
        # No reported variances: a median has another variance than a fix.
        medians = Reading(positions, median_seen, jnp.zeros((len(values), 0, values.shape[-1]), values.dtype))
        return medians, ages, jax.tree_util.tree_map(lambda x: jnp.moveaxis(x, -1, 0), after)


def speed_limited(last: AnyArray, median: AnyArray, limit: AnyArray) -> Any:
    """The position `median` (3,), m, or the one towards it at a distance of `limit` m from `last` (3,), if nearer.

    `last` is NaN before the first output. Equation (2), whose two cases are printed in the wrong order: the limit
    applies to displacements that are too large.
    """
    start = jnp.where(jnp.isfinite(last), last, median)
    displacement = median - start
    square = jnp.sum(displacement * displacement)
    too_fast = square > limit * limit
    fraction = jnp.where(too_fast, limit * inverse_or_zero(jnp.sqrt(jnp.where(too_fast, square, 1.0))), 1.0)
    return start + displacement * fraction
