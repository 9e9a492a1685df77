from trackwright.experiments.monte_carlo.declaration import Condition, Study, TrackerConfig, World
from trackwright.experiments.monte_carlo.results import Results
from trackwright.experiments.monte_carlo.runner import run_study
from trackwright.experiments.monte_carlo.sources import load_study
from trackwright.experiments.monte_carlo.tracked import TrackedRuns
from trackwright.experiments.text.expectations import (
    DERIVED,
    FITTED,
    PREDICTED,
    Claim,
    Conclusion,
    ExpectedResult,
    Origin,
    Value,
)

__all__ = [
    "DERIVED",
    "FITTED",
    "PREDICTED",
    "Claim",
    "Conclusion",
    "Condition",
    "ExpectedResult",
    "Origin",
    "Results",
    "Study",
    "TrackedRuns",
    "TrackerConfig",
    "Value",
    "World",
    "load_study",
    "run_study",
]
