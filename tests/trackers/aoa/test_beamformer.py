"""Beamformers find the direction a wave comes from, with antennas missing and several rows at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.sim.stations import work_station
from trackwright.trackers.aoa.beamformer import Grid, delay_and_sum, direction, strongest
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


def _phases(angles, rng, sigma):
    """Noisy phases of plane waves with a random common offset a row, (…, 8)."""
    azimuth, elevation = (a[..., None] for a in np.moveaxis(angles, -1, 0))
    x, y = STATION.antennas.T
    clean = 2 * np.pi / STATION.wavelength * (x * np.sin(azimuth) * np.cos(elevation) + y * np.sin(elevation))
    offset = rng.uniform(-np.pi, np.pi, (*clean.shape[:-1], 1))
    return np.angle(np.exp(1j * (clean + offset + sigma * rng.normal(size=clean.shape))))


# Compiled once for each shape: run one by one their small operations take seconds.
delay_and_sum, strongest = jax.jit(delay_and_sum), jax.jit(strongest)


def _das(phases, seen=np.ones(8, bool), grid=GRID):  # noqa: B008
    return delay_and_sum(grid, jnp.asarray(phases), np.broadcast_to(seen, np.shape(phases)))


def test_delay_and_sum_is_the_power_of_the_steered_sum():
    phases, seen = _phases(TRUE[:3], np.random.default_rng(1), 0.3), np.array([1, 1, 0, 1, 1, 1, 0, 1], bool)
    u = np.stack([np.sin(GRID.angles[:, 0]) * np.cos(GRID.angles[:, 1]), np.sin(GRID.angles[:, 1])])
    steering = np.exp(2j * np.pi / STATION.wavelength * STATION.antennas @ u)[seen]
    expected = np.abs(np.exp(1j * phases[:, seen]) @ steering.conj()) ** 2
    np.testing.assert_allclose(_das(phases, seen), expected, rtol=1e-9, atol=1e-9)


def test_delay_and_sum_finds_the_direction_of_one_row():
    directions = np.asarray(strongest(GRID, _das(_phases(TRUE, np.random.default_rng(2), 0.05))))
    # A grid point away in each angle: the peak itself lies between points.
    assert np.abs(directions - TRUE).max() <= 2 * STEP


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
