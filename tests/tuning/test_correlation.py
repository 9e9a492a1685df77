"""Effective number of rows, and intervals of a likelihood on worlds with known correlated errors."""

import numpy as np
import pytest

import trackwright as tw
from tests.known_start import recording
from tests.tuning.worlds import line_tracker, walks
from trackwright.trackers.core.data.recording import Recording, stack
from trackwright.trackers.core.model.covariance import FEW
from trackwright.tuning.correlation import rows_and_inflation, window_sums
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

SIGMA, STEP = "sensors.gauge.sigma", 0.1


def _errors(rng, rows, length):
    """Standard normal errors whose correlation falls by e every `length` s; independent ones for 0."""
    if length == 0:
        return rng.normal(size=rows)
    a, x = np.exp(-STEP / length), np.empty(rows)
    x[0] = rng.normal()
    for k in range(1, rows):
        x[k] = a * x[k - 1] + np.sqrt(1 - a * a) * rng.normal()
    return x


def _standing(rng, rows, length, sigma=0.2):
    """A gauge's recording at a known place, with errors that last."""
    values = sigma * _errors(rng, rows, length)[:, None]
    made = recording(STEP * np.arange(rows), {"gauge": (values, np.ones_like(values, bool))}, [0.0], [[1e-8]])
    return Recording(made.times, made.readings, made.inputs)


@pytest.mark.parametrize("length", [0.5, 2.0])
def test_the_inflation_of_squared_gauss_markov_errors_is_that_of_their_autocorrelation(length):
    rng, rows = np.random.default_rng(1), 200_000
    scores = _errors(rng, rows, length) ** 2 - 1
    times = STEP * np.arange(rows) + 0.01
    # squares are correlated by ρ²; over a window of m rows the inflation is 1 + 2 Σ (1 − k/m) ρ^2k
    m = 100
    k = np.arange(1, m)
    expected = 1 + 2 * np.sum((1 - k / m) * np.exp(-2 * k * STEP / length))
    # 2000 windows, of sums that are skewed: a standard error of 4 to 5 %
    (found,) = window_sums(times, scores, np.zeros(rows), [m * STEP]).inflations
    assert found == pytest.approx(expected, rel=0.15)


def test_windows_do_not_span_two_tracks_and_few_of_them_tell_nothing():
    scores, times = np.random.default_rng(3).normal(size=200), np.tile(0.1 * np.arange(100) + 0.01, 2)
    found = window_sums(times, scores, np.repeat([0, 1], 100), [0.5, 20.0])
    # Tracks of 10 s are 20 windows of half a second, with 5 rows each, or one of 20 s.
    np.testing.assert_array_equal(found.windows[[0, 3]], [[40, 2], [40 * 25, 2 * 100**2]])
    centred = (scores - scores.mean()).reshape(40, 5)
    assert found.inflations[0] == pytest.approx(np.sum(centred.sum(axis=1) ** 2) / np.sum(centred**2), rel=1e-9)
    assert np.isnan(found.inflations[1])
    assert np.isnan(window_sums(times, 0 * times + 1.1, np.repeat([0, 1], 100), [0.5]).inflations[0])


def test_the_effective_rows_in_chunks_of_few_trajectories_are_those_of_one_large_chunk():
    rng, tracker = np.random.default_rng(4), line_tracker(1e-4, 0.3)
    batch = stack([_standing(rng, 300, 1.0) for _ in range(16)])
    parameters = select_parameters(tracker, (SIGMA,))
    problems = [Problem(tracker, [batch], NegativeLogLikelihood(), parameters, chunk) for chunk in (FEW, 2 * FEW)]
    assert [problem.few for problem in problems] == [True, False]
    (rows, factor), other = (rows_and_inflation(problem, flatten(parameters)) for problem in problems)
    assert rows == other[0]
    assert factor == pytest.approx(other[1], rel=1e-6)
    assert factor > 2.0


def test_rows_of_the_model_itself_are_not_correlated():
    result = tw.fit(line_tracker(0.3, 0.2), walks([2000], 3), "nll", ("motion.sigma_v", SIGMA))
    assert rows_and_inflation(result.problem, result.vector)[1] < 1.4


def test_the_likelihoods_interval_is_that_of_the_scatter_of_blocks_where_errors_last():
    made = _standing(np.random.default_rng(2), 3000, 1.0)
    found = tw.fit(line_tracker(1e-4, 0.3), made, "nll", SIGMA)
    rows, factor = rows_and_inflation(found.problem, found.vector)
    assert (rows, 4.0 < factor < 20.0) == (2999, True)
    curvature, scatter = (found.uncertainty.standard_errors(by)[SIGMA] for by in ("curvature", "scatter"))
    assert scatter / curvature == pytest.approx(np.sqrt(factor), rel=0.4)
    assert found.standard_errors[SIGMA] == scatter
    assert any("correlated" in text for text in found.cautions)


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.0, 0.5, 2.0])
def test_intervals_hold_the_truth_where_errors_last(length):
    """Recovery over 200 simulated worlds of 10 minutes each."""
    rng, inside, plain = np.random.default_rng(4), 0, 0
    for _ in range(200):
        result = tw.fit(line_tracker(1e-4, 0.2), _standing(rng, 6000, length), "nll", SIGMA)
        (low, high), (a, b) = (result.uncertainty.intervals(by=by)[SIGMA] for by in ("either", "curvature"))
        inside += low < 0.2 < high
        plain += a < 0.2 < b
    assert inside / 200 >= 0.90
    assert length == 0 or plain / 200 < 0.75, "those of the curvature alone are too narrow"
