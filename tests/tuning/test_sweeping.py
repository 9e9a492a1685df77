"""Sweeps over grids of values: what the fit's own objective says at each, repeats, and grids that can't be swept."""

import numpy as np
import pytest

from tests.tuning.worlds import line_tracker, walks
from trackwright.sim.line import THESIS_KNOTS, simulate_line
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.tunable import Real, Scale
from trackwright.trackers.line.fixes import FIXES, FloorFixes
from trackwright.trackers.line.tracker import line_motion
from trackwright.trackers.line.tracker import line_tracker as particle_tracker
from trackwright.tuning.objectives import NegativeLogLikelihood, RootMeanSquareError
from trackwright.tuning.parameters import Parameter, select_parameters
from trackwright.tuning.problem import Problem
from trackwright.tuning.sweeping import Sweep, grid_vectors, sweep

NLL = NegativeLogLikelihood()
SIGMA_V, SIGMA = "motion.sigma_v", "sensors.gauge.sigma"
STEPS = np.geomspace(0.1, 0.9, 5)
NOISES = np.array([0.1, 0.2, 0.4])


@pytest.fixture(scope="module")
def batches():
    return [stack(walks([130, 140, 125], 1)), stack(walks([260, 250], 2))]


@pytest.fixture(scope="module")
def swept(batches):
    counted = []
    return sweep(line_tracker(), batches, NLL, {SIGMA_V: STEPS, SIGMA: NOISES}, report=counted.append), counted


def test_every_value_is_the_objective_that_a_fit_sees_there(swept, batches):
    parameters = select_parameters(line_tracker(), (SIGMA_V, SIGMA))
    problem = Problem(line_tracker(), batches, NLL, parameters, 512)
    vectors = [np.log([step, noise]) for step in STEPS for noise in NOISES]
    wanted = problem.evaluate(np.array(vectors)).values.reshape(5, 3)
    # double precision, sums in another order
    np.testing.assert_allclose(swept[0].mean, wanted, rtol=1e-10)


def test_the_best_value_is_the_least_and_lies_where_the_walks_were_drawn(swept):
    found = swept[0]
    assert found.mean[found.best_index] == found.mean.min()
    # drawn with 0.3 and 0.2: both are values of the grid
    assert found.best == {SIGMA_V: pytest.approx(0.3), SIGMA: pytest.approx(0.2)}


def test_filter_runs_are_points_times_trajectories_and_progress_counts_points(swept):
    found, counted = swept
    assert found.filter_runs == 15 * 5
    assert sum(counted) == 15


def test_a_tracker_that_draws_nothing_runs_once_whatever_the_repeats(batches):
    found = sweep(line_tracker(), batches, NLL, {SIGMA_V: STEPS}, repeats=7)
    assert found.values.shape == (1, 5)
    assert (found.spread == 0).all()


def test_a_truth_that_is_missing_gives_no_number(batches):
    hidden = [b._replace(truth={"position": (b.truth["position"][0], b.valid & False)}) for b in batches]
    found = sweep(line_tracker(), hidden, RootMeanSquareError(dimensions=1), {SIGMA_V: STEPS})
    assert np.isnan(found.mean).all()


@pytest.fixture(scope="module")
def particles():
    world = simulate_line("constant", 2, 0, speed=1.5, rest_s=1.0)
    rows = len(world.times)
    recordings = [
        Recording(
            world.times,
            {FIXES: Readings(fixes, seen)},
            {"height": np.zeros(rows)},
            {"position": (np.column_stack([place, np.zeros(rows)]), np.ones(rows, bool))},
            str(k),
        )
        for k, (fixes, seen, place) in enumerate(zip(world.fixes, world.seen, world.positions, strict=True))
    ]
    tracker = particle_tracker(line_motion(Polyline(THESIS_KNOTS)), {FIXES: FloorFixes(0.3)}, 50)
    values = {"sensors.fixes.sigma_p": np.array([0.2, 0.4])}
    return sweep(tracker, stack(recordings), RootMeanSquareError(), values, repeats=3)


def test_particles_are_drawn_anew_in_every_repeat(particles):
    assert particles.values.shape == (3, 2)
    assert (particles.spread > 0).all()
    assert particles.filter_runs == 3 * 2 * 2
    np.testing.assert_allclose(particles.mean, particles.values.mean(axis=0))


def test_a_threshold_of_track_loss_is_swept_by_name_and_none_is_left_to_a_fit(batches):
    found = sweep(line_tracker(), batches, NLL, {"track_loss.max_gap": np.array([1e-3, np.inf])})
    # a gap of 1 ms is every row: the track is lost at each, and nothing is measured
    assert np.isfinite(found.values[0, 1])
    assert not found.values[0, 0] < found.values[0, 1]
    assert [p.label for p in select_parameters(line_tracker(), "*")] == [
        "motion.sigma_v",
        "sensors.gauge.sigma",
        "sensors.gauge.offset",
        "sensors.gauge.bias",
    ]


def test_what_a_pattern_names_is_kept_equal_in_all_its_numbers():
    several = Parameter(("a",), Scale(np.array([0.1, 0.2, 0.3])), "a")
    offset = Parameter(("b",), Real(0.0, typical=2.0), "b")
    vectors = grid_vectors([several, offset], [np.array([1.0, np.e]), np.array([0.0, 4.0])])
    np.testing.assert_allclose(vectors, [[0, 0, 0, 0], [0, 0, 0, 2], [1, 1, 1, 0], [1, 1, 1, 2]])


@pytest.mark.parametrize(
    ("over", "words"),
    [
        ({SIGMA_V: [0.0, 0.1]}, "a Scale is positive"),
        ({SIGMA_V: [0.1], SIGMA: [0.1], "*.bias": [0.1]}, "one or two patterns, found 3"),
        ({}, "one or two patterns, found 0"),
        ({"nothing.*": [0.1]}, "matches no tunable"),
        ({SIGMA_V: [0.1], "motion.*": [0.1]}, "match the same tunables"),
        ({"sensors.gauge.*": [0.1]}, "different units or shapes"),
    ],
)
def test_a_grid_that_cannot_be_swept_is_refused(batches, over, words):
    with pytest.raises(ValueError, match=words):
        sweep(line_tracker(), batches, NLL, {k: np.array(v) for k, v in over.items()})


def test_the_spread_is_the_sample_standard_deviation_of_two_repeats():
    repeats = np.array([[1.0, 5.0], [4.0, 5.0]])
    found = Sweep([], [np.array([0.1, 0.2])], repeats, 4)
    # of two numbers: their distance over the root of two
    np.testing.assert_allclose(found.spread, [3 / np.sqrt(2), 0.0])
