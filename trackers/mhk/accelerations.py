"""States of the hidden Markov model: a discretised distribution of accelerations (Huang et al. 2018, section 2.2).

    α  elevation, γ = 10°      k  magnitude of the acceleration      0 ≤ a_lm < a_max      N = 18·36·10 + 18·36 + 1

Below a_lm there is one state, "no acceleration", with probability P₀. At a_max there is one state per direction, with
probability P_max in total. Between them the density is uniform (5), over 10 layers of equal volume with 18 elevations
and 36 azimuths each.

The posterior mean of a chain without memory is computed ring by ring instead of state by state. The states of a ring,
one layer and elevation, differ in their azimuth alone, and their log-likelihoods by a cosine of it. Over AZIMUTHS
equally spaced azimuths a sum of exp(κ cos φ) is AZIMUTHS·I₀(κ), and of cos φ exp(κ cos φ) it is AZIMUTHS·I₁(κ), but for
modified Bessel functions of order AZIMUTHS and above, which are below rounding up to a known κ (Abramowitz and Stegun
1964, 9.6.34); beyond it the terms are summed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.scipy.special import i0e, i1e

from trackwright.trackers.core.model.algebra import Scalar, Vector, compute_once, inverse_or_zero
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.core.model.motion import Noise
from trackwright.trackers.core.model.tunable import Fraction, Scale

ELEVATIONS, AZIMUTHS, LAYERS = 18, 36, 10


class Blocks(NamedTuple):
    """The states: accelerations (N, 3), m/s², and their stationary probabilities (N,)."""

    accelerations: jax.Array
    probabilities: jax.Array


class Rings(NamedTuple):
    """The states in rings of one layer and elevation above the horizon, each with its mirror image below.

    `level`, `up` (R,), m/s²: the accelerations' horizontal and vertical magnitude. `probabilities` (R,): of one state.
    `still`: the probability of no acceleration.
    """

    level: jax.Array
    up: jax.Array
    probabilities: jax.Array
    still: jax.Array


class AccelerationSphere(eqx.Module):
    """The distribution of accelerations, equations (5)–(7).

    `a_still`: a_lm, m/s². `a_full`: a_max − a_lm, m/s². `p_still`: P₀. `p_full`: P_max, given that there is an
    acceleration.
    """

    a_still: Noise
    a_full: Noise
    p_still: Noise
    p_full: Noise

    def __init__(self, a_still: float = 0.1, a_full: float = 1.9, p_still: float = 0.6, p_full: float = 0.1):
        self.a_still, self.a_full = Scale(a_still, "m/s^2"), Scale(a_full, "m/s^2")
        self.p_still, self.p_full = Fraction(p_still), Fraction(p_full)

    def blocks(self) -> Blocks:
        """All N states: the layers from the inside out, the shell at a_max, "no acceleration" last."""
        magnitudes, shares = self._magnitudes()
        means, solid = directions()
        centres, angles = (jnp.asarray(x, magnitudes.dtype) for x in (means, solid / (4 * np.pi)))
        accelerations = (magnitudes[:, None, None] * centres[None]).reshape(-1, 3)
        probabilities = (shares[:, None] * angles[None]).reshape(-1)
        return Blocks(
            jnp.concatenate([accelerations, jnp.zeros((1, 3), magnitudes.dtype)]),
            jnp.concatenate([probabilities, self.p_still.value.reshape(1)]),
        )

    def rings(self) -> Rings:
        """The same states in rings."""
        magnitudes, shares = self._magnitudes()
        means, solid = directions()
        first = slice(ELEVATIONS // 2 * AZIMUTHS, None, AZIMUTHS)
        level, up, angle = np.hypot(*means[first, :2].T), means[first, 2], solid[first] / (4 * np.pi)

        def each(values: jax.Array, by: np.ndarray) -> jax.Array:
            return (values[:, None] * jnp.asarray(by, values.dtype)[None]).reshape(-1)

        return Rings(each(magnitudes, level), each(magnitudes, up), each(shares, angle), self.p_still.value)

    def _magnitudes(self) -> tuple[jax.Array, jax.Array]:
        """The magnitudes of the layers and of the shell (LAYERS + 1,), m/s², and their probabilities."""
        inner, outer = self.a_still.value, self.a_still.value + self.a_full.value
        k = layers(inner, outer)
        # The centroid of a block is its mean magnitude times its mean direction; their total mean is zero.
        magnitudes = 0.75 * (k[1:] ** 4 - k[:-1] ** 4) / (k[1:] ** 3 - k[:-1] ** 3)
        moving = 1.0 - self.p_still.value
        full = moving * self.p_full.value
        volumes = (k[1:] ** 3 - k[:-1] ** 3) / (outer**3 - inner**3)
        shares = [(moving - full) * volumes, full.reshape(1)]
        return jnp.concatenate([magnitudes, outer.reshape(1)]), jnp.concatenate(shares)


def layers(inner: jax.Array, outer: jax.Array) -> jax.Array:
    """The radii (LAYERS + 1,), m/s², that divide the space between two spheres into layers of equal volume."""
    fraction = jnp.arange(LAYERS + 1) / LAYERS
    return jnp.cbrt(inner**3 + fraction.astype(inner.dtype) * (outer**3 - inner**3))


def directions() -> tuple[np.ndarray, np.ndarray]:
    """The mean of the unit vectors (648, 3) of each directional block, and its solid angle (648,), sr.

    Equation (6) takes the difference of the sines at both ends of an elevation. With the paper's rotation by 2π each
    ring would count twice, so α runs from −90° to 90° and the ring is divided into azimuths.
    """
    ends = np.deg2rad(np.linspace(-90.0, 90.0, ELEVATIONS + 1))
    low, high, step = ends[:-1], ends[1:], 2 * np.pi / AZIMUTHS
    height = np.sin(high) - np.sin(low)
    up = 0.5 * (np.sin(high) + np.sin(low))
    level = (0.5 * (high - low) + 0.25 * (np.sin(2 * high) - np.sin(2 * low))) / height
    level = level * np.sin(step / 2) / (step / 2)
    azimuths = (np.arange(AZIMUTHS) + 0.5) * step
    parts = [level[:, None] * np.cos(azimuths), level[:, None] * np.sin(azimuths), np.tile(up[:, None], (1, AZIMUTHS))]
    return np.stack(parts, axis=-1).reshape(-1, 3), np.repeat(height * step, AZIMUTHS)


LIMITS = {4: 36.0, 8: 12.0}  # largest κ, by the bytes of a number, with I₃₆(κ) < ε·I₀(κ)


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
