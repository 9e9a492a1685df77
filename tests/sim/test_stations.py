"""The work station and its simulated phases: geometry, truth, and bits independent of the chunks."""

import numpy as np
import pytest

from trackwright import sim
from trackwright.sim.corruptions import drop_outs, gauss_markov, lose_station, outliers
from trackwright.sim.phases import Radar, plane_phases, spherical_phases, wrapped
from trackwright.sim.stations import facing, simulate_phases, work_station
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
    world_from_array = Station(position, facing(position, np.array(target), up)).world_from_array()
    x, y, z = world_from_array.T
    np.testing.assert_allclose(z * np.linalg.norm(target - position), target - position, atol=1e-12)
    np.testing.assert_allclose(np.cross(x, y), z, atol=1e-12)
    assert x @ up == pytest.approx(0, abs=1e-12)
    assert y @ up > 0


@pytest.mark.parametrize("path", ["varied-helix", "hand", "lines"])
def test_no_bit_of_a_trajectory_depends_on_chunk_batch_or_order(path, monkeypatch):
    settings = {
        "n_points": 20,
        "corruptions": {"drift": gauss_markov(0.2, 1.0), "gaps": drop_outs(0.1, 0.3), "wild": outliers(0.1, 1.0)},
    }
    whole = simulate_phases(RIG, path, 150, seed=4, **settings)
    ids = [149, 3, 77, 64, 63]
    some = simulate_phases(RIG, path, ids, seed=4, **settings)
    monkeypatch.setattr(sim.stations, "_CHUNK", 7)
    other = simulate_phases(RIG, path, 150, seed=4, **settings)
    for name in ("positions", "phases", "seen"):
        assert np.array_equal(getattr(some, name), getattr(whole, name)[ids])
        assert np.array_equal(getattr(other, name), getattr(whole, name))


@pytest.mark.parametrize(("wave", "ideal_of"), [("spherical", spherical_phases), ("plane", plane_phases)])
def test_simulated_phases_are_the_ideal_ones_with_noise_of_sigma_p(wave, ideal_of):
    simulated = simulate_phases(RIG, "hand", 50, seed=1, sigma_p=0.2, wave=wave)
    deviations = _deviations(simulated, ideal_of(STATIONS, simulated.positions))
    # 210,000 independent deviations: a standard error of 0.16 %.
    assert np.sqrt((deviations**2).sum() / (deviations.size * 7 / 8)) == pytest.approx(0.2, rel=0.007)
    assert simulated.phases.dtype == np.float32
    assert simulated.phases.shape == simulated.seen.shape == (50, 200, 3, 8)
    assert simulated.positions.shape == (50, 200, 3)
    assert simulated.times[-1] == pytest.approx(19.9)
    assert simulated.seen.all()


def test_without_noise_the_phases_are_exact_to_float32():
    simulated = simulate_phases(RIG, "helix", sigma_p=0.0)
    deviations = _deviations(simulated, spherical_phases(STATIONS, simulated.positions))
    # Sums of a few float32 angles below 10 rad.
    assert np.abs(deviations).max() < 2e-6


def test_every_row_of_every_station_has_its_own_common_phase():
    simulated = simulate_phases(RIG, "helix", 5, sigma_p=0.0)
    common = np.exp(1j * (simulated.phases - spherical_phases(STATIONS, simulated.positions))).mean(axis=-1)
    # 3,000 uniform angles: their mean vectors have a length of about 1 / 55.
    assert np.abs(common.mean()) < 4 / 55
    assert np.abs((common[..., 1:] * common[..., :-1].conj()).mean()) < 4 / 45


def test_adding_a_corruption_changes_neither_truth_nor_the_noise_beneath():
    def turned(keys, times, values, seen):
        return values + np.float32(1.5), seen

    plain = simulate_phases(RIG, "hand", 3, seed=2)
    moved = simulate_phases(RIG, "hand", 3, seed=2, corruptions={"turned": turned})
    assert np.array_equal(moved.positions, plain.positions)
    # Float32 angles below 10 rad.
    np.testing.assert_allclose(wrapped(moved.phases - plain.phases - 1.5), 0, atol=2e-6)


def test_phases_are_zero_where_not_seen_and_wrapped_elsewhere():
    simulated = simulate_phases(
        RIG, "lines", 20, sigma_p=1.0, corruptions={"lost": lose_station(1, 5.0, 8.0), "gaps": drop_outs(0.2, 0.5)}
    )
    assert not simulated.seen[:, 50:80, 1].any()
    assert np.all(simulated.phases[~simulated.seen] == 0)
    assert np.all((simulated.phases.astype(float) > -np.pi) & (simulated.phases.astype(float) <= np.pi))


def test_the_signal_level_is_the_same_world_with_the_radars_noise():
    radar = Radar(snr=2.0)
    signals = simulate_phases(RIG, "hand", 3, seed=2, n_points=20, radar=radar)
    phases = simulate_phases(RIG, "hand", 3, seed=2, n_points=20, sigma_p=radar.sigma_p)
    assert np.array_equal(signals.positions, phases.positions)
    spreads = [
        np.sqrt((_deviations(s, spherical_phases(STATIONS, s.positions)) ** 2).mean()) for s in (signals, phases)
    ]
    # 1,260 deviations each; standard errors of 2 and 3 %, the signal's tones being spread over the bin.
    assert spreads[0] / spreads[1] == pytest.approx(1, abs=0.12)
