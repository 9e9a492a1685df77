"""Starts of a fit: a coarse grid over the motion's scales against all others, along which likelihoods have valleys."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trackers.core.tunable import Covariance, Scale
from tuning.parameters import Parameter

STEP = np.log(10.0)
"""Distance between grid points in unconstrained coordinates: a factor of ten."""


def coarse_grid(parameters: Sequence[Parameter], vector: np.ndarray) -> np.ndarray:
    """Starts (S, p): the vector itself first, then with the motion's and all other scales a tenth or tenfold.

    Scales are noise levels, times and rates; offsets and fractions stay. Nine starts where both groups are tuned, three
    for one, one for none.
    """
    motion, others = np.zeros_like(vector), np.zeros_like(vector)
    at = 0
    for parameter in parameters:
        raised = np.zeros(parameter.shape)
        if isinstance(parameter.example, Scale):
            raised = raised + 1.0
        elif isinstance(parameter.example, Covariance):
            raised = np.eye(len(raised))  # the logarithms of a Cholesky factor's diagonal
        part = motion if parameter.names[0].startswith("motion.") else others
        part[at : at + parameter.size] = np.ravel(raised)
        at += parameter.size
    steps = (0.0, -STEP, STEP)
    grid = [
        vector + a * motion + b * others
        for a in (steps if motion.any() else steps[:1])
        for b in (steps if others.any() else steps[:1])
    ]
    return np.stack(grid)
