"""Latency: estimates at the time of measurement, which precedes the row by the sensor's latency.

A sensor with latency measures an earlier state, z(t) = h(x(t − latency)). The filter estimates the state at the row's
time t; shifted back along a straight line, p(t − latency) = p(t) − v(t)·latency, the estimate has the least error.

A latency that is not known is a considered parameter (Schmidt 1966; Jazwinski 1970, section 8.4): it is not estimated,
which readings of one sensor do not allow, but its standard deviation s is in the covariance. Along a straight line an
error δ of the latency moves the estimate by −v·δ, whatever the gains, so that the covariance has s²·E[v vᵀ] more.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from trackwright.trackers.core.data import HOLE_M, HOLE_S
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.algebra import Scalar, Vector, congruence, full, triangle
from trackwright.trackers.core.model.covariance import AnyCovariance, as_scalars
from trackwright.trackers.core.model.inputs import Elapsed
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.state import State, component_names, coordinates, local_after

LONGEST_S = 1e4  # longest gap, s, in elapsed times; across longer ones truth is scored only where it hardly changes


def shifted_back(
    mean: State, upper: AnyCovariance, seconds: Scalar, std: Scalar = 0.0
) -> tuple[State, tuple[Scalar, ...]]:
    """Mean and covariance of the state with its position `seconds` earlier, for straight motion, one trajectory.

    `std`: standard deviation of the `seconds`; it adds std²(v vᵀ + cov v) to the covariance of the position. Axes
    without a velocity are unchanged.
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
    cov, names = congruence(rows, as_scalars(upper), [{} for _ in rows]), component_names(mean)
    axes = {names.index(f"position.{k}"): (v, names.index(f"velocity.{k}")) for k, v in enumerate(mean.velocity)}
    P = full(as_scalars(upper), len(names))

    def with_unknown(entry: Scalar, i: int, j: int) -> Scalar:
        if i not in axes or j not in axes:
            return entry
        (v, a), (w, b) = axes[i], axes[j]
        return entry + std**2 * (v * w + P[a][b])

    return shifted, tuple(with_unknown(x, i, j) for x, (i, j) in zip(cov, triangle(len(names)), strict=True))


def scored_truth(batch: Batch, age: Any = None) -> dict[str, tuple[Any, Any]]:
    """The truth that estimates are scored against: `age` s before each row, on the last row of each time.

    `age` (T, B) or (B,); None for the times of the rows. The truth is differentiable with respect to it: cubic between
    the rows of an uninterrupted stretch of known truth, so that an objective has a derivative at age zero, where all
    rows are knots, and straight across a gap and beyond the ends of a stretch. Positions inside a hole are not scored;
    otherwise the choice of scored rows does not depend on the age.
    """
    dt = jnp.where(batch.valid, batch.dt, jnp.ones_like(batch.dt))
    no = jnp.zeros_like(dt[:1], bool)
    followed = jnp.concatenate([jnp.asarray(batch.valid)[1:] & (jnp.asarray(batch.dt)[1:] == 0), no])
    scored_truths = {}
    for name, (values, known) in batch.truth.items():
        values, scored = jnp.asarray(values), jnp.asarray(known) & ~followed
        if age is not None:
            earlier = partial(_earlier_truth, moved=HOLE_M if name == "position" else jnp.inf)
            each = jax.vmap(earlier, in_axes=-1, out_axes=-1)
            values, hole = each(dt, jnp.broadcast_to(age, dt.shape), values, jnp.asarray(known))
            scored &= ~hole
        scored_truths[name] = values, scored
    return scored_truths


def _earlier_truth(dt: Any, age: Any, values: Any, known: Any, moved: float) -> tuple[Any, Any]:
    """The truth (T, d) of one trajectory `age` (T,) s before its rows, and a mask (T,) of times inside a hole.

    A hole is a gap longer than `HOLE_S` over which the truth changes by more than `moved`.
    """
    times = Elapsed.of(dt, LONGEST_S)
    at = times.last_within(jax.lax.stop_gradient(-age))
    return _splines(dt, times, age, at, values, known), _in_hole(times, age, at, values, known, moved)


def _splines(dt: Any, times: Elapsed, age: Any, at: Any, values: Any, known: Any) -> Any:
    """The truth `age` before the rows by cubic Hermite splines; `at` (T,): the last row not after that time."""
    rows, end = jnp.arange(len(dt), dtype=jnp.int32), len(dt) - 1
    no = jnp.zeros_like(known[:1])
    joined = known[1:] & known[:-1]
    first = jax.lax.cummax(jnp.where(known & ~jnp.concatenate([no, joined]), rows, 0))
    last = jax.lax.cummin(jnp.where(known & ~jnp.concatenate([joined, no]), rows, end), reverse=True)
    tangents = _tangents(dt[1:], values, joined & (dt[1:] <= HOLE_S))
    left = jnp.maximum(jnp.minimum(jnp.maximum(at, first), last - 1), first)
    right = jnp.minimum(left + 1, last)
    since, span = (times.since(left) - age)[:, None], (times.since(left) - times.since(right))[:, None]
    u = jnp.where(span > 0, since / jnp.where(span > 0, span, 1.0), 0.0)
    step, begin, finish = values[right] - values[left], tangents[left], tangents[right]
    curve = u * (1.0 - u) * ((1.0 - u) * (begin * span - step) - u * (finish * span - step))
    # Along the tangent: a clipped u would halve the derivative at the knot.
    after = step + (since - span) * finish
    inner = jnp.where(u > 1, after, u * step + jnp.where(span > HOLE_S, 0.0, curve))
    return values[left] + jnp.where(since < 0, since * begin, inner)


def _in_hole(times: Elapsed, age: Any, at: Any, values: Any, known: Any, moved: float) -> Any:
    """Mask (T,) of rows valid at a time between the two known rows of a hole; arguments as of `_splines`."""
    rows, end = jnp.arange(len(known), dtype=jnp.int32), len(known) - 1
    before = jax.lax.cummax(jnp.where(known, rows, -1))[at]
    after = jax.lax.cummin(jnp.where(known, rows, end), reverse=True)[jnp.minimum(at + 1, end)]
    between = (at >= 0) & (before >= 0) & known[after] & (times.since(before) > age)
    change = jnp.sum((values[after] - values[before]) ** 2, axis=-1)
    return between & (times.since(before) - times.since(after) > HOLE_S) & (change > moved**2)


def _tangents(spans: Any, values: Any, joined: Any) -> Any:
    """The tangents (T, d) of parabolas through three neighbouring rows, or of chords; `joined` (T - 1,): both known."""
    spans = jnp.where(joined, spans, 0.0)
    chords = jnp.where(spans > 0, 1.0 / jnp.where(spans > 0, spans, 1.0), 0.0)[:, None] * (values[1:] - values[:-1])
    none, flat = jnp.zeros(1, spans.dtype), jnp.zeros_like(values[:1])
    # Each chord is weighted by the span of the other one; a single chord has the whole weight.
    before, after = jnp.concatenate([none, spans]), jnp.concatenate([spans, none])
    total_span = jnp.where(before + after > 0, before + after, 1.0)
    weight = jnp.where(before > 0, jnp.where(after > 0, after / total_span, 1.0), 0.0)[:, None]
    return weight * jnp.concatenate([flat, chords]) + (1.0 - weight) * jnp.concatenate([chords, flat])
