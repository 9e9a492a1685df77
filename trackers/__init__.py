"""Trackers: everything that turns recordings of an installation into estimates.

A recording holds what the sensors of an installation measured. A tracker turns it into estimates. A recursive tracker
is a motion, some sensors, a filter and a start. Estimates can become the readings of the next tracker. The public names
stand below in the order in which a newcomer meets them; `trackers/README.md` shows how the parts fit.
"""

from trackwright.trackers.core.on_demand import names_on_demand

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
