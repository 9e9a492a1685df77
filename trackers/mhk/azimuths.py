"""The posterior mean of the acceleration for a chain without memory, ring by ring instead of state by state.

The states of a ring, one layer and elevation, differ in their azimuth alone, and their log-likelihoods by a cosine of
it. Over AZIMUTHS equally spaced azimuths a sum of exp(κ cos φ) is AZIMUTHS·I₀(κ), and of cos φ exp(κ cos φ) it is
AZIMUTHS·I₁(κ), but for modified Bessel functions of order AZIMUTHS and above, which are below rounding up to a known κ
(Abramowitz and Stegun 1964, 9.6.34); beyond it the terms are summed.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.scipy.special import i0e, i1e

from trackwright.trackers.core.model.algebra import Scalar, Vector, compute_once, inverse_or_zero
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.mhk.accelerations import AZIMUTHS, Rings

LIMITS = {4: 36.0, 8: 12.0}
"""Largest κ, by the bytes of a number, with I₃₆(κ) < ε·I₀(κ)."""


def mean_acceleration(rings: Rings, displacement: Vector, half_square: Scalar, precision: Scalar) -> Vector:
    """The posterior mean, m/s², of an acceleration a given a displacement, m, of ½ Δt²·a plus noise.

    `half_square`: ½ Δt², s². `precision`: the inverse variance of the noise, m⁻².
    """
    gx, gy, gz = displacement * (precision * half_square)
    # A factor that cancels; without its derivative, which the root lacks at zero.
    scale = jax.lax.stop_gradient(jnp.sqrt(gx * gx + gy * gy))
    level, up = rings.level, rings.up
    whole, along_x, along_y = ring_sums(level, gx, gy, scale)
    exponents = level * scale - 0.5 * precision * half_square * half_square * (level * level + up * up)
    lift = up * gz
    top = jax.lax.stop_gradient(jnp.maximum(jnp.max(exponents + jnp.abs(lift)), 0.0))
    above, below = (rings.probabilities * jnp.exp(exponents + s * lift - top) for s in (1.0, -1.0))
    both = above + below
    evidence = jnp.sum(both * whole) + rings.still * jnp.exp(-top)
    sums = jnp.sum(both * level * along_x), jnp.sum(both * level * along_y), jnp.sum((above - below) * up * whole)
    return Vector.of(s / jnp.maximum(evidence, jnp.finfo(evidence.dtype).tiny) for s in sums)


@jax.custom_jvp
def ring_sums(level: AnyArray, gx: Scalar, gy: Scalar, scale: Scalar) -> tuple[Any, Any, Any]:
    """The sums over azimuths φ of e, cos φ·e and sin φ·e, (R,) each, with e = exp(level (gx cos φ + gy sin φ − scale)).

    `level`: (R,). `scale`: the root of gx² + gy².
    """
    kappa = level * scale
    limit = LIMITS[kappa.dtype.itemsize]
    exact = summed_where_needed(jnp.max(kappa) > limit, level, gx, gy, scale)
    along = AZIMUTHS * i1e(kappa) * inverse_or_zero(scale)
    smooth = AZIMUTHS * i0e(kappa), along * gx, along * gy
    whole, along_x, along_y = (jnp.where(kappa > limit, a, b) for a, b in zip(exact, smooth, strict=True))
    return whole, along_x, along_y


@ring_sums.defjvp
def _summed_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    return ring_sums(*primals), jax.jvp(summed, primals, tangents)[1]


def summed(level: AnyArray, gx: Scalar, gy: Scalar, scale: Scalar) -> tuple[Any, Any, Any]:
    """`ring_sums` term by term; opposite azimuths together."""
    whole = along_x = along_y = jnp.zeros_like(level * scale)
    for angle in (np.arange(AZIMUTHS // 2) + 0.5) * (2 * np.pi / AZIMUTHS):
        cosine, sine = float(np.cos(angle)), float(np.sin(angle))
        towards = gx * cosine + gy * sine
        near, far = jnp.exp(level * (towards - scale)), jnp.exp(-level * (towards + scale))
        whole, along_x, along_y = whole + (near + far), along_x + cosine * (near - far), along_y + sine * (near - far)
    return compute_once((whole, along_x, along_y))


@custom_vmap
def summed_where_needed(needed: Scalar, level: AnyArray, gx: Scalar, gy: Scalar, scale: Scalar) -> tuple[Any, Any, Any]:
    """`summed` where needed; elsewhere unspecified."""
    zero = jnp.zeros_like(level * scale)
    return jax.lax.cond(needed, lambda: summed(level, gx, gy, scale), lambda: (zero,) * 3)


@summed_where_needed.def_vmap
def _in_trajectories(size: int, batched: Any, needed: Any, *numbers: Any) -> tuple[Any, Any]:
    """Sums for all trajectories if any of them needs it; `vmap` of the condition would always sum."""
    axes = tuple(0 if has else None for has in batched[1:])
    every = jax.vmap(summed, in_axes=axes, axis_size=size)
    shapes = jax.eval_shape(every, *numbers)
    zeros = tuple(jnp.zeros(s.shape, s.dtype) for s in shapes)
    return jax.lax.cond(jnp.any(needed), lambda: every(*numbers), lambda: zeros), (True,) * 3
