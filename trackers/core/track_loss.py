"""Track loss: when a tracker gives up a track and starts a new one."""

from __future__ import annotations

import equinox as eqx
import numpy as np

from trackers.core.motion import Noise
from trackers.core.tunable import Constant, Scale


class TrackLossPolicy(eqx.Module):
    """The thresholds above which a track is lost and started again.

    `nis_limit`: of the running mean of NIS per degree of freedom, over about `nis_window` rows with measurements.
    `max_gap`: of the time without measurements, s. Thresholds are not differentiable; tune them by sweep. np.inf
    disables one, which is then no tunable.
    """

    nis_limit: Noise
    nis_window: Noise
    max_gap: Noise

    def __init__(self, nis_limit: float = 6.0, nis_window: float = 8.0, max_gap: float = 5.0):
        self.nis_limit, self.nis_window = _threshold(nis_limit, "1"), _threshold(nis_window, "1")
        self.max_gap = _threshold(max_gap, "s")


def _threshold(value: float, unit: str) -> Noise:
    return Scale(value, unit) if np.isfinite(value) else Constant(value)
