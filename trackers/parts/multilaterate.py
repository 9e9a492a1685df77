"""The place that fits all ranges of an epoch best, over the floor or in space, outliers down-weighted."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from trackers.core.algebra import Scalar

ROUNDS = 20
"""Steps of the search; with weights that change from step to step it nears the place by a factor each time."""


FLAT = 0.02
"""Least information of the worst-seen horizontal direction per range, 0 … 1/2, with which a place is determined."""


LEAST = 1e-3
"""Information per metre² and unit weight added to every direction, so that those the ranges don't see stay finite."""


class Place(eqx.Module):
    """A place found: where (n,), m; its misfit Σ log(1 + (r/scale)²); the inverse information there (n, n), of ranges
    with unit variance; and whether the ranges determine it.
    """

    position: Any
    misfit: Scalar
    spread: Any
    determined: Scalar


def multilaterate(ranges: Any, anchors: Any, counts: Any, height: Scalar | None, scale: Scalar) -> Place:
    """The place with the least misfit to ranges (S,), m, from anchors (S, 3), m, of those that count (S,).

    Gauss–Newton on Cauchy's loss, each range weighted by 1/(1 + (r/scale)²), with `scale` m at least the middle misfit
    (Huber and Ronchetti 2009, section 7.8). From the anchors' middle; in space from below and above it, since anchors
    in one plane leave two mirror images, of which the better one is taken. A known `height` m leaves x and y.
    """
    counts = jnp.where(counts, jnp.ones_like(ranges), 0.0)
    many = jnp.maximum(jnp.sum(counts), 1.0)
    middle = jnp.sum(counts[:, None] * anchors, axis=0) / many
    if height is not None:
        return _descent(ranges, anchors, counts, middle[:2], height, scale)
    width = jnp.sqrt(jnp.sum(counts[:, None] * (anchors - middle[None, :])[:, :2] ** 2) / many)
    up = jnp.stack([width * 0.0, width * 0.0, width])
    below, above = (_descent(ranges, anchors, counts, middle + s * up, None, scale) for s in (-1.0, 1.0))
    return jax.tree_util.tree_map(lambda a, b: jnp.where(below.misfit <= above.misfit, a, b), below, above)


def _descent(ranges: Any, anchors: Any, counts: Any, start: Any, height: Scalar | None, scale: Scalar) -> Place:
    n = start.shape[0]
    many = jnp.sum(counts)
    ridge = LEAST * jnp.eye(n, dtype=start.dtype)

    def seen_from(position: Any) -> tuple[Any, Any, Any]:
        away = (position if height is None else jnp.append(position, height))[None, :] - anchors
        distance = jnp.sqrt(jnp.maximum(jnp.sum(away * away, axis=1), 1e-12))
        return counts * (ranges - distance), away[:, :n] / distance[:, None], distance

    def information(weight: Any, slope: Any) -> Any:
        return jnp.sum(weight[:, None, None] * slope[:, :, None] * slope[:, None, :], axis=0)

    def step(position: Any, _: None) -> tuple[Any, None]:
        misfit, slope, distance = seen_from(position)
        weight = counts / (1.0 + (misfit / jnp.maximum(1.5 * middle_of(jnp.abs(misfit), counts), scale)) ** 2)
        pull = jnp.sum((weight * misfit)[:, None] * slope, axis=0)
        move = jnp.sum(inverse(information(weight, slope) + ridge) * pull[None, :], axis=1)
        # No step further than the anchors are away: a range is bent, and no line, beyond.
        reach = jnp.maximum(jnp.sum(counts * distance) / jnp.maximum(many, 1.0), 1e-6)
        return position + move / jnp.maximum(jnp.sqrt(jnp.sum(move * move)) / reach, 1.0), None

    position = jax.lax.scan(step, start, None, length=ROUNDS)[0]
    misfit, slope, _ = seen_from(position)
    weight = counts / (1.0 + (misfit / scale) ** 2)
    (a, b), (_, c) = information(counts, slope[:, :2])
    # The least eigenvalue of the horizontal information per range.
    least = 0.5 * (a + c - jnp.sqrt((a - c) ** 2 + 4.0 * b * b)) / jnp.maximum(many, 1.0)
    determined = (many > n) & (least > FLAT) & jnp.all(jnp.isfinite(position))
    return Place(
        position,
        jnp.sum(jnp.log1p((misfit / scale) ** 2)),
        inverse(information(weight, slope) + ridge),
        determined,
    )


def middle_of(values: Any, counts: Any) -> Scalar:
    """The median of the values (S,) that count, the lower middle of an even number; 0 for none."""
    ordered = jnp.sort(jnp.where(counts > 0, values, jnp.inf))
    place = (jnp.sum(counts > 0) - 1) // 2
    return jnp.sum(jnp.where(jnp.arange(ordered.shape[0]) == place, ordered, 0.0))


def inverse(matrix: Any) -> Any:
    """The inverse of a symmetric 2 × 2 or 3 × 3 matrix by Cramer's rule: batched LAPACK calls can deadlock."""
    if matrix.shape[0] == 2:
        (a, b), (_, c) = matrix
        return jnp.stack([jnp.stack([c, -b]), jnp.stack([-b, a])]) / (a * c - b * b)
    a, b, c = matrix
    rows = [jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)]
    return jnp.stack(rows, axis=1) / jnp.sum(a * rows[0])
