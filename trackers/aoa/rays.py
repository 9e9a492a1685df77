"""Least-squares intersection of the rays of bearings: the start of position trackers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar

MIN_INFORMATION = 0.02
"""Smallest eigenvalue of the information matrix, per ray (0 … ⅔), with which a point is determined."""


def unit_vector(azimuth: Scalar, elevation: Scalar) -> Any:
    """The unit vector of two angles in the array frame, (3,)."""
    cosine = jnp.cos(elevation)
    return jnp.stack([jnp.sin(azimuth) * cosine, jnp.sin(elevation), jnp.cos(azimuth) * cosine])


def nearest_to_rays(rays: Sequence[tuple[Any, Any, Any]], centre: Any, height: Any = None) -> Any:
    """The point (3,), m, nearest to the rays (origin, unit direction, mask), with a weak prior at `centre`."""
    eye = jnp.eye(3, dtype=centre.dtype)
    information = eye * 1e-2
    if height is not None:
        centre = centre.at[2].set(height)
        information = information.at[2, 2].set(1e4)
    sums = information @ centre
    for origin, direction, counts in rays:
        projection = jnp.where(counts, eye - jnp.outer(direction, direction), 0.0)
        information, sums = information + projection, sums + projection @ origin
    # Cramer's rule: batched LAPACK calls can deadlock when several threads share few cores.
    a, b, c = information
    by_a, by_b, by_c = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
    return (by_a * sums[0] + by_b * sums[1] + by_c * sums[2]) / (a @ by_a)


def recent_points(
    times: np.ndarray,
    origins: np.ndarray,
    axes: np.ndarray,
    angles: np.ndarray,
    seen: np.ndarray,
    height: float | None,
    window: float = 1.0,
) -> np.ndarray:
    """For every row (T, 4): the point nearest to the rays of the last `window` s, m, and 1 where they determine it.

    `times` (T,) s, sorted; `origins` (T, 3) m and `axes` (T, 9): of each row's station; `angles` (T, 2) rad and
    `seen` (T,). With a known `height`, m, one ray can be enough; without, two directions are needed.
    """
    azimuth, elevation = angles.T
    u = np.stack([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)], axis=1)
    direction = np.einsum("tk,tki->ti", u, axes.reshape(-1, 3, 3))
    projection = np.where(seen[:, None, None], np.eye(3) - direction[:, :, None] * direction[:, None, :], 0.0)
    # Sums over a sliding window are differences of cumulative sums.
    first = np.searchsorted(times, times - window)
    information, sums, counts = (
        _windowed(x, first) for x in (projection, np.einsum("tij,tj->ti", projection, origins), seen.astype(float))
    )
    n = 3 if height is None else 2
    if height is not None:
        sums = sums[:, :2] - information[:, :2, 2] * height
    information = information[:, :n, :n]
    smallest = np.linalg.eigvalsh(information)[:, 0] / np.maximum(counts, 1.0)
    determined = smallest > MIN_INFORMATION
    safe = np.where(determined[:, None, None], information, np.eye(n))
    points = np.linalg.solve(safe, sums[:, :n, None])[:, :, 0]
    if height is not None:
        points = np.concatenate([points, np.full((len(points), 1), height)], axis=1)
    return np.concatenate([np.where(determined[:, None], points, 0.0), determined[:, None]], axis=1)


def _windowed(values: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The sum of the rows first[t] … t."""
    total = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    return total[1:] - total[first]
