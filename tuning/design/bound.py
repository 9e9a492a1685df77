"""The Cramér–Rao bound of one epoch over a volume, as a differentiable function of the sensors' positions.

An epoch is one reading of every sensor. Its information about the position p is Σ HᵀH over the sensors, with H the
Jacobian of the whitened residual, by automatic differentiation of the sensors' own `measure` and `residual`. No
unbiased estimate from one epoch has a root mean square error below the root of tr (Σ HᵀH)⁻¹.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.core.model.algebra import Scalar, Vector
from trackwright.trackers.core.model.motion import Kinematic
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading

Points = Float[Array | np.ndarray, "k d"]


class SensorAtEpoch(NamedTuple):
    """A sensor with its number of `channels`, the inputs of its row, and the noise that the device reports."""

    sensor: AbstractSensor
    inputs: Mapping[str, Array]
    channels: int
    reported: tuple[float, ...] = ()


def information(sensors: Sequence[SensorAtEpoch], position: Float[Array, " d"]) -> Float[Array, "d d"]:
    """Fisher's information (d, d), 1/m², of one epoch about `position` (d,), m, with all channels seen.

    d is 2 where the inputs hold the `height`.
    """
    total = jnp.zeros((len(position), len(position)), position.dtype)
    for noise, alike in _by_kind(sensors):

        def of_look(look: tuple[AbstractSensor, Mapping[str, Array]], noise: Any = noise) -> Float[Array, "d d"]:
            return _of_sensor(SensorAtEpoch(*look, *noise), position)

        total = total + jnp.sum(jax.vmap(of_look)(alike), axis=0)
    return total


def _by_kind(sensors: Sequence[SensorAtEpoch]) -> Iterator[tuple[Any, Any]]:
    """Sensors of one kind with their inputs, stacked for one compiled function; first their channels and noise."""
    kinds = defaultdict(list)
    for sensor, inputs, channels, reported in sensors:
        leaves, tree = jax.tree_util.tree_flatten((sensor, inputs))
        kinds[(channels, reported), tree, tuple(jnp.shape(x) for x in leaves)].append(leaves)
    for (noise, tree, _), members in kinds.items():
        yield noise, jax.tree_util.tree_unflatten(tree, [jnp.stack(parts) for parts in zip(*members, strict=True)])


def _of_sensor(look: SensorAtEpoch, position: Float[Array, " d"]) -> Float[Array, "d d"]:
    sensor, inputs, channels, reported = look

    def predicted(p: Float[Array, " d"]) -> list[Scalar]:
        return list(sensor.measure(Kinematic(Vector(*p), Vector(*(jnp.zeros_like(x) for x in p))), inputs))

    # The noise-free reading is a constant: it does not depend on the assumed position.
    exact = Reading(jax.lax.stop_gradient(predicted(position)), [jnp.asarray(True)] * channels, reported)

    def residual_at(p: Float[Array, " d"]) -> tuple[Float[Array, " m"], Scalar | None]:
        residual = sensor.residual(exact, predicted(p))
        return jnp.stack(residual.whitened), residual.dof

    H, dof = jax.jacfwd(residual_at, has_aux=True)(position)
    # Fisher's information of Student's t is (ν + 1)/(ν + 3) of the normal's.
    return (1.0 if dof is None else (dof + 1.0) / (dof + 3.0)) * (H.T @ H)


def variance(J: Float[Array, "d d"]) -> Float[Array, ""]:
    """tr J⁻¹ of an information (2, 2) or (3, 3), by Cramer's rule: batched LAPACK calls can deadlock on few cores."""
    if len(J) == 2:
        return (J[0, 0] + J[1, 1]) / (J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0])
    a, b, c = J
    by_a, by_b, by_c = jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)
    return (by_a[0] + by_b[1] + by_c[2]) / (a @ by_a)


def bounds(sensors: Sequence[SensorAtEpoch], points: Points) -> Float[Array, " k"]:
    """The bound (k,), m, of the root mean square position error at each of the points (k, d)."""
    variances = jax.vmap(lambda p: variance(information(sensors, p)))(points)
    # Rounding can make the variance negative where a direction is undetermined; the bound is unlimited there.
    return jnp.sqrt(jnp.where(variances > 0, variances, 1e12))


def mean_bound(sensors: Sequence[SensorAtEpoch], points: Points) -> Float[Array, ""]:
    """The root mean square of the bounds over the points, m: for tags anywhere in the volume."""
    return jnp.sqrt(jnp.mean(bounds(sensors, points) ** 2))
