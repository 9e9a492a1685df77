"""Smoothing: every row's state given the rows after it too, all of them or those of the next seconds.

The backward recursion of Rauch, Tung and Striebel (1965) on the filter's own estimates. With x, P the filtered state
and covariance of a row, F, G the motion's Jacobians to the next row, x⁻ = step(x), P⁻ = FPFᵀ + GGᵀ the prediction:

    C = PFᵀ(P⁻)⁻¹        xˢ = x + C(xˢ₊ − x⁻)        Pˢ = (I − CF)P(I − CF)ᵀ + CGGᵀCᵀ + CPˢ₊Cᵀ

The covariance is a sum of squares (Joseph's form, which holds whatever the rounding of C), not P + C(Pˢ₊ − P⁻)Cᵀ.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import (
    Scalar,
    SparseRow,
    cholesky,
    congruence,
    full,
    inverse_or_zero,
    shared,
    total,
    triangle,
)
from trackers.core.ekf import ExtendedKalman, Gaussian
from trackers.core.estimates import Estimates, Status
from trackers.core.motion import AbstractMotion
from trackers.core.recording import Batch
from trackers.core.selection import select
from trackers.core.state import State, local, retract
from trackers.core.tracker import AbstractTracker, Output, Score, Tracker, scan_rows
from trackers.core.tunable import resolved


class Link(NamedTuple):
    """How a row's smoothed belief follows from the next row's: C row by row, x⁻, and Pˢ without its last term."""

    filtered: Gaussian
    predicted: State
    gain: tuple[tuple[Scalar, ...], ...]
    base: tuple[Scalar, ...]
    joined: Scalar
    same: Scalar


class Smoothed(AbstractTracker):
    """A tracker with an extended Kalman filter, smoothed; likelihoods, NIS and status stay those of the filter.

    `lag`: seconds of the rows to come that a row may use, None for all of them (fixed-interval smoothing). A row that
    starts a track anew is not joined to the rows before. Raises TypeError for trackers with other filters.
    """

    tracker: Tracker
    lag: float | None = None

    def __check_init__(self) -> None:
        if not (isinstance(self.tracker, Tracker) and isinstance(self.tracker.filter, ExtendedKalman)):
            raise TypeError("only a tracker with an extended Kalman filter can be smoothed")

    def dated(self, times: np.ndarray, estimates: Estimates) -> tuple[np.ndarray, Estimates]:
        """As the tracker that is smoothed dates them: late readings are late here too."""
        return self.tracker.dated(times, estimates)

    def scan(self, batch: Batch) -> Output:
        tracker = resolved(self.tracker)
        output = scan_rows(tracker, batch)[1]
        assert output is not None
        filtered = Gaussian(output.mean, output.cov)
        now = jax.tree_util.tree_map(lambda x: x[:-1], filtered)
        held = (output.status == Status.OK) | (output.status == Status.RESTARTED)
        joined = held[:-1] & (output.status[1:] == Status.OK)
        steps = (now, joined, *(jax.tree_util.tree_map(lambda x: jnp.asarray(x)[1:], (batch.dt, batch.inputs))))
        last = jax.tree_util.tree_map(lambda x: x[-1:], filtered)

        def joint(belief: Gaussian, joined: Scalar, dt: Scalar, inputs: Any) -> Link:
            return link(tracker.filter, tracker.motion, belief, joined, dt, inputs)

        if self.lag is None:
            smoothed = interval(joint, jax.tree_util.tree_map(lambda x: x[0], last), steps)
        else:
            smoothed = lagged(joint, filtered, steps, jnp.asarray(self.lag, batch.dt.dtype))
        mean, cov = jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a, b]), smoothed, last)
        return output._replace(mean=mean, cov=cov)

    def accumulate(self, batch: Batch, score: Score) -> tuple[Any, ...]:
        truth = jax.tree_util.tree_map(jnp.asarray, batch.truth)
        return tuple(jnp.sum(x, axis=0) for x in jax.vmap(score)(self.scan(batch), truth))


def link(
    kalman: ExtendedKalman, motion: AbstractMotion, belief: Gaussian, joined: Scalar, dt: Scalar, inputs: Any
) -> Link:
    """The link of one row of one trajectory to the next row, which comes `dt` seconds later."""
    moved, F, G = kalman.jacobians(belief.mean, motion, inputs, dt)
    n = len(F)
    predicted = shared(congruence(F, belief.cov, G))
    P = full(belief.cov, n)
    cross = [[total(P[i][k] * f for k, f in F[j].items()) for j in range(n)] for i in range(n)]
    C = [shared(solved) for solved in divided(predicted, cross, n)]
    rest = [
        {k: (1.0 if i == k else 0.0) - total(C[i][j] * F[j][k] for j in range(n) if k in F[j]) for k in range(n)}
        for i in range(n)
    ]
    pushed = [_row(C[i], G) for i in range(n)]
    return Link(belief, moved, tuple(map(tuple, C)), congruence(rest, belief.cov, pushed), joined, dt == 0)


def _row(gain: Sequence[Scalar], G: Sequence[SparseRow]) -> SparseRow:
    """One row of CG."""
    return {
        q: total(c * row[q] for c, row in zip(gain, G, strict=True) if q in row)
        for q in sorted({q for g in G for q in g})
    }


def divided(upper: Sequence[Scalar], rows: Sequence[Sequence[Scalar]], n: int) -> list[list[Scalar]]:
    """Rows times the inverse of a covariance, by its Cholesky factor; directions without spread drop out."""
    columns = list(range(n))
    tolerance = 16 * float(jnp.finfo(jnp.asarray(upper[0]).dtype).eps)
    L = shared(cholesky(dict(zip(triangle(n), upper, strict=True)), columns, tolerance))
    pivot = [inverse_or_zero(L[j, j]) for j in columns]
    result = []
    for row in rows:
        y: list[Scalar] = []
        for j in columns:
            y.append((row[j] - total(L[j, k] * y[k] for k in range(j))) * pivot[j])
        x: dict[int, Scalar] = {}
        for j in reversed(columns):
            x[j] = (y[j] - total(L[i, j] * x[i] for i in range(j + 1, n))) * pivot[j]
        result.append([x[j] for j in columns])
    return result


def linked(link: Link, after: Gaussian) -> Gaussian:
    """The smoothed belief of a row, from that of the next one."""
    difference = local(link.predicted, after.mean)
    step = [total(c * d for c, d in zip(row, difference, strict=True)) for row in link.gain]
    gain = [dict(enumerate(row)) for row in link.gain]
    spread = congruence(gain, after.cov, [{} for _ in gain])
    cov = tuple(a + b for a, b in zip(link.base, spread, strict=True))
    smoothed = Gaussian(retract(link.filtered.mean, step), cov)
    # Two rows at one time have one state; there the filtered covariance may be singular and has no inverse.
    return select(link.joined, select(link.same, after, smoothed), link.filtered)


def interval(joint: Any, last: Gaussian, steps: tuple[Any, ...]) -> Gaussian:
    """The smoothed beliefs of all rows but the last, batch-last, from the last row backwards."""
    lanes = jax.vmap(lambda after, *step: linked(joint(*step), after), in_axes=-1, out_axes=-1)

    def body(after: Gaussian, step: tuple[Any, ...]) -> tuple[Gaussian, Gaussian]:
        before = lanes(after, *step)
        return before, before

    return jax.lax.scan(body, last, steps, reverse=True)[1]


def lagged(joint: Any, filtered: Gaussian, steps: tuple[Any, ...], lag: Scalar) -> Gaussian:
    """The smoothed beliefs of all rows but the last, batch-last, each from the rows at most `lag` s later.

    All windows go backwards side by side, each from its own last row, until they have reached their own first.
    """
    links = jax.vmap(jax.vmap(joint, in_axes=-1, out_axes=-1))(*steps)

    def lane(links: Link, filtered: Gaussian, dt: Any) -> Gaussian:
        rows = jnp.arange(len(dt), dtype=jnp.int32)
        times = jnp.concatenate([jnp.zeros_like(dt[:1]), jnp.cumsum(dt)])
        # The last row of each window; 2 eps of the longest time let 0.1 s + 0.2 s be 0.3 s.
        slack = 2 * jnp.finfo(dt.dtype).eps * times[-1]
        end = jnp.searchsorted(times, times[:-1] + lag + slack, side="right").astype(jnp.int32) - 1
        window = jax.tree_util.tree_map(lambda x: x[end], filtered)

        def body(state: tuple[Any, Gaussian]) -> tuple[Any, Gaussian]:
            place, belief = state
            here = jnp.maximum(place - 1, 0)
            nearer = jax.vmap(linked)(jax.tree_util.tree_map(lambda x: x[here], links), belief)
            moving = place > rows
            belief = jax.tree_util.tree_map(lambda a, b: jnp.where(_like(moving, a), a, b), nearer, belief)
            return jnp.where(moving, place - 1, place), belief

        return jax.lax.while_loop(lambda state: jnp.any(state[0] > rows), body, (end, window))[1]

    return jax.vmap(lane, in_axes=-1, out_axes=-1)(links, filtered, steps[2])


def _like(condition: Any, array: Any) -> Any:
    """The condition with as many axes as the array."""
    return condition.reshape(condition.shape + (1,) * (array.ndim - 1))
