"""System D, MH-K: a sliding median, a hidden Markov model of accelerations, a Kalman filter (Huang et al. 2018)."""

from trackwright.trackers.core.on_demand import names_on_demand

__getattr__, __dir__, __all__ = names_on_demand(__name__, __file__)
