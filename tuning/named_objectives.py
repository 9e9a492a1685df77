"""Objectives by name, from a text such as `nll+0.1*rmse`."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from types import MappingProxyType

from trackwright.tuning.objectives import (
    AbstractObjective,
    NegativeLogLikelihood,
    RootMeanSquareError,
    StateLogLikelihood,
    Weighted,
)

HEIGHT_WEIGHT = 0.5
"""Weight of an estimated height beside each coordinate of the plane in `state-nll`.

Noise levels that act on the height alone are fitted to it all the same; those that it shares with the plane follow the
plane's two coordinates, four times as heavy.
"""

OBJECTIVES: Mapping[str, Callable[[str, int], AbstractObjective]] = MappingProxyType(
    {
        "nll": lambda quantity, dimensions: NegativeLogLikelihood(),
        "rmse": RootMeanSquareError,
        "state-nll": lambda quantity, dimensions: StateLogLikelihood(
            quantity, dimensions, HEIGHT_WEIGHT if dimensions == 3 else 1.0
        ),
    }
)
"""Constructors by name, each of a quantity and its number of components."""

SUMMAND = re.compile(r"\s*(?:([0-9.]+(?:[eE][+-]?[0-9]+)?)\s*\*\s*)?([a-z][a-z-]*)\s*")


def parse_objective(text: str, quantity: str = "position", dimensions: int = 2) -> AbstractObjective:
    """The objective of a text such as `nll`, or `0.1*rmse + nll`.

    Raises ValueError for an unknown or duplicate name, and for a weight that isn't positive.
    """
    parts: dict[str, AbstractObjective] = {}
    weights, at = [], 0
    while True:
        match = SUMMAND.match(text, at)
        if match is None or match[2] not in OBJECTIVES or match[2] in parts:
            names = ", ".join(OBJECTIVES)
            raise ValueError(f"'{text}' is no objective; expected some of {names}, each once, as 'nll+0.1*rmse'")
        try:
            weights.append(float(match[1] or 1.0))
        except ValueError as error:
            raise ValueError(f"'{text}': the weight '{match[1]}' is not a number") from error
        parts[match[2]] = OBJECTIVES[match[2]](quantity, dimensions)
        at = match.end()
        if at == len(text):
            break
        if text[at] != "+":
            raise ValueError(f"'{text}': found '{text[at:]}' where '+' and another objective were expected")
        at += 1
    only = list(parts.values())
    return only[0] if len(only) == 1 and weights == [1.0] else Weighted(tuple(only), tuple(weights))
