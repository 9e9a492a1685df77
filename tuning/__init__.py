"""Fit noise levels and other parameters of trackers to recordings by gradient; README.md explains how."""

from trackwright.trackers.core.on_demand import names_on_demand

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
