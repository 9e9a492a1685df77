"""The maximum of a delay-and-sum spectrum without computing all of it: a coarse grid, then the best blocks.

The magnitude f of the spectrum is the modulus of a sum of unit phasors, so that from its maximum on the grid it falls
by at most

    f(u*) − f(u) ≤ ½ Σ_m (2 (a_m² + b_m²) + (2 a_m + 2 b_m)²)

up to two grid steps away along each axis, where a_m and b_m are the phase changes of antenna m, about their mean over
the antennas, in one step of either axis. A block whose centre is lower than the maximum so far by more than this bound
cannot contain a larger value. Rows in which more than `BLOCKS` blocks remain are searched in full.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from trackwright.trackers.core.model.algebra import product
from trackwright.trackers.core.model.covariance import side_by_side
from trackwright.trackers.core.model.inputs import AnyArray

REACH = 2
"""Grid steps from the centre of a block to its edge."""

BLOCKS = 16
"""Blocks searched in every row."""

IN_FULL_AT_ONCE = 4
"""Rows searched in full together."""

IN_FULL_AT_MOST = 256
"""On a GPU, where each takes half a megabyte."""

MARGIN = 1.1
"""Factor of the bound, since phases are not quite linear in the angles."""


class Blocks(eqx.Module):
    """Blocks of a square grid of directions: the responses at their centres, `cosine`, `sine` (n, blocks).

    `index` (blocks, size): the indices of each block's directions in the grid. `fall` (n,): the share of each antenna
    in the bound.
    """

    cosine: AnyArray
    sine: AnyArray
    index: AnyArray
    fall: AnyArray

    @classmethod
    def of(cls, cosine: np.ndarray, sine: np.ndarray) -> Blocks | None:
        """The blocks of a square grid of directions; None where it is too small to gain from them."""
        n, directions = cosine.shape
        side, width = round(directions**0.5), 2 * REACH + 1
        centres = np.unique(np.round(np.linspace(0, side - 1, -(-(side - 1) // width) + 1)).astype(int))
        if len(centres) ** 2 < 4 * BLOCKS:
            return None
        around = np.clip(centres[:, None] + np.arange(-REACH, REACH + 1), 0, side - 1)
        index = around[:, None, :, None] * side + around[None, :, None, :]
        middle = (centres[:, None] * side + centres[None, :]).ravel()
        phasors = (cosine + 1j * sine).reshape(n, side, side)
        steps = (phasors[:, 1:] * phasors[:, :-1].conj(), phasors[:, :, 1:] * phasors[:, :, :-1].conj())
        a, b = (np.abs(s - s.mean(axis=0)).max(axis=(1, 2)) for s in map(np.angle, steps))
        fall = MARGIN * 0.5 * (REACH * (a**2 + b**2) + (REACH * a + REACH * b) ** 2)
        return cls(cosine[:, middle], sine[:, middle], index.reshape(-1, width * width).astype(np.int32), fall)


def power(c: jax.Array, s: jax.Array, cosine: AnyArray, sine: AnyArray) -> jax.Array:
    """|Σ (c + i s)(cosine − i sine)|², (…, G), of weighted phasors (…, n) and responses (n, G)."""
    real = product(c, cosine) + product(s, sine)
    imaginary = product(s, cosine) - product(c, sine)
    return real * real + imaginary * imaginary


@custom_vmap
def strongest_index(cosine: AnyArray, sine: AnyArray, blocks: Blocks, phases: AnyArray, seen: AnyArray) -> jax.Array:
    """The index of the direction of largest power, the first of equal ones, for one row of phases and masks (n,)."""
    return _rows(cosine, sine, blocks, phases[None], seen[None])[0]


@strongest_index.def_vmap
def _in_rows(
    size: int, batched: Any, cosine: AnyArray, sine: AnyArray, blocks: Any, phases: AnyArray, seen: AnyArray
) -> tuple[Any, Any]:
    if any(jax.tree_util.tree_leaves(batched[:3])):
        raise ValueError("the grid of a beamformer is mapped over; expected one grid for all trajectories")
    rows = (
        x if has else jnp.broadcast_to(x, (size, *x.shape)) for x, has in zip((phases, seen), batched[3:], strict=True)
    )
    return _rows(cosine, sine, blocks, *rows), True


def _rows(cosine: AnyArray, sine: AnyArray, blocks: Blocks, phases: AnyArray, seen: AnyArray) -> jax.Array:
    """The indices (B,) of the strongest directions for rows of phases and masks (B, n)."""
    weight = jnp.where(seen, 1.0, 0.0).astype(phases.dtype)
    c, s = weight * jnp.cos(phases), weight * jnp.sin(phases)
    centres, chosen = jax.lax.top_k(power(c, s, blocks.cosine, blocks.sine), BLOCKS)
    numbers = jnp.asarray(blocks.index).at[chosen].get(mode="promise_in_bounds")
    real, imaginary = jnp.zeros_like(c[:, :1, None]), jnp.zeros_like(c[:, :1, None])
    for m in range(phases.shape[-1]):
        # One antenna at a time: gathers and sums of products in one pass over memory.
        cos, sin = (jnp.asarray(x)[m].at[numbers].get(mode="promise_in_bounds") for x in (cosine, sine))
        c_m, s_m = c[:, m, None, None], s[:, m, None, None]
        real, imaginary = real + c_m * cos + s_m * sin, imaginary + s_m * cos - c_m * sin
    inside = real * real + imaginary * imaginary
    best = jnp.max(inside, axis=(1, 2))
    strongest = jnp.min(jnp.where(inside == best[:, None, None], numbers, cosine.shape[1]), axis=(1, 2))
    # A minimum, not the last of `centres`: for a slice XLA (jaxlib 0.10) sorts all blocks, at ten times the other
    # costs.
    fall = product(weight, jnp.asarray(blocks.fall, weight.dtype))
    unsure = jnp.sqrt(jnp.min(centres, axis=1)) >= jnp.sqrt(best) - fall
    # Rows without a phase, as in padding, have the first direction anyway.
    unsure = unsure & jnp.any(seen, axis=1)
    size = len(phases)
    n_at_once = side_by_side(IN_FULL_AT_ONCE, min(IN_FULL_AT_MOST, size))

    def some(state: tuple[Any, Any]) -> tuple[Any, Any]:
        unsure, strongest = state
        rows = jnp.nonzero(unsure, size=n_at_once, fill_value=size)[0]
        c_rows, s_rows = (jnp.take(x, rows, axis=0, mode="clip") for x in (c, s))
        full = jnp.argmax(power(c_rows, s_rows, cosine, sine), axis=-1).astype(strongest.dtype)
        return unsure.at[rows].set(False, mode="drop"), strongest.at[rows].set(full, mode="drop")

    return jax.lax.while_loop(lambda state: jnp.any(state[0]), some, (unsure, strongest))[1]
