"""Monte Carlo studies: worlds × trackers × a grid of numbers, thousands of runs, figures with intervals."""

from experiments.study.claims import Claim, Conclusion
from experiments.study.declaration import Cell, Entrant, Study, World
from experiments.study.results import Results, Value
from experiments.study.run import Run

__all__ = ["Cell", "Claim", "Conclusion", "Entrant", "Results", "Run", "Study", "Value", "World"]
