"""When a tracker gives up a track."""

from __future__ import annotations

import equinox as eqx
import numpy as np

from trackers.core.motion import Noise
from trackers.core.tunable import Constant, Scale


class TrackLossPolicy(eqx.Module):
    """When a track counts as lost and is started again.

    `nis_limit`: the largest tolerable running mean of NIS per degree of freedom, over about `nis_window` rows with readings.
    `max_gap`: seconds without any reading after which the old track is not trusted. They decide yes or no: nothing has
    a derivative by them, and a sweep is the way to tune them. What is infinite never decides, and is no tunable.
    """

    nis_limit: Noise
    nis_window: Noise
    max_gap: Noise

    def __init__(self, nis_limit: float = 6.0, nis_window: float = 8.0, max_gap: float = 5.0):
        self.nis_limit, self.nis_window, self.max_gap = (
            _bound(nis_limit, "1"),
            _bound(nis_window, "1"),
            _bound(max_gap, "s"),
        )


def _bound(value: float, unit: str) -> Noise:
    return Scale(value, unit) if np.isfinite(value) else Constant(value)
