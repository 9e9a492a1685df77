"""The assembled tracker MH-K: sliding median, hidden Markov model of accelerations, Kalman filter."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.motion import ConstantVelocity
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.model.tunable import Scale, freeze
from trackwright.trackers.core.run.latency import scored_truth
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output, ScanState, Score, scan_rows
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.mhk.accelerations import AccelerationSphere
from trackwright.trackers.mhk.fusion import AccelerationFilter
from trackwright.trackers.mhk.median import LimitedMedian, MedianState
from trackwright.trackers.parts.fixes import FIXES, PATIENT, CorrelatedFixSensor, FixStart

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
