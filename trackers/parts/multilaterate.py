"""Multilateration: robust least-squares positions from ranges, of one epoch, or for every time from the last seconds.

From those of the last seconds range trackers start.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from trackwright.trackers.core.model.algebra import Scalar, Vector, total
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.core.model.rig import mirrored
from trackwright.trackers.core.run.chunks import called
from trackwright.trackers.parts.median import nan_median
from trackwright.trackers.parts.start_nearby import AbstractPlaces, last_of_times
from trackwright.trackers.recordings.columns import first_not_before

ITERATIONS = 20  # Gauss–Newton steps; with weights that change at every step, convergence is linear
# Smallest eigenvalue of the horizontal information matrix, per range (0 … ½), at which a position is determined.
MIN_INFORMATION = 0.02

FURTHEST = 10.0  # residual, in scales of the loss, of the furthest range that a position agrees with

RIDGE = 1e-3  # information, m⁻² at unit weight, added to every direction, so that unobservable ones stay finite


class PositionFit(eqx.Module):
    """A least-squares position: `position` (n,), m; `cost` Σ log(1 + (r/scale)²) of the residuals r.

    `covariance` (n, n): inverse information of ranges with unit variance. `determined`: whether more ranges than
    unknowns agree with the position, from directions that determine it.
    """

    position: AnyArray
    cost: Scalar
    covariance: AnyArray
    determined: Scalar


def multilaterate(
    ranges: AnyArray, anchors: AnyArray, counts: AnyArray, height: Scalar | None, scale: Scalar
) -> PositionFit:
    """The position of least cost for ranges (S,), m, to anchors (S, 3), m, where `counts` (S,) is true.

    Gauss–Newton on the Cauchy loss, each range weighted by 1/(1 + (r/scale)²), with `scale` m at least 1.5 times the
    median residual (Huber and Ronchetti 2009, section 7.8). It starts at the anchors' centroid; in three dimensions
    below and above it, and keeps the fit of lower cost, since coplanar anchors leave two mirror images. With a known
    `height`, m, only x and y are estimated.
    """
    counts = jnp.where(counts, jnp.ones_like(ranges), 0.0)
    number = jnp.maximum(jnp.sum(counts), 1.0)
    centroid = Vector.of(jnp.sum(counts * anchors[:, k]) / number for k in range(3))
    if height is not None:
        return _gauss_newton(ranges, anchors, counts, Vector(centroid[0], centroid[1]), height, scale)
    spread = (anchors[:, 0] - centroid[0]) ** 2 + (anchors[:, 1] - centroid[1]) ** 2
    up = Vector(0.0, 0.0, _root(jnp.sum(counts * spread) / number))
    below, above = (_gauss_newton(ranges, anchors, counts, x, None, scale) for x in (centroid - up, centroid + up))
    return jax.tree_util.tree_map(lambda a, b: jnp.where(below.cost <= above.cost, a, b), below, above)


def _gauss_newton(
    ranges: AnyArray, anchors: AnyArray, counts: AnyArray, start: Vector, height: Scalar | None, scale: Scalar
) -> PositionFit:
    # Arrays have the axis of ranges alone: over many rows (`vmap`, rows last) each operation runs along long vectors.
    n, number = len(start), jnp.sum(counts)

    def linearised(position: Vector) -> tuple[AnyArray, list[jax.Array], jax.Array]:
        """Residuals (S,), columns of the Jacobian (S,) and predicted ranges (S,)."""
        place = [*position] if height is None else [*position, height]
        offset = [x - anchors[:, k] for k, x in enumerate(place)]
        distance = jnp.sqrt(jnp.maximum(total(x * x for x in offset), 1e-12))
        return counts * (ranges - distance), [x / distance for x in offset[:n]], distance

    def widened(residual: AnyArray) -> Scalar:
        return jnp.maximum(1.5 * lower_median(jnp.abs(residual), counts), scale)

    def step(position: Vector, _: None) -> tuple[Vector, None]:
        residual, jacobian, distance = linearised(position)
        weight = counts / (1.0 + (residual / widened(residual)) ** 2)
        gradient = [jnp.sum(weight * residual * column) for column in jacobian]
        inverted = inverse(information(weight, jacobian))
        move = Vector.of(total(a * b for a, b in zip(row, gradient, strict=True)) for row in inverted)
        # No step is longer than the mean distance to the anchors: beyond it the linearisation does not hold.
        longest = jnp.maximum(jnp.sum(counts * distance) / jnp.maximum(number, 1.0), 1e-6)
        return position + move / jnp.maximum(_root(move.dot(move)) / longest, 1.0), None

    position = jax.lax.scan(step, start, None, length=ITERATIONS)[0]
    residual, jacobian, _ = linearised(position)
    weight = counts / (1.0 + (residual / scale) ** 2)
    # A minimal set of ranges is met exactly by several positions, so one more must agree.
    agree = jnp.where(jnp.abs(residual) <= FURTHEST * widened(residual), counts, 0.0)
    (a, b), (_, c) = information(agree, jacobian[:2], ridge=0.0)
    smallest = 0.5 * (a + c - _root((a - c) ** 2 + 4.0 * b * b)) / jnp.maximum(jnp.sum(agree), 1.0)
    determined = (jnp.sum(agree) > n) & (smallest > MIN_INFORMATION) & jnp.all(jnp.isfinite(position.array()))
    return PositionFit(
        position.array(),
        jnp.sum(jnp.log1p((residual / scale) ** 2)),
        jnp.stack([jnp.stack(row) for row in inverse(information(weight, jacobian))]),
        determined,
    )


def _root(square: Scalar) -> Scalar:
    """The square root; its derivative at zero, as in rows without ranges, is finite."""
    return jnp.sqrt(jnp.maximum(square, jnp.finfo(square.dtype).tiny))


def information(weight: AnyArray, jacobian: list[jax.Array], ridge: float = RIDGE) -> list[list[Scalar]]:
    """The information matrix of ranges with these weights (S,) and columns of the Jacobian (S,)."""
    rows = [[jnp.sum(weight * a * b) for b in jacobian] for a in jacobian]
    return [[x + ridge if i == j else x for j, x in enumerate(row)] for i, row in enumerate(rows)]


def lower_median(values: AnyArray, counts: AnyArray) -> Scalar:
    """The median of the values (S,) where `counts` (S,) > 0, the lower one of an even number; 0 for none."""
    # By ranks: sorting row by row took most of the time.
    kept = jnp.where(counts > 0, values, jnp.inf)
    index = (jnp.sum(counts > 0) - 1) // 2
    smaller, not_larger = (
        jnp.sum(compare(kept[None, :], kept[:, None]), axis=1) for compare in (jnp.less, jnp.less_equal)
    )
    chosen = (smaller <= index) & (index < not_larger) & (counts > 0)
    return jnp.sum(jnp.where(chosen, kept, 0.0)) / jnp.maximum(jnp.sum(chosen.astype(kept.dtype)), 1.0)


def inverse(matrix: list[list[Scalar]]) -> list[list[Scalar]]:
    """The inverse of a symmetric 2 × 2 or 3 × 3 matrix by Cramer's rule: batched LAPACK calls can deadlock."""
    if len(matrix) == 2:
        (a, b), (_, c) = matrix
        determinant = a * c - b * b
        return [[c / determinant, -b / determinant], [-b / determinant, a / determinant]]
    x, y, z = (Vector(*row) for row in matrix)
    rows = [y.cross(z), z.cross(x), x.cross(y)]
    determinant = x.dot(rows[0])
    return [[row[k] / determinant for row in rows] for k in range(3)]


MEDIAN_RANGES = 5  # number of an anchor's latest ranges in the median, which tolerates two outliers

WINDOWS_S = (1.0, 5.0)  # windows of recent ranges, s, the shortest first

CAUCHY_SCALE = 0.3  # Cauchy scale, m: residuals beyond it are down-weighted

BLOCK, BLOCKS = 256, 16  # times solved at once, few enough for the processor's cache, and blocks of them per call


class RangePlaces(AbstractPlaces):
    """Positions from the ranges of the last seconds, for every time of N rows of ranges, one a row.

    `rows` (K, A, W): of each of K times the latest rows so far with ranges to each of A anchors, the latest first;
    `windows` (K, A, W): in how many of `WINDOWS_S` each is. `of_row` (N,): the number of each row's time. `anchors`
    (A, 3) m. With a known `height`, m, three anchors are needed, without, None, four. The second window is used where
    the ranges of the first do not determine the position; the first `slots` of the W rows can be in the first. Heights
    are on the side of the `limits` (2,), m.
    """

    rows: Int[Any, "K A W"]
    windows: Int[Any, "K A W"]
    of_row: Int[Any, " N"]
    anchors: Float[Any, "A 3"]
    height: Scalar | None
    limits: Float[Any, " 2"]
    slots: int = eqx.field(static=True)

    def __call__(self, values: Float[Array, "N 1 B"], seen: Bool[Array, "N 1 B"]) -> Float[Array, "N 4 B"]:
        (times, *_), lanes = self.rows.shape, values.shape[2]
        all_rows, all_windows = jnp.asarray(self.rows), jnp.asarray(self.windows)

        def at(
            anchors: Any, values: Array, rows: Int[Array, "A w g"], windows: Int[Array, "A w g"], least: int
        ) -> Array:
            shape = (*rows.shape[:2], -1)
            counts = (seen[rows, 0] & (windows >= least)[..., None]).reshape(shape)
            return placed(anchors, self.height, values[rows, 0].reshape(shape), counts)

        # So many times together that they fill a block.
        together = max(1, BLOCK // lanes)
        blocks = -(-times // together)

        def in_blocks(x: Array) -> Array:
            whole = jnp.pad(x[:, :, : self.slots], [(0, blocks * together - times), (0, 0), (0, 0)])
            return jnp.moveaxis(whole.reshape(blocks, together, *whole.shape[1:]), 1, -1)

        blocked = in_blocks(all_rows), in_blocks(all_windows)
        near = jax.lax.map(lambda block: at(self.anchors, values, block[0], block[1], 2), blocked)
        near = jnp.swapaxes(near.reshape(blocks, 4, together, lanes), 1, 2).reshape(-1, 4, lanes)[:times]

        def further(places: tuple[Array, Array]) -> tuple[Array, Array]:
            far, wanted = places
            k = jnp.argmax(wanted)
            known = jax.lax.stop_gradient((self.anchors, values))
            place = at(*known, all_rows[k][..., None], all_windows[k][..., None], 1)
            return far.at[k].set(place), wanted.at[k].set(False)

        # Time after time where one is wanted, which is hardly ever.
        wanted = jnp.any(near[:, 3] == 0, axis=1) & jnp.any(all_windows == 1, axis=(1, 2))
        far, _ = jax.lax.while_loop(lambda of: jnp.any(of[1]), further, (jnp.zeros_like(near), wanted))
        place = jnp.where(near[:, 3:] > 0, near, far)
        height = jnp.where(place[:, 3] > 0, mirrored(place[:, 2], self.limits), 0.0)
        return place.at[:, 2].set(height)[self.of_row]


def recent_positions(
    starts: np.ndarray, times: np.ndarray, anchors: np.ndarray, numbers: np.ndarray, ranges: np.ndarray,
    seen: np.ndarray, heights: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """For every row (N, 4): the position from the ranges of the last seconds, m, and 1 where they determine it.

    `starts` (n + 1,): the first row of each of n tags, then N. `times` (N,) s, sorted by tag; `anchors` (A, 3) m;
    `numbers` (N,): the anchor of each row; `ranges` (N,) m and `seen` (N,). `heights` (n,) m: of the tags, NaN where
    unknown. All rows of a time have its position, as in `RangePlaces`.
    """
    last, of_row = last_of_times(starts, times)
    rows, windows = recent_rows(last, starts, times, numbers, seen, len(anchors), MEDIAN_RANGES)
    floating = jax.dtypes.canonicalize_dtype(float)
    result, height_of = np.zeros((len(last), 4)), np.repeat(heights, np.diff(starts))[last]
    # Arrays of NumPy go to the device with the call, in a third of the time.
    values = ranges.astype(floating)
    for height in np.unique(heights):
        known = None if np.isnan(height) else np.asarray(height, floating)
        part = np.flatnonzero(np.isnan(height_of) if known is None else height_of == height)
        for first in range(0, len(part), BLOCK * BLOCKS):
            at = part[first : first + BLOCK * BLOCKS]
            of_blocks = np.pad(at, (0, BLOCK * BLOCKS - len(at)), "edge").reshape(BLOCKS, BLOCK)
            given = (np.ascontiguousarray(np.moveaxis(x[of_blocks], 1, -1)) for x in (values[rows], windows))
            blocks = np.asarray(-(-len(at) // BLOCK), np.int32)
            solved = called(_solved, (np.asarray(anchors, floating), known), (*given, blocks))
            result[at] = np.moveaxis(np.asarray(solved), -1, 1).reshape(-1, 4)[: len(at)]
    return result[of_row]


def recent_rows(
    last: np.ndarray, starts: np.ndarray, times: np.ndarray, numbers: np.ndarray, seen: np.ndarray, count: int,
    most: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The fields `rows` and `windows` of `RangePlaces` for the `last` row of each time: `most` of an anchor, or all."""
    begins = np.repeat(starts[:-1], np.diff(starts))
    own = [np.flatnonzero(seen & (numbers == anchor)) for anchor in range(count)]
    until = np.stack([np.searchsorted(rows, last, "right") for rows in own], axis=1)
    if most is None:
        oldest = first_not_before(times, begins[last], last, times[last] - WINDOWS_S[-1])
        since = np.stack([np.searchsorted(rows, oldest) for rows in own], axis=1)
        most = int((until - since).max())
    index = until[..., None] - 1 - np.arange(most)
    rows = np.stack([np.append(rows, -1)[np.maximum(index[:, k], -1)] for k, rows in enumerate(own)], axis=1)
    age = np.where(rows >= begins[last, None, None], times[last, None, None] - times[rows], np.inf)
    windows = (age[None] <= np.reshape(WINDOWS_S, (-1, 1, 1, 1))).sum(axis=0, dtype=np.int8)
    return np.where(windows > 0, rows, 0).astype(np.int32), windows


def placed(
    anchors: Float[Array, "A 3"], height: Scalar | None, ranges: Float[Array, "A W M"], counts: Bool[Array, "A W M"]
) -> Float[Array, "4 M"]:
    """Positions of M cases and 1 where determined, from the medians of ranges that count, the latest first; else 0."""
    scale = jnp.asarray(CAUCHY_SCALE, ranges.dtype)
    medians = nan_median(_latest(jnp.swapaxes(jnp.where(counts, ranges, jnp.nan), 0, 1)))
    heard = jnp.isfinite(medians)
    medians = jnp.where(heard, medians, 0.0)
    fit = jax.vmap(lambda r, c: multilaterate(r, anchors, c, height, scale), -1, -1)(medians, heard)
    place = list(fit.position) if height is None else [*fit.position, jnp.full_like(medians[0], height)]
    return jnp.stack([*(jnp.where(fit.determined, x, 0.0) for x in place), fit.determined.astype(scale.dtype)])


def _latest(ranges: Float[Array, "W A M"]) -> Float[Array, "r A M"]:
    """Of ranges from the latest on the first `MEDIAN_RANGES` that are not NaN."""
    if len(ranges) <= MEDIAN_RANGES:
        return ranges

    def older(latest: Array, value: Array) -> tuple[Array, None]:
        free = jnp.isnan(latest)
        return jnp.where(free & (jnp.cumsum(free, axis=0) == 1), value, latest), None

    return jax.lax.scan(older, ranges[:MEDIAN_RANGES], ranges[MEDIAN_RANGES:])[0]


def _solved(known: tuple[Any, Any], measured: tuple[Any, Any, Any]) -> Any:
    """Positions (BLOCKS, 4, BLOCK) of the first blocks, as of `placed`.

    `known`: anchors and height. `measured`: ranges, their windows, and the number of blocks.
    """
    (anchors, height), (ranges, windows, blocks) = known, measured

    def solve(block: Any, solved: Any) -> Any:
        fitted = lambda least: placed(anchors, height, ranges[block], windows[block] >= least)  # noqa: E731
        near = fitted(2)
        whole = jnp.all(near[3] > 0)
        place = jax.lax.cond(whole, lambda: near, lambda: jnp.where(near[3] > 0, near, fitted(1)))
        return solved.at[block].set(place)

    return jax.lax.fori_loop(0, blocks, solve, jnp.zeros((BLOCKS, 4, BLOCK), ranges.dtype))
