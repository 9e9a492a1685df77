"""Monte Carlo studies: worlds × trackers × a grid of numbers, thousands of runs, figures with intervals."""

from experiments.monte_carlo.declaration import Condition, Study, TrackerConfig, World
from experiments.monte_carlo.errors import TrackedRuns
from experiments.monte_carlo.expectations import Conclusion, ExpectedResult, Value
from experiments.monte_carlo.results import Results

__all__ = [
    "Conclusion",
    "Condition",
    "ExpectedResult",
    "Results",
    "Study",
    "TrackedRuns",
    "TrackerConfig",
    "Value",
    "World",
]
