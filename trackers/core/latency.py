"""Latency: estimates at the time of measurement, which is earlier than that of the row by the sensor's latency.

A measurement with latency is of an earlier state, z(t) = h(x(t − latency)). The filter's state is that of the row's
time t; shifted back for straight motion, p(t − latency) = p(t) − v(t)·latency, its error is smallest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector, congruence
from trackers.core.linearise import linearise
from trackers.core.motion import Noise
from trackers.core.recording import Batch
from trackers.core.sensor import AbstractSensor
from trackers.core.state import State, coordinates, local_after


class AbstractDelayedSensor(AbstractSensor):
    """A sensor whose readings are of the state `latency` s before their row."""

    latency: eqx.AbstractVar[Noise]


def shifted_back(mean: State, upper: Sequence[Scalar], seconds: Scalar) -> tuple[State, tuple[Scalar, ...]]:
    """Mean and covariance of the state with its position `seconds` earlier, for straight motion, one trajectory.

    Axes without a velocity are unchanged.
    """

    def earlier(state: Any) -> Any:
        moving = list(zip(state.position, state.velocity, strict=False))
        position = [p - v * seconds for p, v in moving]
        return state._replace(position=Vector.of([*position, *list(state.position)[len(moving) :]]))

    point, rebuild = coordinates(mean)
    shifted = earlier(mean)

    def step(*values: Scalar) -> list[Scalar]:
        before = rebuild(values)
        return local_after(shifted, before, values, earlier(before))

    _, rows = linearise(step, point)
    return shifted, congruence(rows, upper, [{} for _ in rows])


def truth_at(batch: Batch, age: Any) -> dict[str, tuple[Any, Any]]:
    """The truth `age` s, (T, B) or (B,), before each row of a batch, differentiable in `age`.

    Linear between the rows of an uninterrupted stretch of known truth, and continued linearly beyond its ends: the rows
    that are scored are those with truth, whatever the age, so that an objective has no jump where `age` is zero.
    """
    times = jnp.cumsum(jnp.where(batch.valid, batch.dt, jnp.ones_like(batch.dt)), axis=0)
    ages = jnp.broadcast_to(age, times.shape)
    rows = jnp.arange(len(times), dtype=jnp.int32)

    def trajectory(times: Any, age: Any, values: Any, known: Any) -> Any:
        begins = known & ~jnp.concatenate([jnp.zeros_like(known[:1]), known[:-1]])
        ends = known & ~jnp.concatenate([known[1:], jnp.zeros_like(known[:1])])
        first = jax.lax.cummax(jnp.where(begins, rows, 0))
        last = jax.lax.cummin(jnp.where(ends, rows, len(times) - 1), reverse=True)
        earlier = times - age
        left = jnp.searchsorted(times, earlier, side="right").astype(jnp.int32) - 1
        left = jnp.maximum(jnp.minimum(jnp.maximum(left, first), last - 1), first)
        right = jnp.minimum(left + 1, last)
        span = times[right] - times[left]
        fraction = jnp.where(span > 0, (earlier - times[left]) / jnp.where(span > 0, span, 1.0), 0.0)
        return values[left] + fraction[:, None] * (values[right] - values[left])

    every = jax.vmap(trajectory, in_axes=-1, out_axes=-1)
    return {
        name: (every(times, ages, jnp.asarray(values), jnp.asarray(known)), known)
        for name, (values, known) in batch.truth.items()
    }
