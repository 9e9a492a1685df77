"""The objectives: figures made of sums, whatever batches the recordings stand in."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import trackwright as tw
from tests.oracles import kalman
from tests.tuning.worlds import SIGMA_START, line_tracker, walks
from trackwright.trackers.core.data.recording import Recording, stack
from trackwright.tuning.objectives import NegativeLogLikelihood, RootMeanSquareError
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

LENGTHS = [9, 16, 5, 12]
PATTERNS = ("motion.*", "sensors.*")


def _first(found):
    """Figure, gradient and sums of the only vector."""
    return found.values[0], found.gradients[0], found.sums[0]


def _problem(batches, objective, tracker=None, chunk=512):
    tracker = line_tracker() if tracker is None else tracker
    parameters = select_parameters(tracker, PATTERNS)
    return Problem(tracker, batches, objective, parameters, chunk), flatten(parameters)


def _figures(recordings, objective, rows=16, chunk=512):
    problem, vector = _problem([stack(recordings, rows)], objective, chunk=chunk)
    return _first(problem.evaluate(vector))


@pytest.fixture(scope="module")
def recordings():
    return walks(LENGTHS, seed=0)


def test_the_likelihood_is_the_textbook_filters_per_number_read(recordings):
    value, _, sums = _figures(recordings, NegativeLogLikelihood())
    total = count = 0.0
    for r in recordings:
        gauge = r.readings["gauge"]
        dts = np.diff(r.times)
        moves = [(np.eye(1), np.array([[0.3**2 * dt]])) for dt in dts]
        # the row that starts a track is not scored
        out = kalman(
            moves,
            np.eye(1),
            np.array([[0.2**2]]),
            gauge.values[1:],
            gauge.seen[1:],
            np.zeros(1),
            np.eye(1) * SIGMA_START**2,
        )
        total += out[2].sum()
        count += gauge.seen[1:].sum()
    assert sums[1] == count
    assert value == pytest.approx(-total / count, rel=1e-12)


def test_the_root_mean_square_error_is_that_of_the_estimates(recordings):
    value, _, sums = _figures(recordings, RootMeanSquareError(dimensions=1))
    squares = []
    for r in recordings:
        estimates = line_tracker().run(stack([r], 16))[0]
        squares.append((estimates.mean.position[0][: len(r)] - r.truth["position"][0][:, 0]) ** 2)
    assert sums[1] == sum(LENGTHS)
    assert value == pytest.approx(np.sqrt(np.concatenate(squares).mean()), rel=1e-12)


def test_rows_without_truth_do_not_count(recordings):
    r = recordings[1]
    place, known = r.truth["position"]
    half = np.arange(len(r)) < 8
    blind = Recording(r.times, r.readings, r.inputs, {"position": (np.where(half[:, None], place, 1e6), known & half)})
    short = Recording(r.times, r.readings, r.inputs, {"position": (place, half)})
    value, gradient, sums = _figures([blind], RootMeanSquareError(dimensions=1))
    assert sums[1] == 8
    assert value == _figures([short], RootMeanSquareError(dimensions=1))[0]
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("objective", [NegativeLogLikelihood(), RootMeanSquareError(dimensions=1)])
def test_recordings_of_many_lengths_at_once_give_the_figure_of_their_separate_sums(recordings, objective):
    value, gradient, sums = _figures(recordings, objective)
    alone = [_figures([r], objective) for r in recordings]
    added = np.sum([s for _, _, s in alone], axis=0)
    np.testing.assert_allclose(sums, added, rtol=1e-12)
    assert value == pytest.approx(float(objective.value(added)), rel=1e-12)
    # chunks of two, and one batch per length: the same figure in other shapes
    paired = _figures(recordings, objective, chunk=2)
    problem, vector = _problem([stack(recordings[:2], 16), stack(recordings[2:], 16)], objective)
    for other in (paired, _first(problem.evaluate(vector))):
        assert other[0] == pytest.approx(value, rel=1e-12)
        np.testing.assert_allclose(other[1], gradient, rtol=1e-9, atol=1e-14)


def test_padding_changes_no_figure(recordings):
    objective = NegativeLogLikelihood()
    value, gradient, _ = _figures(recordings, objective)
    more, more_gradient, _ = _figures(recordings, objective, rows=40)
    assert more == value
    np.testing.assert_array_equal(more_gradient, gradient)


def test_a_recording_without_a_single_reading_says_nothing_and_spoils_no_gradient(recordings):
    r = recordings[0]
    silent = walks([9], seed=1, missing=1.0)[0]
    assert not silent.readings["gauge"].seen.any()
    objective = NegativeLogLikelihood()
    with_silence, without = (_figures(rs, objective) for rs in ([r, silent], [r]))
    assert with_silence[0] == pytest.approx(without[0], rel=1e-12)
    np.testing.assert_allclose(with_silence[1], without[1], rtol=1e-12)


def test_only_a_likelihood_has_units_of_information():
    assert NegativeLogLikelihood().nats_per_unit(np.array([12.0, 40.0])) == 40.0
    assert np.isnan(RootMeanSquareError().nats_per_unit(np.array([12.0, 40.0])))


def test_a_function_of_state_and_truth_is_an_objective():
    rng = np.random.default_rng(2)
    times = np.arange(40) * 0.2
    path = np.stack([np.cos(times), np.sin(times)], axis=1)
    truth = np.where(np.arange(40)[:, None] % 5 == 0, np.nan, path)
    rows = [
        tw.fix_recording(times[:n], path[:n] + 0.1 * rng.normal(size=(n, 2)), height=1.0, truth=truth[:n], name=str(n))
        for n in (40, 25)
    ]
    tracker = tw.fix_tracker(planar=True)

    def miss(state, truth):
        return jnp.hypot(*(state.position[k] - truth["position"][k] for k in range(2)))

    result = tw.fit(tracker, rows, miss, "motion.sigma_a", steps=6)
    assert result.value < result.start_value
    for model, value in ((tracker, result.start_value), (result.tracker, result.value)):
        estimates = [np.stack(list(model.run(r).mean.position), axis=-1) for r in rows]
        errors = [
            np.linalg.norm(e - path[: len(e)], axis=1)[r.truth["position"][1]]
            for e, r in zip(estimates, rows, strict=True)
        ]
        # Each of the two recordings has the same weight.
        assert value == pytest.approx(np.mean([np.mean(e) for e in errors]), rel=1e-6)
    with pytest.raises(tw.UnusableInput, match="fit: found 3; expected an objective: a name, "):
        tw.fit(tracker, rows, 3)
    with pytest.raises(tw.UnusableInput, match="no known truth; .* the objective miss needs"):
        tw.fit(tracker, tw.fix_recording(times, path, height=1.0), miss)


def test_a_function_is_an_objective_of_folders_and_named_where_it_does_not_fit():
    folder = tw.simulate.agv(n=1, rows=30).folder()
    tracker = tw.build("fix-kf", folder)

    def height_alone(state, truth):
        return (state.position[2] - truth["position"][2]) ** 2

    found = tw.fit(tracker, folder, height_alone, "motion.sigma_z", steps=2, dimensions=3)
    tracks = tw.build("fix-kf", folder).run(folder).table.join(folder.tables["truth"], on=["tag", "t_s"])
    error = (tracks["z_m"] - tracks["z_m_right"]).to_numpy()
    assert found.start_value == pytest.approx(np.mean(error**2), rel=1e-6)
    blind = dataclasses.replace(folder, tables={"fixes": folder.tables["fixes"]})
    with pytest.raises(tw.UnusableInput, match="objective height_alone needs truth, and these recordings have none"):
        tw.fit(tracker, blind, height_alone, "motion.sigma_z")
