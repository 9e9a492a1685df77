"""Least-squares intersection of the rays of bearings: the start of position trackers."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.model.algebra import Scalar, product
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.recordings.columns import first_not_before

MIN_INFORMATION = 0.02
"""Smallest eigenvalue of the information matrix, per ray (0 … ⅔), at which a point is determined."""

WINDOW_S = 1.0
"""How long a ray counts, s."""


def unit_vector(azimuth: Scalar, elevation: Scalar) -> jax.Array:
    """The unit vector of two angles in the array frame, (3,)."""
    cosine = jnp.cos(elevation)
    return jnp.stack([jnp.sin(azimuth) * cosine, jnp.sin(elevation), jnp.cos(azimuth) * cosine])


def nearest_to_rays(
    rays: Sequence[tuple[AnyArray, jax.Array, Scalar]], centre: jax.Array, height: Scalar | None = None
) -> jax.Array:
    """The point (3,), m, nearest to the rays (origin, unit direction, mask), with a weak prior at `centre`."""
    eye = jnp.eye(3, dtype=centre.dtype)
    information = eye * 1e-2
    if height is not None:
        centre = centre.at[2].set(height)
        information = information.at[2, 2].set(1e4)
    sums = product(information, centre)
    for origin, direction, counts in rays:
        projection = jnp.where(counts, eye - jnp.outer(direction, direction), 0.0)
        information, sums = information + projection, sums + product(projection, origin)
    # Cramer's rule: batched LAPACK calls can deadlock when several threads share few cores.
    a, b, c = information
    by_a, by_b, by_c = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
    return (by_a * sums[0] + by_b * sums[1] + by_c * sums[2]) / product(a, by_a)


def recent_points(
    starts: np.ndarray, times: np.ndarray, origins: np.ndarray, axes: np.ndarray, angles: np.ndarray, seen: np.ndarray,
    heights: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """For every row (T, 4): the point nearest to the rays of the last second, m, and 1 where they determine it.

    `starts` (n + 1,): the first row of each of n tags, then T. `times` (T,) s, sorted by tag; `origins` (T, 3) m and
    `axes` (T, 9): of each row's station; `angles` (T, 2) rad and `seen` (T, 2): an azimuth alone counts as the plane
    through the array's y axis that it tells. `heights` (n,) m: NaN where unknown; with a known one a ray can be enough.
    """
    azimuth, elevation = angles.T
    u = np.stack([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)], axis=1)
    direction = np.einsum("tk,tki->ti", u, axes.reshape(-1, 3, 3))
    both, seen = np.all(seen, axis=1, keepdims=True)[..., None], seen[:, 0]
    across = np.stack([np.cos(azimuth), 0.0 * azimuth, -np.sin(azimuth)], axis=1)
    normal = np.einsum("tk,tki->ti", across, axes.reshape(-1, 3, 3))
    ray, plane = np.eye(3) - direction[:, :, None] * direction[:, None, :], normal[:, :, None] * normal[:, None, :]
    projection = np.where(seen[:, None, None], np.where(both, ray, plane), 0.0)
    lengths = np.diff(starts)
    first = first_not_before(times, np.repeat(starts[:-1], lengths), np.arange(len(times)), times - WINDOW_S)
    information, sums, counts = (
        _windowed(x, starts, first)
        for x in (projection, np.einsum("tij,tj->ti", projection, origins), seen.astype(float))
    )
    points, row_heights = np.zeros((len(times), 4)), np.repeat(heights, lengths)
    for known in (True, False):
        rows = np.flatnonzero(np.isfinite(row_heights) == known)
        if len(rows):
            parts = (information[rows], sums[rows], counts[rows])
            points[rows] = _nearest_points(*parts, row_heights[rows] if known else None)
    return points


def _nearest_points(
    information: np.ndarray, sums: np.ndarray, counts: np.ndarray, height: np.ndarray | None
) -> np.ndarray:
    """Points (n, 3), m, and whether they are determined, from sums of projections over rays; `height` (n,) m."""
    size = 3 if height is None else 2
    if height is not None:
        sums = sums[:, :2] - information[:, :2, 2] * height[:, None]
    information = information[:, :size, :size]
    smallest = np.linalg.eigvalsh(information)[:, 0] / np.maximum(counts, 1.0)
    determined = smallest > MIN_INFORMATION
    safe = np.where(determined[:, None, None], information, np.eye(size))
    points = np.linalg.solve(safe, sums[:, :size, None])[:, :, 0]
    if height is not None:
        points = np.concatenate([points, height[:, None]], axis=1)
    return np.concatenate([np.where(determined[:, None], points, 0.0), determined[:, None]], axis=1)


def _windowed(values: np.ndarray, starts: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The sum of the rows first[t] … t of the same tag, as a difference of cumulative sums over the tag's rows."""
    lengths = np.diff(starts)
    tag = np.repeat(np.arange(len(lengths)), lengths)
    row = np.arange(len(values)) - starts[:-1][tag]
    total = np.zeros((len(lengths), int(lengths.max()) + 1, *values.shape[1:]))
    total[tag, row + 1] = values
    np.cumsum(total, axis=1, out=total)
    return total[tag, row + 1] - total[tag, first - starts[:-1][tag]]
