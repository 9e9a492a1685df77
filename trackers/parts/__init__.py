"""Parts shared by several systems: fix and range sensors, Singer motion, starts, multilateration, walls."""

from trackwright.trackers.core.on_demand import names_on_demand

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
