"""Monte Carlo studies: worlds × trackers × a grid of numbers, thousands of runs, figures with intervals."""

from experiments.monte_carlo.declaration import Condition, Study, TrackerConfig, World
from experiments.monte_carlo.expectations import Conclusion, ExpectedResult
from experiments.monte_carlo.results import Results, Value
from experiments.monte_carlo.trajectories import Run

__all__ = ["Conclusion", "Condition", "ExpectedResult", "Results", "Run", "Study", "TrackerConfig", "Value", "World"]
