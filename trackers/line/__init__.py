"""System B: a tag on an assembly line with a known path; particle filter and grid filter (thesis)."""

from trackwright.trackers.core.on_demand import names_on_demand

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
