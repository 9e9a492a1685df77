"""States of the hidden Markov model: a discretised distribution of accelerations (Huang et al. 2018, section 2.2).

    α  elevation, γ = 10°      k  magnitude of the acceleration      0 ≤ a_lm < a_max      N = 18·36·10 + 18·36 + 1

Below a_lm there is one state, "no acceleration", with probability P₀. At a_max there is one state per direction, with
probability P_max in total. Between them the density is uniform (5), over 10 layers of equal volume with 18 elevations
and 36 azimuths each.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

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
