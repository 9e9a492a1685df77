"""Monte Carlo studies: worlds × trackers × a parameter grid × runs, and metrics with bootstrap intervals."""

from experiments.monte_carlo.declaration import Condition, Study, TrackerConfig, World
from experiments.monte_carlo.errors import TrackedRuns
from experiments.monte_carlo.expectations import Conclusion, ExpectedResult, Value
from experiments.monte_carlo.results import Results
from experiments.monte_carlo.runner import run_study
from experiments.monte_carlo.sources import load_study

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
    "load_study",
    "run_study",
]
