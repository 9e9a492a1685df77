"""Track loss: when a tracker gives up a track and starts a new one."""

from __future__ import annotations

import equinox as eqx

from trackers.core.tunable import Threshold


class TrackLossPolicy(eqx.Module):
    """The thresholds above which a track is lost and started again.

    `nis_limit`: of the running mean of NIS per degree of freedom, over about `nis_window` rows with measurements.
    `max_gap`: of the time without measurements, s. np.inf disables one. No fit changes them; tune them by sweep.
    """

    nis_limit: Threshold
    nis_window: Threshold
    max_gap: Threshold

    def __init__(self, nis_limit: float = 6.0, nis_window: float = 8.0, max_gap: float = 5.0):
        self.nis_limit, self.nis_window = Threshold(nis_limit), Threshold(nis_window)
        self.max_gap = Threshold(max_gap, "s")
