from trackwright import sim, trackers, tuning
from trackwright.experiments.pages.plots import notebook as plot
from trackwright.sim import *
from trackwright.sim import worlds as simulate
from trackwright.trackers import *
from trackwright.tuning import *

__version__: str

__all__ = ["plot", "simulate"]
__all__ += trackers.__all__
__all__ += sim.__all__
__all__ += tuning.__all__
