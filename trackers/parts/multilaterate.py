"""Multilateration: the robust least-squares position from the ranges of one epoch, planar or in three dimensions."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from trackers.core.algebra import Scalar

ITERATIONS = 20
"""Gauss–Newton steps; with weights that change at every step, convergence is linear."""

MIN_INFORMATION = 0.02
"""Smallest eigenvalue of the horizontal information matrix, per range (0 … ½), with which a position is determined."""

RIDGE = 1e-3
"""Information, m⁻² at unit weight, added to every direction, so that unobservable ones stay finite."""


class PositionFit(eqx.Module):
    """A least-squares position: `position` (n,), m; `cost` Σ log(1 + (r/scale)²) of the residuals r.

    `covariance` (n, n): inverse information of ranges with unit variance. `determined`: whether the ranges determine
    the position.
    """

    position: Any
    cost: Scalar
    covariance: Any
    determined: Scalar


def multilaterate(ranges: Any, anchors: Any, counts: Any, height: Scalar | None, scale: Scalar) -> PositionFit:
    """The position of least cost for ranges (S,), m, to anchors (S, 3), m, where `counts` (S,) is true.

    Gauss–Newton on the Cauchy loss, each range weighted by 1/(1 + (r/scale)²), with `scale` m at least 1.5 times the
    median residual (Huber and Ronchetti 2009, section 7.8). It starts at the anchors' centroid; in three dimensions
    below and above it, and keeps the fit of lower cost, since coplanar anchors leave two mirror images. With a known
    `height`, m, only x and y are estimated.
    """
    counts = jnp.where(counts, jnp.ones_like(ranges), 0.0)
    number = jnp.maximum(jnp.sum(counts), 1.0)
    centroid = jnp.sum(counts[:, None] * anchors, axis=0) / number
    if height is not None:
        return _gauss_newton(ranges, anchors, counts, centroid[:2], height, scale)
    width = jnp.sqrt(jnp.sum(counts[:, None] * (anchors - centroid[None, :])[:, :2] ** 2) / number)
    up = jnp.stack([width * 0.0, width * 0.0, width])
    below, above = (_gauss_newton(ranges, anchors, counts, centroid + s * up, None, scale) for s in (-1.0, 1.0))
    return jax.tree_util.tree_map(lambda a, b: jnp.where(below.cost <= above.cost, a, b), below, above)


def _gauss_newton(
    ranges: Any, anchors: Any, counts: Any, start: Any, height: Scalar | None, scale: Scalar
) -> PositionFit:
    n = start.shape[0]
    number = jnp.sum(counts)
    ridge = RIDGE * jnp.eye(n, dtype=start.dtype)

    def linearised(position: Any) -> tuple[Any, Any, Any]:
        """Residuals (S,), Jacobian (S, n) and predicted ranges (S,)."""
        offset = (position if height is None else jnp.append(position, height))[None, :] - anchors
        distance = jnp.sqrt(jnp.maximum(jnp.sum(offset * offset, axis=1), 1e-12))
        return counts * (ranges - distance), offset[:, :n] / distance[:, None], distance

    def information(weight: Any, jacobian: Any) -> Any:
        return jnp.sum(weight[:, None, None] * jacobian[:, :, None] * jacobian[:, None, :], axis=0)

    def step(position: Any, _: None) -> tuple[Any, None]:
        residual, jacobian, distance = linearised(position)
        weight = counts / (1.0 + (residual / jnp.maximum(1.5 * lower_median(jnp.abs(residual), counts), scale)) ** 2)
        gradient = jnp.sum((weight * residual)[:, None] * jacobian, axis=0)
        move = jnp.sum(inverse(information(weight, jacobian) + ridge) * gradient[None, :], axis=1)
        # No step is longer than the mean distance to the anchors: beyond it the linearisation does not hold.
        longest = jnp.maximum(jnp.sum(counts * distance) / jnp.maximum(number, 1.0), 1e-6)
        return position + move / jnp.maximum(jnp.sqrt(jnp.sum(move * move)) / longest, 1.0), None

    position = jax.lax.scan(step, start, None, length=ITERATIONS)[0]
    residual, jacobian, _ = linearised(position)
    weight = counts / (1.0 + (residual / scale) ** 2)
    (a, b), (_, c) = information(counts, jacobian[:, :2])
    smallest = 0.5 * (a + c - jnp.sqrt((a - c) ** 2 + 4.0 * b * b)) / jnp.maximum(number, 1.0)
    determined = (number > n) & (smallest > MIN_INFORMATION) & jnp.all(jnp.isfinite(position))
    return PositionFit(
        position,
        jnp.sum(jnp.log1p((residual / scale) ** 2)),
        inverse(information(weight, jacobian) + ridge),
        determined,
    )


def lower_median(values: Any, counts: Any) -> Scalar:
    """The median of the values (S,) where `counts` (S,) > 0, the lower one of an even number; 0 for none."""
    ordered = jnp.sort(jnp.where(counts > 0, values, jnp.inf))
    index = (jnp.sum(counts > 0) - 1) // 2
    return jnp.sum(jnp.where(jnp.arange(ordered.shape[0]) == index, ordered, 0.0))


def inverse(matrix: Any) -> Any:
    """The inverse of a symmetric 2 × 2 or 3 × 3 matrix by Cramer's rule: batched LAPACK calls can deadlock."""
    if matrix.shape[0] == 2:
        (a, b), (_, c) = matrix
        return jnp.stack([jnp.stack([c, -b]), jnp.stack([-b, a])]) / (a * c - b * b)
    a, b, c = matrix
    rows = [jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)]
    return jnp.stack(rows, axis=1) / jnp.sum(a * rows[0])
