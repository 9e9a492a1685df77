from trackwright.trackers.core.data.consistency import consistency as consistency
from trackwright.trackers.core.data.consistency import nees as nees
from trackwright.trackers.evaluation.bounds import posterior_bound as posterior_bound
from trackwright.trackers.evaluation.events import events_of as events_of

__all__ = [
    "consistency",
    "events_of",
    "nees",
    "posterior_bound",
]
