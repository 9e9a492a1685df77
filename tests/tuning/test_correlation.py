"""Effective number of rows, and intervals of a tempered likelihood on worlds with known correlated errors."""

import numpy as np
import pytest
from scipy import stats

import trackwright as tw
from tests.known_start import recording
from tests.tuning.worlds import line_tracker, walks
from trackers.core.covariance import FEW
from trackers.core.recording import Recording, stack
from tuning.correlation import rows_and_inflation, window_sums
from tuning.objectives import NegativeLogLikelihood
from tuning.parameters import flatten, select_parameters
from tuning.problem import Problem

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


def test_tempering_widens_intervals_and_leaves_the_optimum():
    made = _standing(np.random.default_rng(2), 3000, 1.0)
    tracker = line_tracker(1e-4, 0.3)
    plain, tempered = (tw.fit(tracker, made, name, SIGMA) for name in ("nll", "tempered-nll"))
    assert float(tempered.values[SIGMA]) == pytest.approx(float(plain.values[SIGMA]), rel=1e-4)
    rows, factor = rows_and_inflation(plain.problem, plain.vector)
    assert (rows, 4.0 < factor < 20.0) == (2999, True)
    widths = [np.log(np.divide(*r.uncertainty.intervals(by="curvature")[SIGMA][::-1])) for r in (plain, tempered)]
    assert widths[1] / widths[0] == pytest.approx(np.sqrt(factor), rel=1e-3)
    scatter = [r.uncertainty.standard_errors("scatter")[SIGMA] for r in (plain, tempered)]
    assert scatter[1] == pytest.approx(scatter[0], rel=1e-3), "the scatter of blocks needs no power"
    assert any("correlated" in text for text in plain.cautions)
    assert not any("correlated" in text for text in tempered.cautions)


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


def test_rows_of_the_model_itself_are_not_tempered():
    result = tw.fit(line_tracker(0.3, 0.2), walks([2000], 3), "tempered-nll", ("motion.sigma_v", SIGMA))
    assert result.problem.power > 0.7


def test_a_tempered_likelihood_takes_no_priors():
    with pytest.raises(ValueError, match="priors need the likelihood nll"):
        tw.fit(line_tracker(), walks([50], 1), "tempered-nll", SIGMA, priors=[tw.Prior(SIGMA, 0.2, 2.0, None)])


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.0, 0.5, 2.0])
def test_tempered_intervals_hold_the_truth_where_errors_last(length):
    """Recovery over 200 simulated worlds of 10 minutes each."""
    rng, inside, plain = np.random.default_rng(4), 0, 0
    for _ in range(200):
        result = tw.fit(line_tracker(1e-4, 0.2), _standing(rng, 6000, length), "tempered-nll", SIGMA)
        low, high = result.uncertainty.intervals(by="curvature")[SIGMA]
        inside += low < 0.2 < high
        middle, half = np.log(low * high) / 2, np.log(high / low) / 2 * np.sqrt(result.problem.power)
        plain += abs(np.log(0.2) - middle) < half
    assert 0.90 <= inside / 200 <= max(0.97, stats.binom.ppf(0.99, 200, 0.95) / 200)
    assert length == 0 or plain / 200 < 0.75, "without the power they are too narrow"
