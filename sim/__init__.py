"""Simulated worlds with truth: paths, measurements along them, corruptions, and worlds by name in `sim.worlds`."""

from trackwright.trackers.core.on_demand import names_on_demand

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
