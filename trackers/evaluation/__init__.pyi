from trackwright.trackers.core.data.consistency import consistency as consistency
from trackwright.trackers.core.data.consistency import nees as nees
from trackwright.trackers.evaluation.bounds import posterior_bound as posterior_bound

__all__ = ["consistency", "nees", "posterior_bound"]
