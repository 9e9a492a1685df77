"""The assembled tracker MH-K: sliding median, hidden Markov model of accelerations, Kalman filter."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackers.core.estimates import Estimates
from trackers.core.layout import Layout
from trackers.core.motion import ConstantVelocity
from trackers.core.recording import Batch
from trackers.core.scan import Output, Score
from trackers.core.tracker import AbstractTracker
from trackers.core.tunable import Scale
from trackers.mhk.accelerations import AccelerationSphere
from trackers.mhk.fusion import AccelerationFilter
from trackers.mhk.median import LimitedMedian
from trackers.parts.fixes import FIXES, PATIENT, CorrelatedFixSensor, FixStart, FixTracker

STILL = np.array([[8.409964, 3.509666, -1.23004], [3.509666, 10.34468, -0.7689], [-1.23004, -0.7689, 0.583671]]) * 1e-4
"""Covariance of 2,000 fixes of a tag at rest, m² (Huang et al. 2018, section 4)."""


class MedianMarkovKalman(AbstractTracker):
    """MH-K (Huang et al. 2018, Figure 5): a sliding `median`, whose output `fusion` reads as `fixes`.

    The median of 2n + 1 fixes of a moving tag lags by n fixes. With `stamped` each estimate has the time of the middle
    row of its window; otherwise, as in the paper, that of its last fix.
    """

    median: LimitedMedian
    fusion: FixTracker
    stamped: bool = eqx.field(static=True, default=False)

    def check_layout(self, layout: Layout) -> None:
        layout.check_readings("the median of MH-K", FIXES, 3)
        self.fusion.check_layout(layout)

    def scan(self, batch: Batch) -> Output:
        return self.fusion.scan(self._with_medians(batch))

    def accumulate(self, batch: Batch, score: Score) -> tuple[Any, ...]:
        batch = self._with_medians(batch)
        if self.stamped:
            half = min(self.median.window // 2, len(batch.dt))
            truth = {name: tuple(_delayed(x, half) for x in pair) for name, pair in batch.truth.items()}
            batch = batch._replace(truth=truth)
        return self.fusion.accumulate(batch, score)

    def _with_medians(self, batch: Batch) -> Batch:
        return batch._replace(readings={FIXES: self.median.medians(batch, batch.readings[FIXES])})

    def at_valid_time(self, times: np.ndarray, estimates: Estimates) -> tuple[np.ndarray, Estimates]:
        """Times less the latency of the fixes, those of the windows' middle rows if `stamped`; the estimates then."""
        if self.stamped:
            times = np.asarray(_delayed(times, min(self.median.window // 2, len(times))))
        return self.fusion.at_valid_time(times, estimates)


def _delayed(rows: Any, count: int) -> Any:
    """The array delayed by `count` rows; the first row fills the gap."""
    kind = np if isinstance(rows, np.ndarray) else jnp
    return kind.concatenate([kind.repeat(rows[:1], count, axis=0), rows[: len(rows) - count]])


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
    fusion = FixTracker(
        ConstantVelocity(sigma_a, 3),
        {FIXES: CorrelatedFixSensor(covariance)},
        FixStart(Scale(0.5, "m"), Scale(1.0, "m/s"), False, 3),
        AccelerationFilter(AccelerationSphere(), sigma_displacement, rate),
        PATIENT,
    )
    return MedianMarkovKalman(LimitedMedian(window, speed_limit), fusion, stamped)
