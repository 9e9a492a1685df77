"""Derivatives by difference quotients in double precision, the other method that derivatives are held against."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.conformance.contract import NotApplicable

STEP = 1e-5
"""Half the interval of a difference quotient, in units of a component."""

CORNER = 1e-3
"""Difference of the slopes on both sides, relative to the largest slope, from which on a function has a corner."""


def central_differences(
    what: str, function: Callable[[Float[np.ndarray, "k n"]], Float[Array, "k m"]], n: int
) -> Float[np.ndarray, "m n"]:
    """The Jacobian at zero of a function that maps k points at once; raises NotApplicable where it has a corner."""
    shifts = STEP * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
    values: Any = np.asarray(function(shifts), float)
    here, above, below = values[0], values[1 : n + 1], values[n + 1 :]
    jacobian = (above - below).T / (2 * STEP)
    if np.abs(above + below - 2 * here).max() / STEP > CORNER * np.abs(jacobian).max():
        raise NotApplicable(f"{what} has a corner here, where it has no derivative; check it at another state")
    return jacobian
