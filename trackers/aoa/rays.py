"""Least-squares intersection of the rays of bearings: the start of position trackers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import combinations_with_replacement
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.model.algebra import Scalar, product, total
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.parts.multilaterate import inverse
from trackwright.trackers.parts.start_nearby import AbstractPlaces, last_of_times

# Smallest eigenvalue of the information matrix, per ray (0 … ⅔), at which a point is determined.
MIN_INFORMATION = 0.02

WINDOW_S = 1.0  # how long a ray counts, s
# Number of bearings for which a start waits, and for how long, s: two biased ones can meet outside the room.
MIN_RAYS, PATIENCE_S = 4, 1.0


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


class RayPlaces(AbstractPlaces):
    """The points nearest to the rays of the last second, for N rows of bearings of one tag, one a row.

    `first` and `last` (N,): the rows whose rays count, up to the last one of a row's time. `earlier` (N,): the number
    of rows at least `PATIENCE_S` earlier. `origins` (N, 3) m and `axes` (N, 9): of each row's station. `height`: m,
    None where unknown; with a known one a ray can be enough.
    """

    first: Int[Any, " N"]
    last: Int[Any, " N"]
    earlier: Int[Any, " N"]
    origins: Float[Any, "N 3"]
    axes: Float[Any, "N 9"]
    height: Scalar | None

    @classmethod
    def of(cls, times: np.ndarray, origins: np.ndarray, axes: np.ndarray, height: float | None) -> RayPlaces:
        """The places of rows at these times (N,), s."""
        ends, of_row = last_of_times(np.array([0, len(times)]), times)
        first, earlier = np.searchsorted(times, times - WINDOW_S), np.searchsorted(times, times - PATIENCE_S, "right")
        return cls(first, ends[of_row], earlier, origins, axes, height)

    def __call__(self, values: Float[Any, "N 2 B"], seen: Bool[Any, "N 2 B"]) -> Float[Any, "N 4 B"]:
        """An azimuth alone counts as the plane through the array's y axis that it tells."""
        xp = jnp if isinstance(values, jax.Array) else np
        rays = _projections(xp, values[:, 0], values[:, 1], seen[:, 0], seen[:, 1], self.origins, self.axes)
        sums = xp.stack([*rays, xp.where(seen.any(axis=1), 1.0, 0.0 * rays[0])], axis=1)
        # Step by step: a cumulative sum of jax takes several times as long as the filter.
        scanned = partial(jax.lax.scan, lambda above, row: (above + row,) * 2, xp.zeros_like(sums[0]))
        sums = xp.concatenate([xp.zeros_like(sums[:1]), np.cumsum(sums, axis=0) if xp is np else scanned(sums)[1]])
        now, before, count = sums[self.last + 1], sums[self.first], sums[:, -1]
        *place, determined = _nearest_points(xp, [*xp.moveaxis(now - before, 1, 0)[:-1]], self.height)
        determined = determined & ((count[self.last + 1] >= MIN_RAYS) | (count[self.earlier] > 0))
        return xp.stack([xp.where(determined, x, 0.0) for x in (*place, determined)], axis=1)


def recent_points(
    starts: np.ndarray, times: np.ndarray, origins: np.ndarray, axes: np.ndarray, angles: np.ndarray, seen: np.ndarray,
    heights: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """For every row (T, 4): the point of `RayPlaces`, m, and 1 where the rays determine it.

    `starts` (n + 1,): the first row of each of n tags, then T. `times` (T,) s, sorted by tag; `origins` (T, 3) m and
    `axes` (T, 9): of each row's station; `angles` (T, 2) rad and `seen` (T, 2). `heights` (n,) m: NaN where unknown.
    """
    points = [np.zeros((0, 4))]
    for first, end, height in zip(starts[:-1], starts[1:], heights.tolist(), strict=True):
        of, known = slice(first, end), None if np.isnan(height) else height
        points.append(
            RayPlaces.of(times[of], origins[of], axes[of], known)(angles[of, :, None], seen[of, :, None])[..., 0]
        )
    return np.concatenate(points)


def _projections(
    xp: Any, azimuth: Any, elevation: Any, seen: Any, both: Any, origins: np.ndarray, axes: np.ndarray
) -> list[Any]:
    """Of rays (T, …), by `xp`, NumPy or jax's: the upper triangle of the projections P across them, P·origin, and 1.

    Zero where the azimuth is not `seen`; where it is seen alone, P projects onto the normal of its plane.
    """
    origin, axis = (x.T.reshape(*x.shape[::-1], *[1] * (azimuth.ndim - 1)) for x in (origins, axes))
    sine, cosine, level = xp.sin(azimuth), xp.cos(azimuth), xp.cos(elevation)
    along, across = (sine * level, xp.sin(elevation), cosine * level), (cosine, 0.0 * cosine, -sine)
    u, normal = ([total(v[k] * axis[3 * k + i] for k in range(3)) for i in range(3)] for v in (along, across))
    entry = {
        (i, j): xp.where(seen, xp.where(both, float(i == j) - u[i] * u[j], normal[i] * normal[j]), 0.0)
        for i, j in combinations_with_replacement(range(3), 2)
    }
    sums = [total(entry[min(i, j), max(i, j)] * origin[j] for j in range(3)) for i in range(3)]
    return [*entry.values(), *sums, xp.where(seen, 1.0, 0.0 * azimuth)]


def _nearest_points(xp: Any, sums: list[Any], height: Any) -> tuple[Any, Any, Any, Any]:
    """Points x, y, z, m, and whether they are determined, from sums of `_projections`; `height`: m, None if unknown."""
    xx, xy, xz, yy, yz, zz, x, y, z, count = sums
    matrix, right = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], [x, y, z]
    if height is not None:
        matrix, right = [[xx, xy], [xy, yy]], [x - xz * height, y - yz * height]
    # Sylvester's criterion: the smallest eigenvalue is above a number where, less it, all leading minors are positive.
    least = MIN_INFORMATION * xp.maximum(count, 1.0)
    a, b, c = xx - least, yy - least, zz - least
    determined = (a > 0.0) & (a * b - xy * xy > 0.0)
    if height is None:
        determined &= a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz) > 0.0
    safe = [[xp.where(determined, e, float(i == j)) for j, e in enumerate(row)] for i, row in enumerate(matrix)]
    place = [total(a * b for a, b in zip(row, right, strict=True)) for row in inverse(safe)]
    return *(place if height is None else [*place, height + 0.0 * x]), determined
