from trackwright.tuning.diagnostics import innovations_of as innovations_of
from trackwright.tuning.fitting import Place as Place
from trackwright.tuning.identifiability import identifiability_issues as identifiability_issues
from trackwright.tuning.intervals import intervals_of as intervals_of
from trackwright.tuning.named_objectives import parse_objective as parse_objective

__all__ = [
    "Place",
    "identifiability_issues",
    "innovations_of",
    "intervals_of",
    "parse_objective",
]
