"""Baselines: filters and moving windows on the position fixes of a locating system."""

from trackwright.trackers.core.on_demand import names_on_demand

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
