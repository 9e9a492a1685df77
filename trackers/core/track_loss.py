"""When a tracker gives up a track."""

from __future__ import annotations

import equinox as eqx
import numpy as np

from trackers.core.motion import Noise
from trackers.core.tunable import Fixed, Scale


class LossPolicy(eqx.Module):
    """When a track counts as lost and is started again.

    `limit`: the largest tolerable running mean of NIS per degree of freedom, over about `memory` rows with readings.
    `patience`: seconds without any reading after which the old track is not trusted. They decide yes or no: nothing has
    a derivative by them, and a sweep is the way to tune them. What is infinite never decides, and is no tunable.
    """

    limit: Noise
    memory: Noise
    patience: Noise

    def __init__(self, limit: float = 6.0, memory: float = 8.0, patience: float = 5.0):
        self.limit, self.memory, self.patience = _bound(limit, "1"), _bound(memory, "1"), _bound(patience, "s")


def _bound(value: float, unit: str) -> Noise:
    return Scale(value, unit) if np.isfinite(value) else Fixed(value)
