"""Cautions on a fit: each on data made so that it applies, and none on data of the model itself."""

from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.experiments.cli.small_archive import random_walk
from tests.known_start import recording
from tests.tuning.worlds import SIGMA_START, line_tracker, walks
from trackwright.trackers.core.data.recording import Recording, stack
from trackwright.trackers.core.model.covariance import FEW
from trackwright.trackers.recordings.folder import read_recording
from trackwright.tuning.data import fit_data
from trackwright.tuning.fitting import left_out_blocks, left_out_values
from trackwright.tuning.objectives import NegativeLogLikelihood, StateLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem
from trackwright.tuning.weight import WINDOWS_S, rows_and_inflation, window_sums

SIGMA, STEP = "sensors.gauge.sigma", 0.1
LEVELS = ("motion.sigma_v", SIGMA)


def _gauge(places, errors, variance=SIGMA_START**2):
    """A gauge's recording of these places and errors at a constant rate; `variance`: of the first place, m²."""
    values = np.asarray(places + errors)[:, None]
    made = recording(
        STEP * np.arange(len(values)), {"gauge": (values, np.ones_like(values, bool))}, [0.0], [[variance]]
    )
    return Recording(made.times, made.readings, made.inputs)


def _walk(rng, rows, sigma_v=0.3):
    return 0.3 * rng.normal() + np.cumsum(sigma_v * np.sqrt(STEP) * rng.normal(size=rows))


def _gauss_markov(rng, rows, sigma, length):
    """Errors whose correlation falls by e every `length` s; independent ones for 0."""
    if length == 0:
        return sigma * rng.normal(size=rows)
    a, x = np.exp(-STEP / length), np.empty(rows)
    x[0] = sigma * rng.normal()
    for k in range(1, rows):
        x[k] = a * x[k - 1] + sigma * np.sqrt(1 - a * a) * rng.normal()
    return x


@pytest.mark.slow
def test_a_fit_to_data_of_the_model_has_no_cautions():
    result = tw.fit(line_tracker(0.5, 0.1), walks([500, 400, 450, 500], 1), "nll", LEVELS)
    assert result.cautions == []
    assert "caution" not in repr(result)


@pytest.mark.slow
def test_a_noise_level_that_collapses_without_a_grid_is_named():
    places = _walk(np.random.default_rng(3), 600)
    result = tw.fit(line_tracker(0.3, 30.0), _gauge(places, 0 * places), "nll", LEVELS, tw.FitOptions(prior="flat"))
    assert any(text.startswith("sensors.gauge.sigma collapsed to ") for text in result.cautions)
    far = tw.fit(line_tracker(0.3, 1e4), walks([400], 1), "nll", LEVELS)
    assert not any("collapsed" in text for text in far.cautions), "a level that the recordings determine"


def test_correlated_errors_are_named_with_the_number_of_rows_that_they_count_for():
    rng, rows = np.random.default_rng(5), 6000
    errors = _gauss_markov(rng, rows, 0.3, 2.0) * np.exp(_gauss_markov(rng, rows, 0.8, 5.0))
    result = tw.fit(line_tracker(0.2, 0.3), _gauge(_walk(rng, rows), errors), "nll", LEVELS)
    (text,) = result.cautions
    assert text.startswith("innovations are correlated over time: 5999 rows carry the information of about ")
    factor = 5999 / float(text.split(" about ")[1])
    assert 4.0 < factor < max(WINDOWS_S) / 0.1


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["nll", StateLogLikelihood(dimensions=1)])
def test_the_values_without_a_recording_are_those_of_a_fit_to_the_others(objective):
    made = [*walks([300, 200], 1), *walks([250], 2, sigma=0.5)]
    flat = tw.FitOptions(prior="flat")
    every = tw.fit(line_tracker(), made, objective, LEVELS, flat)
    found = left_out_values(every)
    assert list(found) == ["1", "2", "3"]
    alone = tw.fit(line_tracker(), made[:2], objective, LEVELS, flat)
    for name in LEVELS:
        assert float(found["3"][name]) == pytest.approx(float(alone.values[name]), rel=0.02)
        assert abs(np.log(found["3"][name] / every.values[name])) > 0.02, "the third is noisier"


def _standing(rng, rows, length, sigma=0.2):
    """A gauge's recording at a known place, with errors that last."""
    return _gauge(0.0, sigma * _gauss_markov(rng, rows, 1.0, length), 1e-8)


@pytest.mark.parametrize("length", [0.5, 2.0])
def test_the_inflation_of_squared_gauss_markov_errors_is_that_of_their_autocorrelation(length):
    rng, rows = np.random.default_rng(1), 200_000
    scores = _gauss_markov(rng, rows, 1.0, length) ** 2 - 1
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
    batch = stack([_standing(rng, 300, 1.0) for _ in range(20)])
    parameters = select_parameters(tracker, (SIGMA,))
    problems = [Problem(tracker, [batch], NegativeLogLikelihood(), parameters, chunk) for chunk in (FEW, 4 * FEW)]
    assert [problem.few for problem in problems] == [True, False]
    (rows, factor), other = (rows_and_inflation(problem, flatten(parameters)) for problem in problems)
    assert rows == other[0]
    assert factor == pytest.approx(other[1], rel=1e-6)
    assert factor > 2.0


def test_the_likelihood_of_errors_that_last_counts_for_fewer_rows():
    made = _standing(np.random.default_rng(2), 3000, 1.0)
    found = tw.fit(line_tracker(1e-4, 0.3), made, "nll", SIGMA)
    rows, factor = rows_and_inflation(found.problem, found.vector)
    assert (rows, 4.0 < factor < 20.0) == (2999, True)
    assert found.problem.discount == pytest.approx(1 / factor, rel=0.2)
    # σ / √(2 n) of n independent ones
    assert found.standard_errors[SIGMA] == pytest.approx(0.2 / np.sqrt(2 * rows / factor), rel=0.2)
    assert any("correlated" in text for text in found.cautions)


@pytest.mark.slow
@pytest.mark.parametrize("length", [0.0, 0.5, 2.0])
def test_intervals_hold_the_truth_where_errors_last(length):
    """Recovery over 200 simulated worlds of 10 minutes each."""
    rng, inside = np.random.default_rng(4), 0
    for _ in range(200):
        result = tw.fit(line_tracker(1e-4, 0.2), _standing(rng, 6000, length), "nll", SIGMA)
        low, high = result.uncertainty.intervals()[SIGMA]
        inside += low < 0.2 < high
    assert inside / 200 >= 0.90


@pytest.mark.slow
def test_the_values_without_a_block_of_time_are_those_of_a_fit_to_the_rest_and_compile_nothing(tmp_path):
    folder = read_recording(random_walk(tmp_path / "one", 6, 0.3, rows=400))
    named = tw.build("fix-kf", folder)
    data = fit_data(named.only_batch([folder]), "state-nll")
    level = "sensors.fixes.sigma_horizontal"
    flat = tw.FitOptions(prior="flat")
    result = tw.fit(data.tracker, data, data.objective, level, flat)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(listen := lambda name, seconds, **_: compiled.append(name))
    blocks = left_out_blocks(result, data)
    jax.monitoring.unregister_event_duration_listener(listen)
    assert not [name for name in compiled if name.endswith("backend_compile_duration")]
    assert [blocks[0][0], blocks[-1][1], len(blocks)] == [-np.inf, np.inf, 4]
    assert all(a[1] == b[0] for a, b in pairwise(blocks))
    for start, stop, values in blocks[:2]:
        # In holes of that length truth is not interpolated.
        truth = folder.tables["truth"].filter(~pl.col("t_s").is_between(start, stop, "left"))
        rest = replace(folder, tables=folder.tables | {"truth": truth})
        alone = tw.fit(named, rest, "state-nll", level, flat)
        assert float(values[level]) == pytest.approx(float(alone.values[level]), rel=0.01)
        assert abs(np.log(values[level] / result.values[level])) > 0.005
