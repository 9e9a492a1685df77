"""Corruptions: their stated statistics, and noise that is independent of other corruptions."""

import numpy as np
import pytest

from trackwright.sim.corruptions import corrupted, drop_outs, gauss_markov, lose_station, outliers, white_noise
from trackwright.sim.keys import trajectory_keys

N, T, STATIONS, ANTENNAS = 300, 60, 3, 4
KEYS = trajectory_keys(0, np.arange(N))
TIMES = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.3, T))
CLEAN = np.zeros((N, T, STATIONS, ANTENNAS), np.float32)
SEEN = np.ones(CLEAN.shape, bool)


def test_white_noise_is_independent_with_standard_deviation_sigma():
    noise, seen = white_noise(0.3)(KEYS, TIMES, CLEAN, SEEN)
    # 216,000 values: a standard error of 0.15 % of sigma, 0.2 % of a correlation.
    assert noise.std() == pytest.approx(0.3, rel=0.007)
    assert noise.dtype == np.float32
    assert seen.all()
    for axis in (1, 2, 3):
        first, second = np.delete(noise, 0, axis), np.delete(noise, -1, axis)
        assert abs(np.mean(first * second)) < 0.01 * 0.09


def test_gauss_markov_noise_is_stationary_with_its_time_constant_on_irregular_times():
    drift, _ = gauss_markov(0.5, tau=1.5)(KEYS, TIMES, CLEAN, SEEN)
    channels = drift.transpose(0, 2, 3, 1).reshape(-1, T).astype(float)
    covariance = channels.T @ channels / len(channels)
    expected = 0.25 * np.exp(-np.abs(TIMES[:, None] - TIMES) / 1.5)
    # 3,600 series: a standard error of sigma² sqrt(2 / 3600) = 0.006 at most; five of them over 1,800 entries.
    np.testing.assert_allclose(covariance, expected, rtol=0, atol=0.03)


def test_outliers_have_the_stated_share_and_size():
    values, seen = outliers(0.05, 2.0)(KEYS, TIMES, CLEAN, SEEN)
    hit = values != 0
    # 216,000 values, 10,800 hits: standard errors of 0.0005 and 0.7 %.
    assert hit.mean() == pytest.approx(0.05, abs=0.002)
    assert values[hit].std() == pytest.approx(2.0, rel=0.03)
    assert seen.all()


@pytest.mark.parametrize("length", [0.0, 0.8])
def test_drop_outs_have_the_stated_share_at_every_row(length):
    _, seen = drop_outs(0.2, length)(KEYS, TIMES, CLEAN, SEEN)
    assert np.array_equal(seen.any(axis=-1), seen.all(axis=-1))
    lost = ~seen[..., 0]
    # 900 independent trajectories: a standard error of 0.013 for one row.
    np.testing.assert_allclose(lost.mean(axis=(0, 2)), 0.2, atol=0.06)


def test_bursts_have_the_stated_mean_length_at_any_rate():
    for dt in (0.05, 0.2):
        times = np.arange(0, 40, dt)
        values = np.zeros((N, len(times), 1, 1))
        lost = ~drop_outs(0.2, 0.8)(KEYS, times, values, values == 0)[1][:, :, 0, 0]
        # Two-state Markov chain: ends at 1 / 0.8, forgets at 1 / (0.8 * 0.8) per second.
        expected = 0.2 + 0.8 * np.exp(-dt / 0.64)
        assert np.sum(lost[:, 1:] & lost[:, :-1]) / np.sum(lost[:, :-1]) == pytest.approx(expected, abs=0.01)


def test_a_lost_station_has_no_measurements_from_its_start_until_before_its_end():
    _, seen = lose_station(2, TIMES[10], TIMES[20])(KEYS, TIMES, CLEAN, SEEN)
    assert not seen[:, 10:20, 2].any()
    assert seen.sum() == seen.size - N * 10 * ANTENNAS
    _, seen = lose_station(0)(KEYS, TIMES, CLEAN, SEEN)
    assert not seen[:, :, 0].any()


def test_adding_a_corruption_changes_no_noise_of_another():
    some = {"noise": white_noise(0.1), "drop-outs": drop_outs(0.1, 0.5)}
    more = {"drift": gauss_markov(1.0, 2.0), "wild": outliers(0.1, 3.0), **some, "second noise": white_noise(0.1)}
    without = corrupted(some, KEYS, TIMES, CLEAN, SEEN)
    within = corrupted(more, KEYS, TIMES, CLEAN, SEEN)
    others = corrupted({k: more[k] for k in ("drift", "wild", "second noise")}, KEYS, TIMES, CLEAN, SEEN)
    # Sums of float32 numbers of size 10.
    np.testing.assert_allclose(within[0] - others[0], without[0], atol=1e-5)
    assert np.array_equal(within[1], without[1])
