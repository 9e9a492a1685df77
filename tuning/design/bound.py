"""The Cramér–Rao bound of one epoch over a volume, as a differentiable function of where sensors stand.

An epoch is one reading of every sensor. Its information about the position p is Σ HᵀH over the sensors, H the Jacobian
of the whitened residual, by automatic differentiation of the sensors' own `measure` and `residual`: whatever tracks a
tag can be laid out. No tracker without memory has a root mean square error below the root of tr (Σ HᵀH)⁻¹.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from trackers.core.algebra import Vector
from trackers.core.motion import Kinematic
from trackers.core.sensor import AbstractSensor, Reading


class Look(NamedTuple):
    """A sensor with so many `channels`, and the inputs of the row in which it reads."""

    sensor: AbstractSensor
    inputs: Mapping[str, Any]
    channels: int


def information(looks: Sequence[Look], position: Any) -> Any:
    """Fisher's information (d, d), 1/m², of one epoch about `position` (d,), m.

    Of two coordinates where the inputs hold the `height`. Every channel counts as seen.
    """
    total = jnp.zeros((len(position), len(position)), position.dtype)
    for channels, alike in _alike(looks):

        def one(look: Any, channels: int = channels) -> Any:
            return _of_one(Look(look[0], look[1], channels), position)

        total = total + jnp.sum(jax.vmap(one)(alike), axis=0)
    return total


def _alike(looks: Sequence[Look]) -> Iterator[tuple[int, Any]]:
    """Sensors of one kind with their inputs, stacked: a program for one of them serves all."""
    kinds = defaultdict(list)
    for sensor, inputs, channels in looks:
        leaves, tree = jax.tree_util.tree_flatten((sensor, inputs))
        kinds[channels, tree, tuple(jnp.shape(x) for x in leaves)].append(leaves)
    for (channels, tree, _), members in kinds.items():
        yield channels, jax.tree_util.tree_unflatten(tree, [jnp.stack(parts) for parts in zip(*members, strict=True)])


def _of_one(look: Look, position: Any) -> Any:
    sensor, inputs, channels = look

    def predicted(p: Any) -> Sequence[Any]:
        return list(sensor.measure(Kinematic(Vector(*p), Vector(*(jnp.zeros_like(x) for x in p))), inputs))

    # What the sensor would read without noise; it is no function of where one thinks the tag is.
    exact = Reading(jax.lax.stop_gradient(predicted(position)), [jnp.asarray(True)] * channels)

    def misfit(p: Any) -> tuple[Any, Any]:
        residual = sensor.residual(exact, predicted(p))
        return jnp.stack(residual.whitened), residual.dof

    H, dof = jax.jacfwd(misfit, has_aux=True)(position)
    # Fisher's information of Student's t is (ν + 1)/(ν + 3) of the normal's.
    return (1.0 if dof is None else (dof + 1.0) / (dof + 3.0)) * (H.T @ H)


def variance(J: Any) -> Any:
    """tr J⁻¹ of an information (2, 2) or (3, 3), by Cramer's rule: batched LAPACK calls can deadlock on few cores."""
    if len(J) == 2:
        return (J[0, 0] + J[1, 1]) / (J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0])
    a, b, c = J
    by_a, by_b, by_c = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
    return (by_a[0] + by_b[1] + by_c[2]) / (a @ by_a)


def bounds(looks: Sequence[Look], points: Any) -> Any:
    """The bound (k,), m, at each of the points (k, d): of the root mean square of the position's error."""
    variances = jax.vmap(lambda p: variance(information(looks, p)))(points)
    # Where the sensors leave a direction open rounding makes the variance negative: no bound there is too large.
    return jnp.sqrt(jnp.where(variances > 0, variances, 1e12))


def mean_bound(looks: Sequence[Look], points: Any) -> Any:
    """The root mean square of the bounds over the points, m: of the error of tags anywhere in the volume."""
    return jnp.sqrt(jnp.mean(bounds(looks, points) ** 2))


def worst_bound(looks: Sequence[Look], points: Any) -> Any:
    """The largest of the bounds over the points, m, as their mean of power 24: smooth, so that a descent has a slope.

    Of k points where one is the worst it is too small by a factor of k to the 1/24 at most.
    """
    each = bounds(looks, points)
    largest = jax.lax.stop_gradient(jnp.max(each))
    return largest * jnp.mean((each / largest) ** 24) ** (1 / 24)
