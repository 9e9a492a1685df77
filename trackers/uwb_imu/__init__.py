"""System C: UWB two-way ranging, trilateration, and position from ranges with and without an IMU (Kwon et al. 2021)."""

from trackwright.trackers.core.on_demand import names_on_demand

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
