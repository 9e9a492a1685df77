"""Where fits start from: a coarse grid over the motion's scales against all others, since valleys run there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trackers.core.tunable import Covariance, Scale
from tuning.parameters import Parameter

APART = np.log(10.0)
"""From one point of the grid to the next, in unconstrained coordinates: a factor of ten."""


def coarse_grid(parameters: Sequence[Parameter], vector: np.ndarray) -> np.ndarray:
    """Starts (S, p): the vector itself first, then with the motion's and all other scales a tenth or tenfold.

    Scales: noise levels, and times and rates beside them; offsets and fractions stay. Nine starts where both kinds are
    tuned, three for one, one for none.
    """
    motion, others = np.zeros_like(vector), np.zeros_like(vector)
    at = 0
    for parameter in parameters:
        size = np.size(parameter.example.raw)
        raised = np.zeros(np.shape(parameter.example.raw))
        if isinstance(parameter.example, Scale):
            raised = raised + 1.0
        elif isinstance(parameter.example, Covariance):
            raised = np.eye(len(raised))  # the logarithms of a Cholesky factor's diagonal
        part = motion if parameter.names[0].startswith("motion.") else others
        part[at : at + size] = np.ravel(raised)
        at += size
    steps = (0.0, -APART, APART)
    grid = [
        vector + a * motion + b * others
        for a in (steps if motion.any() else steps[:1])
        for b in (steps if others.any() else steps[:1])
    ]
    return np.stack(grid)
