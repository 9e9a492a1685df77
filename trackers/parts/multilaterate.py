"""Multilateration: the robust least-squares position from the ranges of one epoch, planar or in three dimensions."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from trackwright.trackers.core.model.algebra import Scalar, Vector, total
from trackwright.trackers.core.model.inputs import AnyArray

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
    return jnp.max(jnp.where((smaller <= index) & (index < not_larger) & (counts > 0), kept, 0.0))


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
