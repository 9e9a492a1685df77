"""The integral of a sensor's density over its readings, by quadrature in the whitened reading."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

POINTS = 4096
"""Readings per call of the density: 4096 for one channel, 64 × 64 for two, an eighth of 32 × 32 × 32 for three."""


def integral(
    log_density: Callable[[np.ndarray], Array],
    predicted: Float[np.ndarray, " m"],
    free: Int[np.ndarray, " free"],
    jacobian: Float[np.ndarray, "channels free"],
    wraps: Bool[np.ndarray, " m"],
    dof: float | None,
) -> tuple[float, float]:
    """∫ density over the free channels, the others fixed at the prediction, and the probability lost by wrapping.

    Trapezoidal rule in s with u = sinh s the whitened reading: exponentially accurate for the normal density, and far
    into the tails of Student's t (`dof`). `jacobian`: ∂whitened/∂reading over the free channels.
    """
    k = len(free)
    rows = jacobian[np.any(jacobian != 0, axis=1)]
    factor = rows if len(rows) == k else np.linalg.qr(jacobian)[1]
    if not np.all(np.isfinite(factor)) or abs(np.linalg.det(factor)) < 1e-30:
        return math.nan, 0.0
    inverse = np.linalg.inv(factor)
    reach = math.asinh(8.0) if dof is None else min(3.0 + 16.0 / dof, 18.0)
    s = np.linspace(-reach, reach, {1: POINTS, 2: 64, 3: 32}[k])
    grid = np.stack(np.meshgrid(*[s] * k, indexing="ij"), axis=-1).reshape(-1, k)
    offsets = np.sinh(grid) @ inverse.T
    values = np.tile(predicted, (len(grid), 1))
    values[:, free] += offsets
    blocks = values.reshape(-1, POINTS, len(predicted))
    density = np.exp(np.concatenate([np.asarray(log_density(block), float) for block in blocks]))
    inside = np.all((np.abs(offsets) <= np.pi) | ~wraps[free], axis=1)
    weight = np.prod(np.cosh(grid), axis=1) * (s[1] - s[0]) ** k * abs(np.linalg.det(inverse))
    scales = np.sqrt(np.sum(inverse**2, axis=1))[wraps[free]]
    return float(np.sum(density * weight * inside)), sum(beyond(np.pi / scale, dof) for scale in scales)


def beyond(x: float, dof: float | None) -> float:
    """The probability beyond ± x of the standard normal, or of Student's t with `dof` degrees of freedom."""
    return 2 * float(scipy.stats.t.sf(x, math.inf if dof is None else dof))
