from trackwright.tuning.diagnostics import innovations_of as innovations_of
from trackwright.tuning.fitting import Progress as Progress
from trackwright.tuning.objectives import parse_objective as parse_objective

__all__ = [
    "Progress",
    "innovations_of",
    "parse_objective",
]
