"""The band of a perfect filter on worlds of known correlation, and energy scores against sampling."""

import math

import numpy as np
import polars as pl
import pytest
from scipy.stats import chi2

from trackwright.trackers.evaluation.evaluate import LEAST_SAMPLES
from trackwright.trackers.evaluation.metrics import UNCERTAIN, metrics
from trackwright.trackers.evaluation.rows import correlation_times, energy_scores

WORLDS = 400


def _errors(rng, rows, step, lasts):
    """Unit normal errors (WORLDS, rows, 2) whose correlation falls by e every `lasts` s."""
    a = math.exp(-step / lasts)
    x = rng.normal(size=(WORLDS, rows, 2))
    for k in range(1, rows):
        x[:, k] = a * x[:, k - 1] + math.sqrt(1 - a * a) * x[:, k]
    return x


def _bands(samples, dof=2):
    """The limits of NEES/dof of so many effective samples."""
    name = "nees" if dof == 2 else "nees_3d"
    of = metrics(pl.DataFrame({f"n {name}": samples, f"slow {name}": samples}), [f"{name}_low", f"{name}_high"])
    return of.to_numpy().T


def _judged(worlds, factor=1.0):
    """Effective samples of each world, and whether NEES/dof of errors times `factor` lies in the band."""
    rows = worlds.shape[1]
    samples = rows / correlation_times(factor * worlds.reshape(-1, 2), np.repeat(np.arange(WORLDS), rows))[::rows]
    low, high = _bands(samples)
    ratio = factor**2 * (worlds**2).mean(axis=(1, 2))
    return samples, (low <= ratio) & (ratio <= high)


@pytest.mark.parametrize(
    ("rows", "step", "lasts"), [(400, 0.5, 0.6), (200, 0.5, 2.0), (400, 0.5, 5.0), (150, 0.5, 5.0), (900, 1.0, 30.0)]
)
def test_the_band_holds_a_perfect_filter_in_95_of_100_worlds_and_none_that_is_wrong_by_two(rows, step, lasts):
    worlds = _errors(np.random.default_rng(5), rows, step, lasts)
    samples, inside = _judged(worlds)
    long = samples >= LEAST_SAMPLES
    assert long.mean() > 0.8
    assert 0.92 <= inside[long].mean() <= 0.985
    for factor in (0.5, 2.0):
        assert _judged(worlds, factor)[1][long].mean() < 0.1


def test_tracks_of_other_lengths_do_not_change_the_correlation_of_one():
    x = _errors(np.random.default_rng(9), 300, 0.5, 2.0)[0]
    x[-1] = 0.0
    lengths = (300, 1, 120, 300)
    together = correlation_times(np.concatenate([x, x[:1], x[:120], x]), np.repeat([0, 1, 3, 4], lengths))
    alone = [correlation_times(x[:length], np.zeros(length, int))[0] for length in lengths]
    np.testing.assert_allclose(together, np.repeat(alone, lengths))
    assert alone[1] == 1.0
    assert (correlation_times(np.zeros((5, 2)), np.zeros(5, int)) == 1.0).all()


@pytest.mark.parametrize("samples", [10.0, 100.0, 10_000.0])
def test_the_band_is_that_of_chi_square(samples):
    n = 3 * samples**2 / (samples + UNCERTAIN)
    found = _bands(np.array([samples]), 3)[:, 0]
    np.testing.assert_allclose(found, chi2.ppf([0.025, 0.975], n) / n, rtol=2e-3)


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("smallest", [1.0, 0.1, 1e-3])
@pytest.mark.parametrize("size", [0.0, 1.0, 20.0])
def test_energy_scores_are_those_of_samples(dimensions, smallest, size):
    rng = np.random.default_rng(8)
    root = np.linalg.qr(rng.normal(size=(dimensions, dimensions)))[0] * np.linspace(1.0, smallest, dimensions)
    x, y = (rng.normal(size=(400_000, dimensions)) @ root.T for _ in range(2))
    error = np.full(dimensions, size / math.sqrt(dimensions))
    sampled = np.linalg.norm(x + error, axis=1) - 0.5 * np.linalg.norm(x - y, axis=1)
    (found,) = energy_scores(error[None], (root @ root.T)[None])
    assert found == pytest.approx(sampled.mean(), abs=5 * sampled.std() / math.sqrt(len(sampled)))
