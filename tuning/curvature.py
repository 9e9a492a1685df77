"""Curvature of a likelihood at its optimum: the last steps of a fit, and how sure its numbers are."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tuning.parameters import Parameter, physical_errors

STEP = 0.02
"""Step of the central differences in unconstrained coordinates: 2 % of a noise level."""

DETERMINED = 1e-5
"""Least curvature, as a part of the largest, of a direction that the data determine; less is rounding."""

Gradients = Callable[[np.ndarray], np.ndarray]
"""From vectors (S, p) to gradients (S, p)."""


def hessian(gradients: Gradients, vector: np.ndarray) -> np.ndarray:
    """The second derivatives (p, p) by central differences of the gradients, all in one call."""
    shifts = STEP * np.eye(len(vector))
    up, down = np.split(gradients(np.concatenate([vector + shifts, vector - shifts])), 2)
    rows = (up - down) / (2 * STEP)
    return 0.5 * (rows + rows.T)


def newton_step(curvature: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """The step to the minimum of the quadratic model, at most 1 long, only along directions that are determined."""
    eigenvalues, directions = np.linalg.eigh(curvature)
    known = eigenvalues > DETERMINED * eigenvalues.max()
    step = -directions[:, known] @ ((directions[:, known].T @ slope) / eigenvalues[known])
    return step / max(1.0, float(np.linalg.norm(step)))


def standard_errors(parameters: Sequence[Parameter], vector: np.ndarray, information: np.ndarray) -> list[np.ndarray]:
    """Standard errors of the physical values, the inverse of the observed information in unconstrained coordinates.

    NaN for a value that has a part in a direction without positive curvature: the data don't determine it.
    """
    nothing = [np.full(np.shape(p.example.raw), np.nan) for p in parameters]
    if not np.all(np.isfinite(information)):
        return nothing
    eigenvalues, directions = np.linalg.eigh(information)
    known = eigenvalues > DETERMINED * eigenvalues.max()
    inverse = (directions[:, known] / eigenvalues[known]) @ directions[:, known].T
    undetermined = (np.abs(directions[:, ~known]) > 0.1).any(axis=1)
    start, errors = 0, physical_errors(parameters, vector, inverse)
    for k, error in enumerate(errors):
        part = undetermined[start : start + error.size].reshape(error.shape)
        errors[k] = np.where(part, np.nan, error)
        start += error.size
    return errors
