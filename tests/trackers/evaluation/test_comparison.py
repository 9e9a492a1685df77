"""Paired differences hold their level where errors last; Holm's correction is that of closed testing."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import polars as pl
import pytest
from scipy.signal import lfilter

from trackwright.trackers.evaluation.comparison import LEAST_PIECES, holm, paired_differences, paired_means

STEP_S = 0.1


def _lasting(rng, rows, runs, tau=1.0):
    """Vectors in the plane with independent coordinates of unit variance, correlated over `tau` seconds (runs, rows, 2)."""
    kept = np.exp(-STEP_S / tau)
    x = rng.normal(size=(runs, rows, 2))
    for k in range(1, rows):
        x[:, k] = kept * x[:, k - 1] + np.sqrt(1 - kept**2) * x[:, k]
    return x


def _run(errors, recording="r"):
    """Scored rows with these errors (rows, 2), whose reported covariance is that of unit variance."""
    size = np.linalg.norm(errors, axis=-1)
    table = {"recording": recording, "tag": "T", "t_s": STEP_S * np.arange(len(size)), "x_m": size, "size_m": size}
    table |= {"size_3d_m": 1.2 * size, "nees": size**2, "density": -0.5 * size**2, "energy": size}
    return pl.DataFrame(table).with_columns(track=pl.lit(0), why=pl.lit(None, pl.String))


@pytest.mark.slow
def test_where_no_run_differs_some_difference_is_found_in_one_family_of_twenty():
    """Four runs with one part of the error in common, three comparisons of three metrics each: 9 in a family."""
    rng, wrong, plain, families = np.random.default_rng(0), 0, 0, 50
    for _ in range(families):
        common, own = _lasting(rng, 900, 1), _lasting(rng, 900, 4)
        runs = [_run(e) for e in common + own]
        each = (paired_differences(runs[0], other, ("rmse_m", "median_m", "coverage_95")) for other in runs[1:])
        found = [difference.p for differences in each for difference in differences.values()]
        wrong += min(holm(found)) <= 0.05
        plain += min(found) <= 0.05
    assert wrong / families <= 0.08
    # Without a correction a quarter of the families has a difference.
    assert plain / families > 0.15


@pytest.mark.slow
def test_the_interval_contains_the_true_difference_nineteen_times_in_twenty():
    rng, inside, runs = np.random.default_rng(1), 0, 150
    true = np.sqrt(2.0) * 0.3  # RMSE of two coordinates with standard deviations 1.3 and 1
    for _ in range(runs):
        first, second = _lasting(rng, 900, 2)
        found = paired_differences(_run(first), _run(1.3 * second), ("rmse_m",))["rmse_m"]
        inside += found.low <= true <= found.high
    assert 0.90 <= inside / runs <= 0.985


def test_runs_are_compared_over_the_tracks_and_times_that_both_have():
    first, second = _lasting(np.random.default_rng(3), 900, 2)
    a, b = _run(first), _run(second[:450])
    found = paired_differences(pl.concat([a, _run(first * 50, "other")]), b, ("rmse_m",))["rmse_m"]
    assert found.first == pytest.approx(np.sqrt(np.mean(np.sum(first[:450] ** 2, axis=-1))), rel=0.02)
    assert paired_differences(a, _run(second, "other")) == {}


def test_a_run_does_not_differ_from_itself_and_short_runs_have_no_interval():
    run = _run(_lasting(np.random.default_rng(4), 900, 1)[0])
    same = paired_differences(run, run)["rmse_m"]
    assert same.value == same.low == same.high == 0.0
    assert same.p == 1.0
    short, other = (_run(e) for e in _lasting(np.random.default_rng(5), 4, 2))
    found = paired_differences(short, other)["rmse_m"]
    assert found.pieces < LEAST_PIECES
    assert np.isnan(found.p)


def test_holm_is_closed_testing():
    """Bonferroni's test of each set of hypotheses, by enumeration."""
    rng = np.random.default_rng(7)
    for _ in range(50):
        p = list(rng.uniform(size=6) ** 3)
        sets = [of for size in range(1, 7) for of in combinations(range(6), size)]
        tests = {of: min(1.0, len(of) * min(p[k] for k in of)) for of in sets}
        assert holm(p) == pytest.approx([max(x for of, x in tests.items() if own in of) for own in range(6)])
    assert holm([0.01, np.nan]) == pytest.approx([0.01, np.nan], nan_ok=True)


def test_the_interval_of_a_mean_holds_the_true_difference_of_lasting_values_of_unlike_recordings():
    rng, held, names = np.random.default_rng(8), 0, np.repeat(["a", "b"], [1500, 500])
    times = np.concatenate([np.arange(1500), np.arange(500)]) * STEP_S
    for _ in range(60):
        noise = np.concatenate([lfilter([1.0], [1.0, -0.8], rng.normal(size=n)) for n in (1500, 500)])
        first = rng.normal() + np.zeros(len(times))
        found = paired_means(times, first, first + noise + np.where(names == "a", 3.0, -1.0), names)
        held += found.low <= 1.0 <= found.high  # each recording has the same say, however long it is
    assert 52 <= held <= 60
