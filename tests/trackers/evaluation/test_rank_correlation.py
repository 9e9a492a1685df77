"""Autocorrelation of NIS by ranks: against a loop over all pairs, and on processes of known correlation."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.stats

from trackwright.trackers.evaluation.rank_correlation import LAGS_S, PAIRED, WINDOWED, correlation, inflation, rank_sums

LAGS = list(LAGS_S.values())


def _correlations(sums):
    """The autocorrelation at each lag, of all tracks together."""
    return np.array([correlation(*(sums[f"{what} {lag}"].sum() for what in PAIRED)) for lag in LAGS_S])


def _inflation(sums):
    return inflation(*(sums[name].sum() for name in WINDOWED))


def _by_loops(times, nis, dof, starts):
    """The definition row by row: ranks by scipy, each row's partner by a search over all rows."""
    products = np.zeros((len(starts) - 1, len(LAGS), 4))
    for k in range(len(starts) - 1):
        rows = [r for r in range(starts[k], starts[k + 1]) if dof[r] > 0 and np.isfinite(nis[r] + times[r])]
        u = {}
        for d in {dof[r] for r in rows}:
            own = [r for r in rows if dof[r] == d]
            u |= dict(zip(own, (scipy.stats.rankdata(nis[own]) - 0.5) / len(own) - 0.5, strict=True))
        for m, lag in enumerate(LAGS):
            for i in rows:
                j = min(rows, key=lambda r: (abs(times[r] - times[i] - lag), r))
                if times[j] > times[i] and abs(times[j] - times[i] - lag) <= lag / 4:
                    products[k, m] += u[i] * u[j], u[i] ** 2, u[j] ** 2, 1
    return products


def test_products_are_those_of_a_loop_over_all_pairs():
    rng = np.random.default_rng(5)
    starts = np.array([0, 130, 131, 131, 240])
    times = np.concatenate([np.sort(rng.uniform(1e9, 1e9 + 20, b - a)) for a, b in pairwise(starts)])
    nis = np.round(rng.chisquare(2, 240), 1)  # with ties
    dof = rng.integers(0, 3, 240).astype(float)
    nis[[3, 200]], times[7] = np.nan, np.nan
    sums = rank_sums(times, nis, dof, starts)
    found = np.stack([np.stack([sums[f"{what} {lag}"] for what in PAIRED], axis=-1) for lag in LAGS_S], axis=1)
    np.testing.assert_allclose(found, _by_loops(times, nis, dof, starts), atol=1e-12)


def _gauss_markov(n, step, length, seed=1):
    """A standard normal sequence at steps of `step` s whose correlation falls by e every `length` s."""
    rng, a = np.random.default_rng(seed), np.exp(-step / length)
    x = np.empty(n)
    x[0] = rng.normal()
    for k in range(1, n):
        x[k] = a * x[k - 1] + np.sqrt(1 - a * a) * rng.normal()
    return x


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_errors_that_last_are_found_whatever_the_noise_level(scale):
    n = 40_000
    x = _gauss_markov(n, 0.05, 4.0)
    found = _correlations(rank_sums(0.05 * np.arange(n), scale * x**2, np.ones(n), np.array([0, n])))
    pairs = np.random.default_rng(9).normal(size=(2, 200_000))
    expected = [
        scipy.stats.spearmanr(pairs[0] ** 2, (r * pairs[0] + np.sqrt(1 - r * r) * pairs[1]) ** 2)[0]
        for r in np.exp(-np.array(LAGS) / 4.0)
    ]
    # 2000 s of errors that last 4 s: some 250 independent ones
    assert found == pytest.approx(expected, abs=0.1)


def test_white_innovations_with_heavy_tails_are_uncorrelated():
    rng = np.random.default_rng(2)
    n = 40_000
    nis = rng.standard_t(1.5, n) ** 2
    found = _correlations(rank_sums(0.05 * np.arange(n), nis, np.ones(n), np.array([0, n])))
    assert np.abs(found).max() < 4 / np.sqrt(n)


def test_readings_of_one_and_of_four_degrees_of_freedom_in_turn_are_uncorrelated():
    rng = np.random.default_rng(3)
    n = 20_000
    dof = np.where(np.arange(n) % 40 < 20, 1, 4)  # for one second each
    found = _correlations(rank_sums(0.05 * np.arange(n), rng.chisquare(dof), dof, np.array([0, n])))
    assert np.abs(found).max() < 4 / np.sqrt(n)


def test_repeated_readings_inflate_by_the_length_of_their_runs():
    # 20 rows a second in runs of 5 equal values that do not cross the seconds: 5 rows carry the information of one.
    rng = np.random.default_rng(6)
    nis = np.repeat(rng.chisquare(2, 4000), 5)
    times = 0.05 * np.arange(20_000) + 0.01
    sums = rank_sums(times, nis, np.full(20_000, 2), np.array([0, 20_000]))
    assert _inflation(sums) == pytest.approx(5.0, rel=0.1)  # 1000 windows: 4.5 % standard error


def test_white_rows_are_not_inflated_over_many_short_tracks():
    rng = np.random.default_rng(7)
    times, starts = np.tile(0.05 * np.arange(200), 100), np.arange(0, 20_001, 200)
    sums = rank_sums(times, rng.chisquare(3, 20_000), np.full(20_000, 3), starts)
    assert _inflation(sums) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("step", [0.04, 0.05, 0.125])
def test_the_sums_of_a_track_do_not_depend_on_the_others(step):
    # With these steps rows lie half-way between two partners, or at the end of the tolerance.
    rng = np.random.default_rng(8)
    times, starts = np.tile(1.7e9 + step * np.arange(200), 7), np.arange(0, 1401, 200)
    nis = rng.chisquare(3, 1400)
    whole = rank_sums(times, nis, np.full(1400, 3), starts)
    for k in range(7):
        alone = rank_sums(times[:200], nis[starts[k] : starts[k + 1]], np.full(200, 3), np.array([0, 200]))
        assert alone.keys() == whole.keys()
        for name, (value,) in alone.items():
            assert whole[name][k] == value
