"""Fits by gradient: the gradient itself, recovered parameters, standard errors, and failing steps."""

from dataclasses import replace

import numpy as np
import pytest

from tests.tuning.worlds import line_tracker, walks
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.tunable import tunables
from trackwright.tuning.checkpoint import to_arrays
from trackwright.tuning.fitting import FitOptions, Progress, fit
from trackwright.tuning.objectives import NegativeLogLikelihood, RootMeanSquareError
from trackwright.tuning.optimisation import LBFGS, PATIENCE, Adam
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

LEVELS = ("motion.sigma_v", "sensors.gauge.sigma")
NLL = NegativeLogLikelihood()
WRONG = ((10.0, 0.1), (10.0, 10.0), (0.1, 10.0), (0.1, 0.1), (1e3, 1e-3))


def _problem(tracker, recordings, patterns, objective=NLL, rows=None):
    parameters = select_parameters(tracker, patterns)
    return Problem(tracker, [stack(recordings, rows)], objective, parameters, 512), flatten(parameters)


@pytest.mark.parametrize(
    ("optimiser", "wrong_v", "wrong"), [*((LBFGS(), *factors) for factors in WRONG), (Adam(40, 0.2), 10.0, 10.0)]
)
def test_noise_levels_are_recovered_from_starts_that_are_far_off(optimiser, wrong_v, wrong):
    start, true = line_tracker(0.3 * wrong_v, 0.2 * wrong), dict(zip(LEVELS, (0.3, 0.2), strict=True))
    result = fit(start, stack(walks([100] * 16, 0)), NLL, LEVELS, FitOptions(optimiser=optimiser, prior="flat"))
    for name, value in true.items():
        error = result.standard_errors[name]
        # What the likelihood counts for is judged at the start, whose innovations are correlated there.
        assert 0 < error < 0.3 * value
        assert abs(result.values[name] - value) < 3 * error
        assert tunables(result.tracker)[name].value == pytest.approx(float(result.values[name]))
    assert result.value < result.start_value


@pytest.fixture(scope="module")
def line_world():
    return stack(walks([40] * 8, 3))


def test_a_fit_is_never_worse_than_its_start_and_keeps_its_best_point(line_world):
    result = fit(
        line_tracker(),
        line_world,
        RootMeanSquareError(dimensions=1),
        LEVELS,
        FitOptions(steps=12, optimiser=Adam(12, 3.0)),
    )
    values = [step.value for step in result.trace]
    assert max(values) > values[0], "steps this long overshoot"
    assert result.value == min(values) <= result.start_value == values[0]
    assert result.values == result.trace[int(np.argmin(values))].values
    # an RMSE of few trajectories has no standard errors
    assert all(np.isnan(error) for error in result.standard_errors.values())
    assert "nan" not in repr(result)


def test_a_step_to_a_non_finite_objective_is_halved(monkeypatch):
    whole, tried, fence = Problem.evaluate, [], np.log(0.5)

    def fenced(self, vectors, *weights, **options):
        found = whole(self, vectors, *weights, **options)
        tried.append(float(np.atleast_2d(vectors)[0, 1]))
        return found._replace(values=np.where(np.atleast_2d(vectors)[:, 1] > fence, np.nan, found.values))

    monkeypatch.setattr(Problem, "evaluate", fenced)
    # the best noise level, 0.7 m, is beyond the fence
    world = stack(walks([40] * 8, 4, sigma=0.7))
    result = fit(line_tracker(sigma=0.3), world, NLL, LEVELS, FitOptions(steps=10, optimiser=Adam(10, 0.4)))
    assert all(step.values["sensors.gauge.sigma"] <= 0.5 for step in result.trace)
    first = next(k for k, v in enumerate(tried) if v > fence)
    assert tried[first + 1] - tried[first - 1] == pytest.approx((tried[first] - tried[first - 1]) / 2)
    assert 0.45 < result.values["sensors.gauge.sigma"] <= 0.5


@pytest.mark.parametrize("optimiser", [LBFGS(), Adam(3)], ids=["LBFGS", "Adam"])
def test_a_fit_that_cannot_move_stays_at_its_start(monkeypatch, line_world, optimiser):
    whole, calls = Problem.evaluate, []

    def only_the_first(self, vectors, **options):
        calls.append(np.atleast_2d(vectors))
        found = whole(self, vectors, **options)
        there = (np.atleast_2d(vectors) == calls[0]).all(axis=1)
        return found._replace(values=np.where(there, found.values, np.inf))

    monkeypatch.setattr(Problem, "evaluate", only_the_first)
    result = fit(line_tracker(), line_world, NLL, LEVELS, FitOptions(steps=3, optimiser=optimiser))
    assert result.value == result.start_value
    assert result.values["motion.sigma_v"] == pytest.approx(0.3, rel=1e-12)


def test_a_recording_with_a_non_finite_objective_is_excluded_and_counted():
    recordings = walks([40] * 7, 5)
    third = recordings[2]
    values, seen = third.readings["gauge"].values.copy(), third.readings["gauge"].seen.copy()
    values[7], seen[7] = 1e200, True
    spoilt = Recording(third.times, {"gauge": Readings(values, seen)}, third.inputs, third.truth)
    others = recordings[:2] + recordings[3:]
    problem, vector = _problem(line_tracker(), [*others, spoilt], LEVELS)
    clean, _ = _problem(line_tracker(), others, LEVELS)
    found, expected = problem.evaluate(vector), clean.evaluate(vector)
    assert (problem.valid & ~found.used).sum() == 1
    assert (clean.valid & ~expected.used).sum() == 0
    np.testing.assert_allclose(found.values, expected.values, rtol=1e-12)
    np.testing.assert_allclose(found.gradients, expected.gradients, rtol=1e-12)


@pytest.mark.parametrize(
    ("objective", "error", "words"),
    [
        (NLL, FloatingPointError, "not finite at the start"),
        (RootMeanSquareError(dimensions=1), UnusableInput, "no known truth"),
    ],
)
def test_recordings_without_a_scored_row_are_refused(objective, error, words):
    silent = walks([40] * 8, 5, missing=1.0)
    nowhere = {"position": (np.zeros((40, 1)), np.zeros(40, bool))}
    blind = [Recording(r.times, r.readings, r.inputs, nowhere) for r in silent]
    with pytest.raises(error, match=words):
        fit(line_tracker(), stack(blind), objective, LEVELS, FitOptions(steps=2))


@pytest.mark.parametrize("optimiser", [LBFGS(), pytest.param(Adam(5), marks=pytest.mark.slow)])
def test_a_fit_resumed_at_any_step_is_bit_identical(line_world, optimiser):
    saved = []
    options, on = (
        FitOptions(steps=5, starts=3, optimiser=optimiser),
        Progress(report=lambda s: saved.append(to_arrays(s))),
    )
    whole = fit(line_tracker(), line_world, NLL, LEVELS, options, on)
    for arrays in saved[:-1:2]:
        again = fit(line_tracker(), line_world, NLL, LEVELS, options, Progress(resume=arrays))
        assert np.array_equal(again.vector, whole.vector)
        assert again.starts == whole.starts
        assert again.filter_runs == whole.filter_runs


@pytest.mark.slow
def test_starts_of_adam_end_where_they_no_longer_improve_or_meet_a_better_one(line_world):
    seen, rmse = [], RootMeanSquareError(dimensions=1)
    options, on = FitOptions(steps=300, optimiser=Adam(300)), Progress(report=seen.append)
    alone = fit(line_tracker(), line_world, rmse, LEVELS, options, on)
    assert PATIENCE < seen[-1].number < 150
    # Other starts, a factor of ten away, end where they come near the best point of a better one.
    several = fit(line_tracker(), line_world, rmse, LEVELS, replace(options, starts=3), on)
    assert seen[-1].number < 150
    assert several.value <= alone.value * 1.001


def test_an_interrupted_fit_keeps_its_best_point(line_world):
    def stop(state):
        if state.number == 2:
            raise KeyboardInterrupt

    result = fit(line_tracker(sigma=2.0), line_world, NLL, LEVELS, progress=Progress(report=stop))
    assert result.uncertainty is None
    assert result.value < result.start_value
    assert len(result.trace) == 3


def test_bounds_and_frozen_numbers_hold(line_world):
    bounds = {"sensors.gauge.*": (0.25, 0.5)}
    tune = ("motion.*", "sensors.*.sigma", "*.offset")
    result = fit(
        line_tracker(sigma=0.3), line_world, NLL, tune, FitOptions(frozen=["*.offset"], bounds=bounds, starts=4)
    )
    # the best noise level, 0.2 m, lies below
    assert result.values["sensors.gauge.sigma"] == pytest.approx(0.25, rel=1e-12)
    assert set(result.values) == {"motion.sigma_v", "sensors.gauge.sigma"}


def test_parameters_without_effect_keep_the_users_values_whichever_start_wins():
    # rows at the same time do not depend on the speed at which the position changes
    still = walks([40] * 8, 5)
    simultaneous = [Recording(0 * r.times, r.readings, r.inputs, r.truth) for r in still]
    result = fit(line_tracker(sigma=30.0), stack(simultaneous), NLL, LEVELS, FitOptions(starts=4, steps=1))
    assert result.trace is not result.starts[0], "a start of the grid is to win, in one step"
    assert result.values["motion.sigma_v"] == pytest.approx(0.3, rel=1e-12)


def test_held_out_recordings_select_the_best_point():
    quiet, loud = stack(walks([40] * 8, 3)), stack(walks([40] * 8, 4, sigma=0.7))
    result = fit(line_tracker(), quiet, NLL, LEVELS, FitOptions(held_out=loud))
    alone = fit(line_tracker(), quiet, NLL, LEVELS)
    # the best fit to the quiet ones is overconfident on the loud ones
    assert result.values["sensors.gauge.sigma"] > alone.values["sensors.gauge.sigma"]


def test_a_level_that_few_readings_determine_stays_near_its_value_before_the_fit():
    made, start = walks([6], 3), line_tracker(sigma=0.4)
    sites, flat = (fit(start, made, NLL, LEVELS, FitOptions(prior=kind)) for kind in ("sites", "flat"))
    name = "sensors.gauge.sigma"
    away, pulled = (abs(np.log(result.values[name] / 0.4)) for result in (flat, sites))
    assert 0.0 < pulled < 0.8 * away
    assert sites.standard_errors[name] / sites.values[name] < 0.35, "no wider than the prior"
    # Many readings outweigh it.
    long = fit(start, walks([500], 4), NLL, LEVELS).values[name]
    assert long == pytest.approx(0.2, rel=0.15)
