"""Runs that begin with a belief or continue an earlier run, and random numbers by seed and id."""

import dataclasses

import jax
import numpy as np
import pytest

import trackwright as tw
from tests.known_start import NEVER_LOST, flat
from tests.oracles import kalman, van_loan
from trackwright.trackers.core.model.inputs import trajectory_key_data
from trackwright.trackers.core.model.tunable import Constant
from trackwright.trackers.parts.fixes import FIXES

SIGMA_A, SIGMA = 0.7, 0.2


def _tracker(filter=None):
    start = tw.baselines.fix_tracker(planar=True).start
    sensors = {FIXES: tw.parts.FixSensor(SIGMA, SIGMA)}
    return tw.Tracker(
        tw.parts.ConstantVelocity(SIGMA_A, 2), sensors, start, filter or tw.parts.ExtendedKalman(), NEVER_LOST
    )


def _recording(rows=20, seed=0, id=None, begin=0.0):
    rng = np.random.default_rng(seed)
    times = begin + np.cumsum(rng.uniform(0.05, 0.3, rows))
    position = np.stack([0.5 * times, np.sin(times), np.ones(rows)], axis=1) + SIGMA * rng.normal(size=(rows, 3))
    return dataclasses.replace(tw.baselines.fix_recording(times, position, height=1.0), id=id)


def _prior(mean=(0.0, 0.0, 0.4, 0.8), spread=1.0):
    cov = spread * (np.eye(4) + 0.1)
    upper = tuple(cov[i, j] for i in range(4) for j in range(i, 4))
    return tw.Gaussian(tw.parts.Kinematic(tw.Vector(*mean[:2]), tw.Vector(*mean[2:])), upper), np.array(mean), cov


def test_a_run_from_a_given_belief_is_the_textbook_filter_from_that_prior():
    recording = _recording()
    prior, mean, cov = _prior()
    estimates = _tracker().run(recording, initial=prior)
    A = np.zeros((4, 4))
    A[0, 2] = A[1, 3] = 1.0
    noise = np.diag([0, 0, SIGMA_A**2, SIGMA_A**2])
    steps = [van_loan(A, noise, dt) for dt in np.diff(recording.times, prepend=recording.times[:1])]
    fixes = recording.readings[FIXES]
    means, covs, lls, _ = kalman(
        steps, np.eye(2, 4), SIGMA**2 * np.eye(2), fixes.values[:, :2], fixes.seen[:, :2], mean, cov
    )
    np.testing.assert_allclose(flat(estimates.mean), means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(estimates.covariance, covs, rtol=1e-8, atol=1e-10)
    # The known height is measured, too: a constant per row of the planar motion.
    z = -0.5 * ((fixes.values[:, 2] - 1.0) / SIGMA) ** 2 - np.log(SIGMA) - 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(estimates.log_likelihood, lls + np.where(fixes.seen[:, 2], z, 0.0), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("recordings", "initial", "part"),
    [
        (lambda: [_recording(5)] * 2, lambda: [_prior()[0]], "1 beliefs for 2 recordings"),
        (lambda: [_recording(5)], lambda: ["prior"], "expected one Gaussian"),
        (lambda: [_recording(5)] * 2, lambda: _tracker().run(_recording(5)).final, "after 1 recordings, found 2"),
        (lambda: _recording(5), lambda: _tracker().run(_recording(5)).final, "expected later rows"),
        (lambda: tw.stack([_recording(5)]), lambda: _prior()[0], "found a Batch"),
    ],
)
def test_an_initial_belief_that_does_not_fit_is_refused_in_one_sentence(recordings, initial, part):
    with pytest.raises(tw.UnusableInput, match=part) as caught:
        _tracker().run(recordings(), initial=initial())
    assert "\n" not in str(caught.value)


def test_keys_differ_by_seed_and_by_id_up_to_64_bits():
    ids = [0, 1, 2**31, 2**32, 2**32 + 1, 2**64 - 1]
    keys = np.concatenate([trajectory_key_data(seed, ids) for seed in (0, 1, 2**32)], axis=1)
    assert len(np.unique(keys, axis=1).T) == 18
    np.testing.assert_array_equal(trajectory_key_data(1, ids)[:, 2], trajectory_key_data(1, ids[2:3])[:, 0])
    for wrong in (-1, 2**64, 0.5):
        with pytest.raises(ValueError, match="expected a whole number"):
            trajectory_key_data(0, [wrong])


def test_a_run_inside_a_transformation_names_the_pure_function():
    recording = _recording(5)

    def error(sigma):
        tracker = dataclasses.replace(_tracker(), motion=tw.parts.ConstantVelocity(Constant(sigma), 2))
        return tracker.run(recording).mean.position[0][-1]

    with pytest.raises(TypeError, match=r"traced values.*trackwright.filter_batch"):
        jax.grad(error)(0.5)


def test_a_numerical_failure_is_shown_in_its_row_and_the_next_row_starts_a_track():
    recording = _recording(8)
    fixes = recording.readings[FIXES]
    values = fixes.values.copy()
    # Whitened it overflows.
    values[4, 0] = 1.7e308
    failing = dataclasses.replace(recording, readings={FIXES: tw.Readings(values, fixes.seen, fixes.reported)})
    status = _tracker().run(failing).status
    assert status.tolist() == [tw.Status.OK] * 4 + [tw.Status.NON_FINITE, tw.Status.RESTARTED] + [tw.Status.OK] * 2
