from trackwright.trackers.core.data.metrics import bias as bias
from trackwright.trackers.core.data.metrics import consistency as consistency
from trackwright.trackers.core.data.metrics import coverage as coverage
from trackwright.trackers.core.data.metrics import error_metrics as error_metrics
from trackwright.trackers.core.data.metrics import nees as nees
from trackwright.trackers.core.data.metrics import rmse as rmse
from trackwright.trackers.core.data.metrics import time_lost as time_lost
from trackwright.trackers.core.run.crlb import posterior_bound as posterior_bound
from trackwright.trackers.evaluation.events import events_of as events_of

__all__ = [
    "bias",
    "consistency",
    "coverage",
    "error_metrics",
    "events_of",
    "nees",
    "posterior_bound",
    "rmse",
    "time_lost",
]
