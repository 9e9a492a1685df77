"""Smoothing: every row's state given the rows after it too, all of them or those of the next seconds.

The backward recursion on the filter's own beliefs: a filter that can be smoothed has `rts_gain`, what ties a row's belief
to the next row's, and `rts_step`, the smoothed belief that follows through it from the next row's smoothed one. For the
extended Kalman filter that is Rauch, Tung and Striebel's (1965); for mixtures see their filters.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar
from trackers.core.estimates import Estimates, Status
from trackers.core.motion import AbstractMotion
from trackers.core.recording import Batch
from trackers.core.scan import Output, scan_rows
from trackers.core.tracker import AbstractEpochwiseTracker, Tracker
from trackers.core.tunable import freeze


class FullBeliefFilter(eqx.Module):
    """A filter that tells its whole belief where others tell its mean and covariance."""

    filter: Any

    def init(self, belief: Any, key: Any) -> Any:
        return self.filter.init(belief, key)

    def predict(self, belief: Any, motion: AbstractMotion, inputs: Any, dt: Scalar) -> Any:
        return self.filter.predict(belief, motion, inputs, dt)

    def update(self, belief: Any, motion: AbstractMotion, sensor: Any, reading: Any, inputs: Any) -> Any:
        return self.filter.update(belief, motion, sensor, reading, inputs)

    def moments(self, belief: Any) -> tuple[Any, tuple[Scalar, ...]]:
        """The belief, and no covariance beside it."""
        return belief, ()


class Smoothed(AbstractEpochwiseTracker):
    """A tracker of normal beliefs or mixtures of them, smoothed; likelihoods, NIS and status stay the filter's.

    `lag`: seconds of the rows to come that a row may use, None for all of them (fixed-interval smoothing). A row that
    starts a track anew is not joined to the rows before. Raises TypeError for trackers with other filters.
    """

    tracker: Tracker
    lag: float | None = None

    def __check_init__(self) -> None:
        if not (isinstance(self.tracker, Tracker) and hasattr(self.tracker.filter, "rts_step")):
            raise TypeError("Kalman filters and their mixtures have a smoother; chains, particles and grids have none")

    def at_valid_time(self, times: np.ndarray, estimates: Estimates) -> tuple[np.ndarray, Estimates]:
        """As the tracker that is smoothed dates them: late readings are late here too."""
        return self.tracker.at_valid_time(times, estimates)

    def scan(self, batch: Batch) -> Output:
        tracker = freeze(self.tracker)
        output = scan_rows(dataclasses.replace(tracker, filter=FullBeliefFilter(tracker.filter)), batch)[1]
        assert output is not None
        filtered = output.mean
        now = jax.tree_util.tree_map(lambda x: x[:-1], filtered)
        held = (output.status == Status.OK) | (output.status == Status.RESTARTED)
        joined = held[:-1] & (output.status[1:] == Status.OK)
        steps = (now, joined, *(jax.tree_util.tree_map(lambda x: jnp.asarray(x)[1:], (batch.dt, batch.inputs))))
        last = jax.tree_util.tree_map(lambda x: x[-1:], filtered)

        def tied(belief: Any, joined: Scalar, dt: Scalar, inputs: Any) -> Any:
            return tracker.filter.rts_gain(belief, tracker.motion, joined, dt, inputs)

        rts_step = tracker.filter.rts_step
        if self.lag is None:
            smoothed = interval(tied, rts_step, jax.tree_util.tree_map(lambda x: x[0], last), steps)
        else:
            smoothed = lagged(tied, rts_step, filtered, steps, jnp.asarray(self.lag, batch.dt.dtype))
        beliefs = jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a, b]), smoothed, last)
        mean, cov = jax.vmap(jax.vmap(tracker.filter.moments, in_axes=-1, out_axes=-1))(beliefs)
        return output._replace(mean=mean, cov=cov)


def interval(tied: Any, rts_step: Any, last: Any, steps: tuple[Any, ...]) -> Any:
    """The smoothed beliefs of all rows but the last, batch-last, from the last row backwards."""
    trajectories = jax.vmap(lambda after, *step: rts_step(tied(*step), after), in_axes=-1, out_axes=-1)

    def body(after: Any, step: tuple[Any, ...]) -> tuple[Any, Any]:
        before = trajectories(after, *step)
        return before, before

    return jax.lax.scan(body, last, steps, reverse=True)[1]


def lagged(tied: Any, rts_step: Any, filtered: Any, steps: tuple[Any, ...], lag: Scalar) -> Any:
    """The smoothed beliefs of all rows but the last, batch-last, each from the rows at most `lag` s later.

    All windows go backwards side by side, each from its own last row, until they have reached their own first.
    """
    links = jax.vmap(jax.vmap(tied, in_axes=-1, out_axes=-1))(*steps)

    def trajectory(links: Any, filtered: Any, dt: Any) -> Any:
        rows = jnp.arange(len(dt), dtype=jnp.int32)
        times = jnp.concatenate([jnp.zeros_like(dt[:1]), jnp.cumsum(dt)])
        # The last row of each window; 2 eps of the longest time let 0.1 s + 0.2 s be 0.3 s.
        slack = 2 * jnp.finfo(dt.dtype).eps * times[-1]
        end = jnp.searchsorted(times, times[:-1] + lag + slack, side="right").astype(jnp.int32) - 1
        window = jax.tree_util.tree_map(lambda x: x[end], filtered)

        def body(state: tuple[Any, Any]) -> tuple[Any, Any]:
            place, belief = state
            here = jnp.maximum(place - 1, 0)
            nearer = jax.vmap(rts_step)(jax.tree_util.tree_map(lambda x: x[here], links), belief)
            moving = place > rows
            belief = jax.tree_util.tree_map(lambda a, b: jnp.where(_like(moving, a), a, b), nearer, belief)
            return jnp.where(moving, place - 1, place), belief

        return jax.lax.while_loop(lambda state: jnp.any(state[0] > rows), body, (end, window))[1]

    return jax.vmap(trajectory, in_axes=-1, out_axes=-1)(links, filtered, steps[2])


def _like(condition: Any, array: Any) -> Any:
    """The condition with as many axes as the array."""
    return condition.reshape(condition.shape + (1,) * (array.ndim - 1))
