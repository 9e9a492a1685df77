"""A change of the readings, the truth or the rig that may explain large errors, and the errors with it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from trackers.recordings.checks.compared import Compared

PENALTY = 0.06
"""Log ratio of errors by which a fitted number must pay."""

FACTORS = (
    (0.001, "millimetres"), (0.01, "centimetres"), (0.3048, "feet"), (0.0254, "inches"), (1000.0, "kilometres"),
)  # fmt: skip
"""Metres per unit."""


class Explanation(NamedTuple):
    """`change`: what makes the errors small, in words after "with"; `cause`: the most likely mistake, and its fix.

    `sizes` (G, m): the median errors of groups and columns with it. `parameters`: how many numbers were fitted for it.
    `own`: each group has numbers of its own, or the change may concern some groups alone. `groups` (G,): those that it
    may concern, all of them or none if `together`, and few of them if it changes a `place`: of many it is the frame.
    `harmless`: a property of the sensor and no mistake. `parts`: what to name of each group, if anything.
    """

    change: str
    cause: str
    sizes: Float[np.ndarray, "G m"]
    parameters: int = 0
    own: bool = False
    groups: Bool[np.ndarray, " G"] | None = None
    together: bool = False
    place: bool = False
    harmless: bool = False
    parts: tuple[str, ...] = ()


def sizes_with(view: Compared, **changed: np.ndarray) -> Float[np.ndarray, "G m"]:
    """The median errors with other values, positions, places or rotations."""
    other = view._replace(**changed)  # type: ignore[arg-type]
    return other.sizes(other.errors())


def metres(vector: np.ndarray) -> str:
    """A vector in metres: `(1.20, -0.30, 0.00) m`."""
    return f"({', '.join(f'{x + 0.0:.2f}' for x in np.round(vector, 2))}) m"
