"""Multilateration: robust least-squares positions from ranges, of one epoch, or for every row from the last seconds.

From those of the last seconds, computed on the host, range trackers start.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.model.algebra import Scalar, Vector, total
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.core.run.chunks import called

ITERATIONS = 20
"""Gauss–Newton steps; with weights that change at every step, convergence is linear."""

MIN_INFORMATION = 0.02
"""Smallest eigenvalue of the horizontal information matrix, per range (0 … ½), at which a position is determined."""

FURTHEST = 10.0
"""Residual, in scales of the loss, of the furthest range that a position agrees with."""

RIDGE = 1e-3
"""Information, m⁻² at unit weight, added to every direction, so that unobservable ones stay finite."""


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


MEDIAN_RANGES = 5
"""Number of an anchor's latest ranges in the median, which tolerates two outliers."""

WINDOWS_S = (1.0, 5.0)
"""Windows of recent ranges, s, the shortest first."""

CAUCHY_SCALE = 0.3
"""Cauchy scale, m: residuals beyond it are down-weighted."""

BLOCK, BLOCKS = 256, 16
"""Rows solved at once, few enough for the processor's cache, and blocks of them per call."""


def recent_positions(
    starts: np.ndarray, times: np.ndarray, anchors: np.ndarray, numbers: np.ndarray, ranges: np.ndarray,
    seen: np.ndarray, heights: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """For every row (N, 4): the position from the ranges of the last seconds, m, and 1 where they determine it.

    `starts` (n + 1,): the first row of each of n tags, then N. `times` (N,) s, sorted by tag; `anchors` (A, 3) m;
    `numbers` (N,): the anchor of each row; `ranges` (N,) m and `seen` (N,). `heights` (n,) m: of the tags; with a known
    one three anchors are needed, without, NaN, four. The second of `WINDOWS_S` is used where the ranges of the first do
    not determine the position.
    """
    result = np.zeros((len(times), 4))
    row_heights = np.repeat(heights, np.diff(starts))
    latest = latest_rows(starts, numbers, seen, len(anchors))
    for window in WINDOWS_S:
        rows = np.flatnonzero(result[:, 3] == 0)
        if len(rows) == 0:
            break
        medians = _medians(starts, times, numbers, ranges, seen, window)
        recent = (latest[rows] >= 0) & (times[rows, None] - times[latest[rows]] <= window)
        for height in np.unique(heights):
            at_height = np.isnan(row_heights[rows]) if np.isnan(height) else row_heights[rows] == height
            known = None if np.isnan(height) else float(height)
            part = np.flatnonzero(at_height)
            result[rows[part]] = _positions(anchors, medians[latest[rows[part]]], recent[part], known)
    return result


def latest_rows(starts: np.ndarray, numbers: np.ndarray, seen: np.ndarray, count: int) -> np.ndarray:
    """For each row, the latest row (N, A) so far of the same tag with a range to each of A anchors; −1 if none.

    `starts` (n + 1,): the first row of each tag, then N. `numbers` (N,): the anchor of each row. Later rows at the same
    time do not count.
    """
    rows = np.arange(len(numbers))
    first = np.repeat(starts[:-1], np.diff(starts))
    latest_of_each = np.empty((len(numbers), count), int)
    for anchor in range(count):
        latest = np.maximum.accumulate(np.where(seen & (numbers == anchor), rows, -1))
        latest_of_each[:, anchor] = np.where(latest >= first, latest, -1)
    return latest_of_each


def _medians(
    starts: np.ndarray, times: np.ndarray, numbers: np.ndarray, ranges: np.ndarray, seen: np.ndarray, window: float
) -> np.ndarray:
    """Per row with a range (N,): the median of its anchor's latest ranges to the tag in the window, m."""
    tag = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    kept = np.flatnonzero(seen)
    order = kept[np.lexsort((numbers[kept], tag[kept]))]
    same = tag[order] * (int(numbers.max(initial=0)) + 1) + numbers[order]
    back = np.arange(len(order))[:, None] - np.arange(MEDIAN_RANGES)
    before = np.maximum(back, 0)
    recent = (back >= 0) & (same[before] == same[:, None]) & (times[order][:, None] - times[order][before] <= window)
    ordered = np.sort(np.where(recent, ranges[order][before], np.inf), axis=1)
    count = recent.sum(axis=1)
    row = np.arange(len(order))
    medians = np.zeros(len(times))
    medians[order] = (ordered[row, (count - 1) // 2] + ordered[row, count // 2]) / 2.0
    return medians


def _positions(anchors: np.ndarray, ranges: np.ndarray, counts: np.ndarray, height: float | None) -> np.ndarray:
    """`recent_positions` (T, 4) from ranges (T, A) where `counts` (T, A) is true."""
    result = np.zeros((len(ranges), 4))
    # Arrays of NumPy go to the device with the call, in a third of the time.
    floating = jax.dtypes.canonicalize_dtype(float)
    known = np.asarray(anchors, floating), None if height is None else np.asarray(height, floating)
    for first in range(0, len(ranges), BLOCK * BLOCKS):
        part = slice(first, first + BLOCK * BLOCKS)
        rows = len(ranges[part])
        padded, padded_counts = (np.zeros((BLOCKS * BLOCK, len(anchors)), kind) for kind in (floating, bool))
        padded[:rows], padded_counts[:rows] = ranges[part], counts[part]
        solved = called(
            _solved, known, (_in_blocks(padded), _in_blocks(padded_counts), np.asarray(-(-rows // BLOCK), np.int32))
        )
        position, determined = (np.moveaxis(np.asarray(x), -1, 1).reshape(BLOCKS * BLOCK, -1)[:rows] for x in solved)
        of_part = result[part]
        of_part[:, : position.shape[1]] = np.where(determined, position, 0.0)
        if height is not None:
            of_part[:, 2] = np.where(determined[:, 0], height, 0.0)
        of_part[:, 3] = determined[:, 0]
    return result


def _in_blocks(rows: np.ndarray) -> np.ndarray:
    """The rows (BLOCKS · BLOCK, A) in blocks, rows of a block last (BLOCKS, A, BLOCK)."""
    return np.ascontiguousarray(np.moveaxis(rows.reshape(BLOCKS, BLOCK, -1), 1, -1))


def _solved(known: tuple[Any, Any], measured: tuple[Any, Any, Any]) -> tuple[Any, Any]:
    """Positions (BLOCKS, n, BLOCK) of the first blocks, and whether they are determined (BLOCKS, 1, BLOCK).

    `known`: anchors and height. `measured`: ranges, which of them count, and the number of blocks.
    """
    (anchors, height), (ranges, counts, blocks) = known, measured
    scale = jnp.asarray(CAUCHY_SCALE, ranges.dtype)

    def solve(block: Any, solved: tuple[Any, Any]) -> tuple[Any, Any]:
        fit = jax.vmap(lambda r, c: multilaterate(r, anchors, c, height, scale), -1, -1)(ranges[block], counts[block])
        return solved[0].at[block].set(fit.position), solved[1].at[block, 0].set(fit.determined)

    axes = 3 if height is None else 2
    nothing = jnp.zeros((BLOCKS, axes, BLOCK), ranges.dtype), jnp.zeros((BLOCKS, 1, BLOCK), bool)
    return jax.lax.fori_loop(0, blocks, solve, nothing)
