"""Monte Carlo studies: worlds × trackers × a grid of numbers, thousands of runs, figures with intervals."""

from experiments.monte_carlo.declaration import Cell, Entrant, Study, World
from experiments.monte_carlo.expectations import Claim, Conclusion
from experiments.monte_carlo.results import Results, Value
from experiments.monte_carlo.trajectories import Run

__all__ = ["Cell", "Claim", "Conclusion", "Entrant", "Results", "Run", "Study", "Value", "World"]
