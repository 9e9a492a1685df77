from trackwright.tuning.fitting import Progress as Progress
from trackwright.tuning.objectives import parse_objective as parse_objective

__all__ = [
    "Progress",
    "parse_objective",
]
