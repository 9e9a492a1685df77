import sim
import trackers
import tuning
from experiments.pages.plots import notebook as plot
from sim import *
from sim import worlds as simulate
from trackers import *
from tuning import *

__version__: str

__all__ = ["plot", "simulate"]
__all__ += trackers.__all__
__all__ += sim.__all__
__all__ += tuning.__all__
