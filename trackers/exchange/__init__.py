"""Files of other programs: trajectories, logs and bags in, estimates out; trajectory errors as evo defines them."""

from trackwright.trackers.core.on_demand import names_on_demand

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
