"""Beamformers: delay-and-sum, Capon and MUSIC over a grid of directions, batched over rows.

They use phases only, with equal weights of the antennas, and one row at a time: the baseline of the beam tracker and
its start (Will et al. 2020, section 4).
"""

from __future__ import annotations

from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.aoa.peak import Blocks, power, strongest_index
from trackwright.trackers.core.model.algebra import product
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
        return _square(*_array(station), span, resolution)

    @classmethod
    def in_plane(cls, station: Station, resolution: float = np.deg2rad(1.0)) -> Grid:
        """All directions in the plane of the array; `angles` (G, 1): about its z axis from its x axis, rad."""
        heading = np.arange(-np.pi, np.pi - 1e-9, resolution)
        return _responses(*_array(station), heading[:, None], np.cos(heading), np.sin(heading))


@lru_cache(maxsize=8)
def _square(array: tuple[tuple[float, float], ...], wavelength: float, span: float, resolution: float) -> Grid:
    """`Grid.of` for antennas at these places; stations often have equal arrays."""
    axis = np.linspace(-span, span, 2 * round(span / resolution) + 1)
    azimuth, elevation = (a.ravel() for a in np.meshgrid(axis, axis, indexing="ij"))
    x, y = np.sin(azimuth) * np.cos(elevation), np.sin(elevation)
    grid = _responses(array, wavelength, np.stack([azimuth, elevation], axis=1), x, y)
    return Grid(grid.angles, grid.cosine, grid.sine, Blocks.of(np.asarray(grid.cosine), np.asarray(grid.sine)))


def _array(station: Station) -> tuple[tuple[tuple[float, float], ...], float]:
    """The antennas' places and the wavelength, m."""
    if station.antennas is None or station.wavelength is None:
        raise ValueError("a beamformer needs a station with antennas and a wavelength")
    return tuple((float(x), float(y)) for x, y in np.asarray(station.antennas, float)), float(station.wavelength)


def _responses(
    array: tuple[tuple[float, float], ...], wavelength: float, angles: np.ndarray, x: np.ndarray, y: np.ndarray
) -> Grid:
    """The grid of directions `angles` (G, d) with the components `x`, `y` (G,) in the plane of the array."""
    antennas = np.array(array)
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


def snapshots(phases: AnyArray, seen: AnyArray) -> jax.Array:
    """The sample covariance (…, n, n), complex, of the unit phasors of several rows (…, rows, n)."""
    phasor = jax.lax.complex(jnp.cos(phases), jnp.sin(phases))
    x = jnp.where(seen, phasor, jnp.zeros_like(phasor))
    return jnp.einsum("...ri,...rj->...ij", x, x.conj(), precision="highest") / phases.shape[-2]


def capon(grid: Grid, covariance: jax.Array, loading: float = 0.05) -> jax.Array:
    """Capon's spectrum 1/(aᴴR⁻¹a), (…, G), with `loading` times the mean power added to R's diagonal (Capon 1969)."""
    n = covariance.shape[-1]
    eye = jnp.broadcast_to(jnp.eye(n, dtype=covariance.dtype), covariance.shape)
    loaded = covariance + (loading / n * _power(covariance) + 1e-12) * eye
    return 1.0 / _form(grid, _inverse(loaded))


def music(grid: Grid, covariance: jax.Array) -> jax.Array:
    """The MUSIC spectrum for one source, (…, G): n/(n − |aᴴe|²) with e the principal eigenvector (Schmidt 1986)."""
    n = covariance.shape[-1]
    vector = covariance
    for _ in range(6):
        # Six squarings are 64 power iterations; the division prevents overflow.
        vector = product(vector, vector)
        vector = vector / (_power(vector) + 1e-30)
    signal = jnp.maximum(_form(grid, vector), 0.0)
    return n / jnp.maximum(n - signal, 1e-6 * n)


def strongest(grid: Grid, spectrum: jax.Array) -> jax.Array:
    """The angles (…, 2 or 1), rad, at which a spectrum (…, G) is largest."""
    return jnp.asarray(grid.angles)[jnp.argmax(spectrum, axis=-1)]


def _power(matrix: jax.Array) -> jax.Array:
    """The trace of Hermitian matrices, (…, 1, 1), of the matrices' dtype."""
    return jnp.trace(matrix, axis1=-2, axis2=-1).real[..., None, None].astype(matrix.dtype)


def _form(grid: Grid, matrix: jax.Array) -> jax.Array:
    """aᴴMa for every direction, for a Hermitian matrix."""
    kind = jnp.zeros((), matrix.dtype).real.dtype
    steering = jax.lax.complex(jnp.asarray(grid.cosine, kind), jnp.asarray(grid.sine, kind))
    return jnp.einsum("ig,...ij,jg->...g", steering.conj(), matrix, steering, precision="highest").real


def _inverse(matrix: jax.Array) -> jax.Array:
    """The inverse of Hermitian positive definite matrices by Gauss–Jordan, without LAPACK's per-matrix cost."""
    n = matrix.shape[-1]
    work = jnp.concatenate([matrix, jnp.broadcast_to(jnp.eye(n, dtype=matrix.dtype), matrix.shape)], axis=-1)
    for k in range(n):
        row = work[..., k, :] / work[..., k, k, None]
        work = work - work[..., :, k, None] * row[..., None, :]
        work = work.at[..., k, :].set(row)
    return work[..., n:]
