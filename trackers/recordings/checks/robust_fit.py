"""A robust least-squares fit of a few numbers to errors with outliers (Levenberg-Marquardt, Cauchy's weights)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

STEPS = 15
CUT = 3.0
"""Robust standard deviations at which an error has a tenth of the weight of a small one."""


def robust_fit(
    errors: Callable[[np.ndarray], Float[np.ndarray, "N m"]], start: Float[np.ndarray, " k"], steps: int = STEPS
) -> tuple[Float[np.ndarray, " k"], float]:
    """The numbers near `start` with the smallest errors, and their median size; errors that are NaN count nothing.

    Derivatives are differences over 1e-6 of each number's unit.
    """
    x, damping = np.asarray(start, float), 1e-2
    e = _finite(errors(x))
    for _ in range(steps):
        scale = max(1.4826 * float(np.median(np.abs(e))), 1e-9)
        weights = 1.0 / (1.0 + (e / (CUT / 3 * scale)) ** 2)
        J = np.stack([(_finite(errors(x + 1e-6 * unit)) - e) / 1e-6 for unit in np.eye(len(x))], axis=1)
        normal, gradient = (J.T * weights) @ J, (J.T * weights) @ e
        loss = _loss(e, scale)
        # Damped in proportion to the largest curvature too: a height that is hardly seen would go far in one step.
        ridge = np.diag(np.diag(normal) + 0.1 * np.diag(normal).max() + 1e-12)
        for _ in range(6):
            step = np.linalg.solve(normal + damping * ridge, -gradient)
            trial = _finite(errors(x + step))
            if _loss(trial, scale) < loss:
                damping = max(damping / 5, 1e-9)
                break
            damping *= 10
        else:
            break
        x, e = x + step, trial
        if np.max(np.abs(step)) < 1e-5:
            break
    return x, float(np.median(np.abs(e)))


def _finite(errors: np.ndarray) -> np.ndarray:
    return np.nan_to_num(errors).ravel()


def _loss(errors: np.ndarray, scale: float) -> float:
    return float(np.log1p((errors / (CUT / 3 * scale)) ** 2).sum())
