"""Beamformers find the direction a wave comes from, with antennas missing and several rows at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.sim.stations import work_station
from trackwright.trackers.aoa.beamformer import Grid, capon, delay_and_sum, direction, music, snapshots, strongest
from trackwright.trackers.core.model.rig import Station

STATION = work_station().stations["1"]
GRID = Grid.of(STATION)
STEP = np.deg2rad(0.6)
# Inside ±30° by a margin, off the grid's own points.
TRUE = np.random.default_rng(0).uniform(-0.45, 0.45, (60, 2))
FLAT_RING = Station(
    np.zeros(3),
    np.array([1.0, 0, 0, 0]),
    0.06 * np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=1),
    0.125,
)


def _phases(angles, rng, sigma, rows=None):
    """Noisy phases of plane waves with a random common offset a row, (…, 8)."""
    azimuth, elevation = (a[..., None] for a in np.moveaxis(angles, -1, 0))
    x, y = STATION.antennas.T
    clean = 2 * np.pi / STATION.wavelength * (x * np.sin(azimuth) * np.cos(elevation) + y * np.sin(elevation))
    clean = clean if rows is None else np.repeat(clean[..., None, :], rows, axis=-2)
    offset = rng.uniform(-np.pi, np.pi, (*clean.shape[:-1], 1))
    return np.angle(np.exp(1j * (clean + offset + sigma * rng.normal(size=clean.shape))))


# Compiled once for each shape: run one by one their small operations take seconds.
capon, music, delay_and_sum, snapshots, strongest = map(jax.jit, (capon, music, delay_and_sum, snapshots, strongest))


def _everywhere(seen, phases):
    return np.broadcast_to(seen, np.shape(phases))


def _das(phases, seen=np.ones(8, bool), grid=GRID):  # noqa: B008
    return delay_and_sum(grid, jnp.asarray(phases), _everywhere(seen, phases))


def _covariance(phases, seen=np.ones(8, bool)):  # noqa: B008
    return snapshots(jnp.asarray(phases), _everywhere(seen, phases))


def _assert_found(spectrum, tolerance=STEP):
    directions = np.asarray(strongest(GRID, spectrum))
    # A grid point away in each angle: the peak itself lies between points.
    assert np.abs(directions - TRUE).max() <= tolerance


def test_delay_and_sum_is_the_power_of_the_steered_sum():
    phases, seen = _phases(TRUE[:3], np.random.default_rng(1), 0.3), np.array([1, 1, 0, 1, 1, 1, 0, 1], bool)
    u = np.stack([np.sin(GRID.angles[:, 0]) * np.cos(GRID.angles[:, 1]), np.sin(GRID.angles[:, 1])])
    steering = np.exp(2j * np.pi / STATION.wavelength * STATION.antennas @ u)[seen]
    expected = np.abs(np.exp(1j * phases[:, seen]) @ steering.conj()) ** 2
    np.testing.assert_allclose(_das(phases, seen), expected, rtol=1e-9, atol=1e-9)


def test_delay_and_sum_finds_the_direction_of_one_row():
    _assert_found(_das(_phases(TRUE, np.random.default_rng(2), 0.05)), 2 * STEP)


@pytest.mark.parametrize("spectrum", [capon, music], ids=["capon", "music"])
@pytest.mark.parametrize("missing", [(), (2, 6)], ids=["all antennas", "two missing"])
def test_capon_and_music_find_the_direction_from_several_rows(spectrum, missing):
    seen = ~np.isin(np.arange(8), missing)
    phases = _phases(TRUE[:20], np.random.default_rng(3), 0.1, rows=16)
    phases[..., ~seen] = 99.0
    powers = spectrum(GRID, _covariance(phases, seen))
    assert np.all(np.isfinite(powers))
    assert np.abs(np.asarray(strongest(GRID, powers)) - TRUE[:20]).max() <= 2 * STEP


def test_capons_spectrum_is_that_of_the_loaded_inverse():
    covariance = _covariance(_phases(TRUE[0], np.random.default_rng(5), 0.3, rows=6))
    loaded = np.asarray(covariance) + 0.05 * np.trace(covariance).real / 8 * np.eye(8)
    steering = GRID.cosine + 1j * GRID.sine
    expected = 1 / np.einsum("ig,ij,jg->g", steering.conj(), np.linalg.inv(loaded), steering).real
    np.testing.assert_allclose(capon(GRID, covariance), expected, rtol=1e-8)


def test_a_flat_array_finds_directions_all_round_in_its_own_plane():
    grid = Grid.in_plane(FLAT_RING)
    heading = np.random.default_rng(7).uniform(-np.pi, np.pi, 50)
    u = np.stack([np.cos(heading), np.sin(heading)])
    phases = (2 * np.pi / FLAT_RING.wavelength * FLAT_RING.antennas @ u).T + 1.2
    directions = np.asarray(strongest(grid, _das(phases, grid=grid)))[:, 0]
    assert np.abs(np.angle(np.exp(1j * (directions - heading)))).max() <= np.deg2rad(0.5) + 1e-9


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("sigma", [0.3, 9.0])
def test_the_direction_of_a_row_is_that_of_the_largest_power_on_the_whole_grid(sigma, missing):
    rng = np.random.default_rng(1)
    phases = _phases(rng.uniform(-0.5, 0.5, (300, 2)), rng, sigma)
    seen = rng.uniform(size=phases.shape) >= missing
    seen[:2] = False
    directions = np.asarray(jax.jit(jax.vmap(direction, in_axes=(None, 0, 0)))(GRID, phases, seen))
    spectrum = np.asarray(delay_and_sum(GRID, jnp.asarray(phases), seen))
    of_angles = {tuple(angles): k for k, angles in enumerate(np.asarray(GRID.angles))}
    powers = spectrum[np.arange(300), [of_angles[tuple(angles)] for angles in directions]]
    # With few antennas several directions have the same power up to rounding.
    np.testing.assert_allclose(powers, spectrum.max(axis=1), rtol=1e-12)
    np.testing.assert_array_equal(directions[:2], GRID.angles[[0, 0]])
