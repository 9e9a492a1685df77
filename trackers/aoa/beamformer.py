"""The beamformer delay-and-sum over a grid of directions, batched over rows.

It uses phases only, with equal weights of the antennas, and one row at a time: the baseline of the beam tracker and its
start (Will et al. 2020, section 4).

The maximum of a spectrum is found without computing all of it: by a coarse grid, then the best blocks. The magnitude f
of the spectrum is the modulus of a sum of unit phasors, so that from its maximum on the grid it falls by at most

    f(u*) − f(u) ≤ ½ Σ_m (2 (a_m² + b_m²) + (2 a_m + 2 b_m)²)

up to two grid steps away along each axis, where a_m and b_m are the phase changes of antenna m, about their mean over
the antennas, in one step of either axis. A block whose centre is lower than the maximum so far by more than this bound
cannot contain a larger value. Rows in which more than `BLOCKS` blocks remain are searched in full.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from trackwright.trackers.aoa.phases import array_of
from trackwright.trackers.core.model.algebra import product
from trackwright.trackers.core.model.covariance import side_by_side
from trackwright.trackers.core.model.inputs import AnyArray
from trackwright.trackers.core.model.rig import Station


class Grid(eqx.Module):
    """Directions and the array's response to each: `angles` (G, 2) azimuth and elevation, `cosine`, `sine` (n, G).

    `blocks`: of neighbouring directions, None for a grid that is searched in full.
    """

    angles: AnyArray
    cosine: AnyArray
    sine: AnyArray
    blocks: Blocks | None

    @classmethod
    def of(cls, station: Station, span: float = np.deg2rad(30.0), resolution: float = np.deg2rad(0.6)) -> Grid:
        """All directions within ± `span` in both angles (paper: ±30° at 0.6°, 101 × 101 hypotheses), rad."""
        antennas, wavelength = array_of(station)
        return _square(tuple(map(tuple, antennas.tolist())), wavelength, span, resolution)

    @classmethod
    def in_plane(cls, station: Station, resolution: float = np.deg2rad(1.0)) -> Grid:
        """All directions in the plane of the array; `angles` (G, 1): about its z axis from its x axis, rad."""
        heading = np.arange(-np.pi, np.pi - 1e-9, resolution)
        return _responses(*array_of(station), heading[:, None], np.cos(heading), np.sin(heading))


@lru_cache(maxsize=8)
def _square(antennas: tuple[tuple[float, ...], ...], wavelength: float, span: float, resolution: float) -> Grid:
    """`Grid.of` for antennas at these places; stations often have equal arrays."""
    axis = np.linspace(-span, span, 2 * round(span / resolution) + 1)
    azimuth, elevation = (a.ravel() for a in np.meshgrid(axis, axis, indexing="ij"))
    x, y = np.sin(azimuth) * np.cos(elevation), np.sin(elevation)
    grid = _responses(np.array(antennas), wavelength, np.stack([azimuth, elevation], axis=1), x, y)
    return Grid(grid.angles, grid.cosine, grid.sine, Blocks.of(np.asarray(grid.cosine), np.asarray(grid.sine)))


def _responses(antennas: np.ndarray, wavelength: float, angles: np.ndarray, x: np.ndarray, y: np.ndarray) -> Grid:
    """The grid of directions `angles` (G, d) with the components `x`, `y` (G,) in the plane of the array."""
    phase = 2 * np.pi / wavelength * (antennas[:, :1] * x + antennas[:, 1:] * y)
    return Grid(angles, np.cos(phase), np.sin(phase), None)


def delay_and_sum(grid: Grid, phases: AnyArray, seen: AnyArray) -> jax.Array:
    """The power |Σ exp(i(φ − steering))|² of each direction, (…, G), for phases and masks (…, n)."""
    weight = jnp.where(seen, 1.0, 0.0).astype(phases.dtype)
    return power(weight * jnp.cos(phases), weight * jnp.sin(phases), grid.cosine, grid.sine)


def direction(grid: Grid, phases: AnyArray, seen: AnyArray) -> jax.Array:
    """The angles (2,) or (1,), rad, at which the delay-and-sum spectrum of one row, phases and masks (n,), is largest.

    The same as `strongest` of `delay_and_sum` up to rounding, for a tenth of the computing time.
    """
    if grid.blocks is None:
        return strongest(grid, delay_and_sum(grid, phases, seen))
    return jnp.asarray(grid.angles)[strongest_index(grid.cosine, grid.sine, grid.blocks, phases, seen)]


def strongest(grid: Grid, spectrum: jax.Array) -> jax.Array:
    """The angles (…, 2 or 1), rad, at which a spectrum (…, G) is largest."""
    return jnp.asarray(grid.angles)[jnp.argmax(spectrum, axis=-1)]


REACH = 2  # grid steps from the centre of a block to its edge

BLOCKS = 16  # blocks searched in every row

IN_FULL_AT_ONCE = 4  # rows searched in full together

IN_FULL_AT_MOST = 256  # on a GPU, where each takes half a megabyte

MARGIN = 1.1  # factor of the bound, since phases are not quite linear in the angles


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
