"""A trajectory has the same numbers in chunks and with two readings in a row; alone: `test_identities.py`."""

import dataclasses

import jax
import numpy as np
import pytest

import trackwright as tw
from tests.known_start import NEVER_LOST, KnownStart, LinearSensor, recording
from trackwright.trackers.core.data.recording import Recording, stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import ConstantVelocity, Kinematic
from trackwright.trackers.core.run.tracker import Tracker


def _kinematic(x):
    return Kinematic(Vector(x[0]), Vector(x[1]))


def _flat():
    sensors = {"a": LinearSensor(np.eye(1, 2), [0.3], 1), "b": LinearSensor(np.eye(1, 2, 1), [0.5], 1)}
    return Tracker(ConstantVelocity(0.7, 1), sensors, KnownStart(_kinematic), track_loss=NEVER_LOST)


LANES, ROWS = 6, 14


def _recordings():
    """Ragged recordings with masks and irregular times, with rows at one time."""
    rng, recordings = np.random.default_rng(0), []
    for trajectory in range(LANES):
        rows = ROWS - 2 * trajectory
        times = 5.0 + np.cumsum(rng.exponential(0.3, rows) * (rng.random(rows) > 0.3))
        readings = {name: (rng.normal(size=(rows, 1)), rng.random((rows, 1)) > 0.3) for name in "ab"}
        recordings.append(recording(times, readings, rng.normal(size=2) * 0.5, np.diag(rng.uniform(0.1, 1.0, 2))))
    return recordings


def _as_tree(e):
    return e.mean, e.cov_upper, e.log_likelihood, e.nis, e.nis_dof, e.wrapped, e.status


def test_chunks_side_by_side_give_what_one_chunk_gives():
    batch = stack(_recordings())
    in_pairs, together = _flat().run(batch, chunk=2), _flat().run(batch)
    for a, b in zip(*map(jax.tree_util.tree_leaves, (_as_tree(in_pairs), _as_tree(together))), strict=True):
        # Another shape is another program, which may round otherwise: 1e-12 is a few thousand roundings.
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_two_readings_in_a_row_are_two_rows_at_one_time_for_linear_sensors():
    both = _recordings()[0]
    twice = {k: np.repeat(v, 2, axis=0) for k, v in both.inputs.items()}
    readings = {}
    for name, rows in (("a", 0), ("b", 1)):
        r = both.readings[name]
        seen = np.repeat(r.seen, 2, axis=0)
        seen[1 - rows :: 2] = False
        # The row that starts a track is not read: both of its readings stand in the first of the two.
        seen[:2] = False
        readings[name] = (np.repeat(r.values, 2, axis=0), seen)
    split = Recording(np.repeat(both.times, 2), {}, twice)
    split = recording(split.times, readings, both.inputs["start_mean"][0], np.diag(both.inputs["start_cov"][0][[0, 2]]))
    estimates = _flat().run(stack([both, split]))
    one, two = estimates[0], estimates[1]
    for a, b in zip(
        *map(jax.tree_util.tree_leaves, ((one.mean, one.cov_upper), (two.mean, two.cov_upper))), strict=True
    ):
        np.testing.assert_allclose(a[..., :ROWS], b[..., 1 : 2 * ROWS : 2], rtol=1e-12, atol=1e-13)
    pairs = two.log_likelihood[: 2 * ROWS].reshape(ROWS, 2).sum(axis=1)
    np.testing.assert_allclose(one.log_likelihood[:ROWS], pairs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("size", [1, 9], ids=["few trajectories", "many"])
def test_with_the_position_alone_estimates_have_its_covariance_and_nothing_else_differs(size):
    batch = stack((_recordings() * 2)[:size])
    whole, part = _flat().run(batch), dataclasses.replace(_flat(), position_alone=True).run(batch)
    assert [*part.sigmas] == ["position.0"]
    assert part.dimension == 1
    np.testing.assert_array_equal(part.cov_upper, whole.cov_upper[:1])
    np.testing.assert_array_equal(part.marginal("position"), whole.marginal("position"))
    rest = [dataclasses.replace(e, cov_upper=e.cov_upper[:1]) for e in (part, whole)]
    for a, b in zip(*(jax.tree_util.tree_leaves(_as_tree(e)) for e in rest), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_trajectory_keeps_its_bits_where_others_alone_are_seen():
    times, places = 0.1 * np.arange(20), 5e3 + 0.01 * np.random.default_rng(0).normal(size=(20, 3))
    gaps = np.where(np.arange(20)[:, None] % 2 == 0, places, np.nan)
    mine, every, same = (tw.baselines.fix_recording(times, x) for x in (gaps, places, gaps))
    covariances = [tw.baselines.fix_tracker().run([mine, other])[0].covariance for other in (every, same)]
    np.testing.assert_array_equal(*covariances)
