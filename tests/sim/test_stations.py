"""The work station and its simulated phases: geometry, the sign of equation (9), and bits independent of the chunks."""

import numpy as np
import pytest

from trackwright import sim
from trackwright.sim.corruptions import drop_outs, gauss_markov, lose_station, outliers
from trackwright.sim.stations import PhaseDraw, facing, plane_phases, spherical_phases, work_station, wrapped
from trackwright.trackers.core.model.rig import Station

RIG = work_station()
STATIONS = list(RIG.stations.values())


def _deviations(simulated, ideal):
    residual = simulated.phases - ideal
    residual = wrapped(residual - np.angle(np.exp(1j * residual).mean(axis=-1, keepdims=True)))
    return residual - residual.mean(axis=-1, keepdims=True)


@pytest.mark.parametrize("target", [(0.0, 0.0, 0.0), (3.0, 1.0, 2.0), (0.0, 1.0, 5.0), (-2.0, 0.3, 2.0)])
def test_a_station_faces_its_target_with_its_y_axis_up(target):
    position, up = np.array([0.0, 0.0, 2.0]), np.array([0.0, 1.0, 0.2])
    x, y, z = Station(position, facing(position, np.array(target), up)).world_from_array().T
    np.testing.assert_allclose(z * np.linalg.norm(target - position), target - position, atol=1e-12)
    np.testing.assert_allclose(np.cross(x, y), z, atol=1e-12)
    assert x @ up == pytest.approx(0, abs=1e-12)
    assert y @ up > 0


@pytest.mark.parametrize("path", ["helix", "hand"])
def test_no_bit_of_a_trajectory_depends_on_chunk_batch_or_order(path, monkeypatch):
    settings = {
        "n_points": 20,
        "corruptions": {"drift": gauss_markov(0.2, 1.0), "gaps": drop_outs(0.1, 0.3), "wild": outliers(0.1, 1.0)},
    }
    whole = PhaseDraw(RIG, path, **settings).drawn(150, seed=4)
    ids = [149, 3, 77, 64, 63]
    some = PhaseDraw(RIG, path, **settings).drawn(ids, seed=4)
    monkeypatch.setattr(sim.stations.PhaseDraw, "size", 7)
    other = PhaseDraw(RIG, path, **settings).drawn(150, seed=4)
    for name in ("positions", "phases", "seen"):
        assert np.array_equal(getattr(some, name), getattr(whole, name)[ids])
        assert np.array_equal(getattr(other, name), getattr(whole, name))


@pytest.mark.parametrize(("wave", "ideal_of"), [("spherical", spherical_phases), ("plane", plane_phases)])
def test_simulated_phases_are_the_ideal_ones_with_noise_of_sigma_p(wave, ideal_of):
    simulated = PhaseDraw(RIG, "hand", sigma_p=0.2, wave=wave).drawn(50, seed=1)
    deviations = _deviations(simulated, ideal_of(STATIONS, simulated.positions))
    # 210,000 independent deviations: a standard error of 0.16 %.
    assert np.sqrt((deviations**2).sum() / (deviations.size * 7 / 8)) == pytest.approx(0.2, rel=0.007)
    assert simulated.phases.dtype == np.float32
    assert simulated.phases.shape == simulated.seen.shape == (50, 200, 3, 8)
    assert simulated.positions.shape == (50, 200, 3)
    assert simulated.times[-1] == pytest.approx(19.9)
    assert simulated.seen.all()


def test_without_noise_the_phases_are_exact_to_float32():
    simulated = PhaseDraw(RIG, "helix", sigma_p=0.0).drawn()
    deviations = _deviations(simulated, spherical_phases(STATIONS, simulated.positions))
    # Sums of a few float32 angles below 10 rad.
    assert np.abs(deviations).max() < 2e-6


def test_phases_are_zero_where_not_seen_and_wrapped_elsewhere():
    lost = {"lost": lose_station(1, 5.0, 8.0), "gaps": drop_outs(0.2, 0.5)}
    simulated = PhaseDraw(RIG, "hand", lost, sigma_p=1.0).drawn(20)
    assert not simulated.seen[:, 50:80, 1].any()
    assert np.all(simulated.phases[~simulated.seen] == 0)
    assert np.all((simulated.phases.astype(float) > -np.pi) & (simulated.phases.astype(float) <= np.pi))


POSITIONS = np.random.default_rng(0).uniform([-0.5, -0.5, 0.0], [0.5, 0.5, 0.3], (40, 3))


def test_plane_phases_are_those_of_the_stations_angles():
    phases = plane_phases(STATIONS, POSITIONS)
    for k, station in enumerate(STATIONS):
        azimuth, elevation = station.angles(POSITIONS).T
        u = np.stack([np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1)
        expected = 2 * np.pi / station.wavelength * u @ station.antennas.T
        np.testing.assert_allclose(wrapped(phases[:, k] - expected), 0, atol=1e-10)


def test_an_antenna_nearer_to_the_beacon_is_ahead_by_its_shorter_path():
    station = Station(np.zeros(3), np.array([1.0, 0, 0, 0]), np.array([[0.0, 0.0], [0.001, 0.0]]), 0.0125)
    first, second = spherical_phases([station], np.array([0.5, 0.0, 1.0]))[0]
    path = np.hypot(0.5, 1.0) - np.hypot(0.499, 1.0)
    assert path > 0
    assert wrapped((second - first)[None]) == pytest.approx(2 * np.pi / 0.0125 * path, abs=1e-9)


def test_a_beacon_far_away_sends_a_plane_wave():
    far = np.array([s.position for s in STATIONS]).mean(axis=0) - [3e3, 2e3, 1e4]
    # The wave bends by d² / 2r, here below 36 mm squared over 20 km: 6e-8 m or 3e-5 rad.
    spherical, plane = (x - x[..., :1] for x in (spherical_phases(STATIONS, far), plane_phases(STATIONS, far)))
    np.testing.assert_allclose(wrapped(spherical - plane), 0, atol=1e-4)
