from trackwright.tuning.diagnostics import innovations_of as innovations_of
from trackwright.tuning.fitting import Place as Place
from trackwright.tuning.named_objectives import parse_objective as parse_objective

__all__ = [
    "Place",
    "innovations_of",
    "parse_objective",
]
