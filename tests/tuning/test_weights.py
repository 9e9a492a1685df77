"""Weights of trajectories: equal say of recordings, and fits that are those of repeated trajectories."""

import numpy as np
import pytest
from scipy import stats

import trackwright as tw
from tests.tuning.worlds import line_tracker, walks
from trackwright.trackers.core.data.recording import stack
from trackwright.tuning.named_objectives import all_metrics, parse_objective
from trackwright.tuning.optimum import optimum
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem
from trackwright.tuning.uncertainty import uncertainty
from trackwright.tuning.weights import trajectory_weights

LEVELS = ("motion.sigma_v", "sensors.gauge.sigma")


def test_the_rows_of_every_recording_add_up_to_the_same():
    batches = [stack(walks([30, 60], 1)), stack(walks([200], 2))]
    found = trajectory_weights(batches, [["a", "b"], ["b"]], "recordings", needs_truth=False)
    # 290 rows of two recordings: 145 each
    np.testing.assert_allclose(np.concatenate(found), [145 / 30, 145 / 260, 145 / 260])
    assert (
        np.concatenate(trajectory_weights(batches, [["a", "b"], ["b"]], "rows", needs_truth=False)).tolist() == [1] * 3
    )
    equal = trajectory_weights([stack(walks([50, 50, 50], 1))], [["a", "b", "c"]], "recordings", needs_truth=False)
    assert equal[0].tolist() == [1.0] * 3


def test_rows_with_truth_count_where_the_objective_judges_them():
    made = walks([40, 40], 3)
    position, known = made[1].truth["position"]
    made[1].truth["position"] = (position, known & (np.arange(40) < 10))
    (found,) = trajectory_weights([stack(made)], [["a", "b"]], "recordings", needs_truth=True)
    np.testing.assert_allclose(found, [25 / 40, 25 / 10])


@pytest.mark.parametrize("objective", ["nll", "state-nll", pytest.param("rmse", marks=pytest.mark.slow)])
@pytest.mark.parametrize("copies", [pytest.param(1, id="few"), pytest.param(20, id="many", marks=pytest.mark.slow)])
def test_a_weight_of_three_is_three_trajectories(objective, copies):
    tracker, made = line_tracker(), walks([30, 45] * copies, 4)
    parameters, goal = select_parameters(tracker, LEVELS), parse_objective(objective, "position", 1)
    weights = np.tile([1.0, 3.0], copies)
    weighted = Problem(tracker, [stack(made)], goal, parameters, weights=[weights])
    thrice = [r for r, w in zip(made, weights, strict=True) for _ in range(int(w))]
    repeated = Problem(tracker, [stack(thrice)], goal, parameters)
    vectors = flatten(parameters) + np.array([[0.0, 0.0], [0.4, -0.3]])
    one, other = weighted.evaluate(vectors), repeated.evaluate(vectors)
    np.testing.assert_allclose(one.values, other.values, rtol=1e-12)
    np.testing.assert_allclose(one.gradients, other.gradients, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(weighted.values(vectors), repeated.values(vectors), rtol=1e-12)
    model, copy = optimum(weighted, vectors[0]), optimum(repeated, vectors[0])
    np.testing.assert_allclose(model.hessian, copy.hessian, rtol=1e-7, atol=1e-10)
    found = all_metrics(tracker, [stack(made)], "position", 1, weights=[weights])
    assert found[objective] == pytest.approx(other.values[0], rel=1e-9)


def test_the_observed_information_of_a_weighted_likelihood_is_that_of_its_recordings():
    """A + B of differences of each recording's own likelihood, which are evaluated without weights."""
    tracker, made = line_tracker(), walks([300, 60, 120], 5)
    parameters, weights = select_parameters(tracker, LEVELS), np.array([0.5, 3.0, 1.0])
    goal = parse_objective("nll")
    problem = Problem(tracker, [stack(made)], goal, parameters, weights=[weights])
    vector, step = flatten(parameters), 0.02
    own = []
    for recording in made:
        alone = Problem(tracker, [stack([recording])], goal, parameters)
        shifted = alone.evaluate(np.concatenate([vector + step * np.eye(2), vector - step * np.eye(2)]))
        rows = (shifted.gradients[:2] - shifted.gradients[2:]) / (2 * step) * shifted.sums[:2, 1:]
        own.append(0.5 * (rows + rows.T))
    A, B = (sum(w**k * H for w, H in zip(weights, own, strict=True)) for k in (1, 2))
    found = uncertainty(problem, vector)
    np.testing.assert_allclose(found.observed, np.linalg.inv(A) @ B @ np.linalg.inv(A), rtol=1e-6)


@pytest.mark.slow
def test_intervals_of_recordings_of_unequal_length_hold_the_truth():
    """Recovery over simulated worlds: a long recording and nine short ones, each with the same say."""
    inside = []
    for seed in range(120):
        found = tw.fit(line_tracker(), walks([1200] + [60] * 9, 100 + seed), "nll", LEVELS)
        ends = found.uncertainty.intervals()
        inside.append([ends[n][0] < true < ends[n][1] for n, true in zip(LEVELS, (0.3, 0.2), strict=True)])
    low, high = stats.binom.ppf([0.002, 0.998], 120, 0.95) / 120
    assert np.all((low <= np.mean(inside, axis=0)) & (np.mean(inside, axis=0) <= max(high, 0.99)))


def test_a_long_recording_decides_a_fit_only_by_rows():
    made = [*walks([600], 6, sigma=0.2), *walks([60], 7, sigma=0.8)]
    sigma = {
        weigh: float(
            tw.fit(line_tracker(), made, "nll", "sensors.gauge.sigma", weigh=weigh).values["sensors.gauge.sigma"]
        )
        for weigh in ("recordings", "rows")
    }
    # squares average to (0.2² + 0.8²) / 2 = 0.58², and by rows to 0.30²; the motion takes a part of the errors
    assert sigma["rows"] < 0.36
    assert 0.45 < sigma["recordings"] < 0.65
