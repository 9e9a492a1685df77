"""A robust least-squares fit of a few numbers to errors with outliers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

STEPS = 15
ROUNDS = 2
"""Fits one after another, each with Cauchy's weights at the scale of the errors that the one before left."""


def robust_fit(
    errors: Callable[[np.ndarray], Float[np.ndarray, "N m"]], start: Float[np.ndarray, " k"], steps: int = STEPS
) -> tuple[Float[np.ndarray, " k"], float]:
    """The numbers near `start` with the smallest errors, and their median size; errors that are NaN count nothing."""
    from scipy.optimize import least_squares  # a quarter of a second, and most recordings need no fit

    def finite(x: np.ndarray) -> np.ndarray:
        return np.nan_to_num(errors(x)).ravel()

    x = np.asarray(start, float)
    for _ in range(ROUNDS):
        scale = max(1.4826 * float(np.median(np.abs(finite(x)))), 1e-9)
        x = least_squares(finite, x, loss="cauchy", f_scale=scale, max_nfev=steps).x
    return x, float(np.median(np.abs(finite(x))))
