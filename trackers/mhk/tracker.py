"""The assembled tracker MH-K: sliding median, hidden Markov model of accelerations, Kalman filter.

The median is causal, axis by axis, with a speed limit (Huang et al. 2018, equations 1 and 2).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.algebra import inverse_or_zero
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.core.model.motion import ConstantVelocity, Noise
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading
from trackwright.trackers.core.model.tunable import Scale, freeze
from trackwright.trackers.core.run.latency import scored_truth
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output, ScanState, Score, scan_rows
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.mhk.accelerations import AccelerationSphere
from trackwright.trackers.mhk.fusion import AccelerationFilter
from trackwright.trackers.parts.fixes import FIXES, PATIENT, CorrelatedFixSensor, FixStart
from trackwright.trackers.parts.median import nan_median

STILL = np.array([[8.409964, 3.509666, -1.23004], [3.509666, 10.34468, -0.7689], [-1.23004, -0.7689, 0.583671]]) * 1e-4
"""Covariance of 2,000 fixes of a tag at rest, m² (Huang et al. 2018, section 4)."""


class MhkState(NamedTuple):
    """The states of the median, None before its first row, and of the fusion."""

    median: MedianState | None
    fusion: ScanState | None


class MedianMarkovKalman(AbstractTracker):
    """MH-K (Huang et al. 2018, Figure 5): a sliding `median`, whose output `fusion` reads as `fixes`.

    The median of 2n + 1 fixes of a moving tag lags by n fixes. With `stamped` each estimate is valid at the time of the
    middle fix of its window; otherwise, as in the paper, at the time of its last fix.
    """

    median: LimitedMedian
    fusion: Tracker
    stamped: bool = eqx.field(static=True, default=False)

    def check_layout(self, layout: Layout) -> None:
        layout.check_readings("the median of MH-K", FIXES, 3)
        self.fusion.check_layout(layout)

    @property
    def nis_sensors(self) -> tuple[AbstractSensor, ...]:
        return self.fusion.nis_sensors

    def scan(self, batch: Batch, initial: MhkState | None = None) -> tuple[Output, MhkState]:
        before = MhkState(None, None) if initial is None else initial
        medians, ages, median = self.median.medians(batch, before.median)
        output, fusion = self.fusion.scan(batch._replace(readings={FIXES: medians}), before.fusion)
        return output._replace(age=self._age(ages)), MhkState(median, fusion)

    def accumulate(self, batch: Batch, score: Score, every_row: bool = False) -> tuple[Any, ...]:
        medians, ages, _ = self.median.medians(batch)
        batch = batch._replace(readings={FIXES: medians}, truth=scored_truth(batch, self._age(ages)))
        return scan_rows(freeze(self.fusion), batch, score=score, every_row=every_row)[0]

    def _age(self, ages: Any) -> Any:
        """The time from that for which an estimate is valid to its row, s; `ages` (T, B): of the middle fixes."""
        latency = self.fusion.latency
        if not self.stamped:
            return None if latency is None else jnp.broadcast_to(latency, ages.shape)
        return ages if latency is None else ages + latency

    def begin(self, prior: Gaussian, batch: Batch) -> MhkState:
        """The fusion begins with `prior`; the median waits until its window is full."""
        return MhkState(None, self.fusion.begin(prior, batch))


def mhk_tracker(
    covariance: np.ndarray = STILL,
    sigma_a: float = 1.0,
    sigma_displacement: float = 0.05,
    rate: float | None = None,
    window: int = 9,
    speed_limit: float = 4.0,
    stamped: bool = False,
) -> MedianMarkovKalman:
    """MH-K with the paper's R and window; the paper does not print P₀, P_max, a_lm, V_limit and Q.

    `covariance`: R, m². `sigma_a`: of Q, m/s² per √Hz. `sigma_displacement` m and `rate` 1/s: of the chain; `rate` None
    for a chain without memory, as printed. `speed_limit`: m/s, by default twice the greatest speed of the paper.
    """
    fusion = Tracker(
        ConstantVelocity(sigma_a, 3),
        {FIXES: CorrelatedFixSensor(covariance)},
        FixStart(Scale(0.5, "m"), Scale(1.0, "m/s"), False, 3),
        AccelerationFilter(AccelerationSphere(), sigma_displacement, rate),
        PATIENT,
        FIXES,
    )
    return MedianMarkovKalman(LimitedMedian(window, speed_limit), fusion, stamped)


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
