"""System A: antenna arrays at 24 GHz; beamformers, beam tracker, bearings-only fusion, position from phases."""

from trackwright.trackers.core.on_demand import names_on_demand

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
