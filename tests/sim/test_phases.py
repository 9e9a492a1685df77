"""Ideal phases: the sign of equation (9), spherical and plane waves."""

import numpy as np
import pytest

from trackwright.sim.phases import plane_phases, spherical_phases, wrapped
from trackwright.sim.stations import facing, work_station
from trackwright.trackers.core.model.rig import Station

STATIONS = list(work_station().stations.values())
RNG = np.random.default_rng(0)
POSITIONS = RNG.uniform([-0.5, -0.5, 0.0], [0.5, 0.5, 0.3], (40, 3))


def _differences(phases):
    return wrapped(phases - phases[..., :1])


def test_plane_phases_are_those_of_the_stations_angles():
    phases = plane_phases(STATIONS, POSITIONS)
    for k, station in enumerate(STATIONS):
        azimuth, elevation = station.angles(POSITIONS).T
        u = np.stack([np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1)
        expected = 2 * np.pi / station.wavelength * u @ station.antennas.T
        np.testing.assert_allclose(wrapped(phases[:, k] - expected), 0, atol=1e-10)


def test_an_antenna_nearer_to_the_beacon_is_ahead_by_its_shorter_path():
    station = Station(np.zeros(3), np.array([1.0, 0, 0, 0]), np.array([[0.0, 0.0], [0.001, 0.0]]), 0.0125)
    beacon = np.array([0.5, 0.0, 1.0])
    first, second = spherical_phases([station], beacon)[0]
    path = np.hypot(0.5, 1.0) - np.hypot(0.499, 1.0)
    assert path > 0
    assert wrapped((second - first)[None]) == pytest.approx(2 * np.pi / 0.0125 * path, abs=1e-9)


def test_a_beacon_far_away_sends_a_plane_wave():
    far = np.array([s.position for s in STATIONS]).mean(axis=0) - [3e3, 2e3, 1e4]
    # The wave bends by d² / 2r, here below 36 mm squared over 20 km: 6e-8 m or 3e-5 rad.
    difference = _differences(spherical_phases(STATIONS, far)) - _differences(plane_phases(STATIONS, far))
    np.testing.assert_allclose(wrapped(difference), 0, atol=1e-4)


@pytest.mark.parametrize("phases_of", [spherical_phases, plane_phases])
def test_turning_and_shifting_the_world_changes_no_phase_difference(phases_of):
    turn, shift = np.array([0.5, 0.1, -0.7, 0.3]), np.array([3.0, -2.0, 1.0])
    frame = Station(shift, turn)
    moved = []
    for station in STATIONS:
        position = frame.world_from_array() @ station.position + shift
        towards = frame.world_from_array() @ np.array([0.0, 0.0, 0.15]) + shift
        up = frame.world_from_array() @ np.array([0.0, 1.0, 0.0])
        moved.append(Station(position, facing(position, towards, up), station.antennas, station.wavelength))
    there = phases_of(moved, POSITIONS @ frame.world_from_array().T + shift)
    np.testing.assert_allclose(
        wrapped(_differences(there) - _differences(phases_of(STATIONS, POSITIONS))), 0, atol=1e-9
    )
