"""Range differences: whitening and likelihood against dense covariances, messages, masks, starts, consistency."""

from dataclasses import replace

import jax
import numpy as np
import polars as pl
import pytest
from scipy.stats import t as student_t

from tests.known_start import NEVER_LOST
from tests.oracles import joint_conditioning, van_loan
from trackwright.trackers.catalogue import build, fitting
from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.uwb_imu.difference_rows import (
    BEYOND,
    MOST_SLOTS,
    SHARED,
    correlations,
    difference_trajectories,
)
from trackwright.trackers.uwb_imu.fusion import TDOA, RangeDifferenceSensor, difference_tracker

STAR = [(1, 0), (2, 0), (3, 0)]
CHAIN = [(1, 0), (2, 1), (3, 2)]
LOOP = [(1, 0), (2, 1), (0, 2)]
APART = [(1, 0), (3, 2), (5, 4)]
DOF, SIGMA = 4.0, 0.2


def _dense(pairs, sigmas):
    """The covariance of differences whose times of arrival have variance σ²/2 each, but for the share of their own."""
    incidence = np.zeros((len(pairs), 6))
    for k, (first, second) in enumerate(pairs):
        incidence[k, first], incidence[k, second] = 1.0, -1.0
    return np.outer(sigmas, sigmas) * (0.5 * SHARED * incidence @ incidence.T + (1 - SHARED) * np.eye(len(pairs)))


@pytest.mark.parametrize("pairs", [STAR, CHAIN, LOOP, APART], ids=["star", "chain", "loop", "apart"])
@pytest.mark.parametrize("seen", [(True, True, True), (True, False, True), (False, False, False)])
def test_a_message_is_whitened_by_its_dense_covariance(pairs, seen):
    rng = np.random.default_rng(1)
    errors, variances, seen = 0.3 * rng.normal(size=3), rng.uniform(0.0, 0.05, 3), np.array(seen)
    of_pairs = correlations(np.array([pairs]), np.array([seen]))[0]
    reading = Reading(list(errors), list(seen), [*variances, *of_pairs])
    residual = RangeDifferenceSensor(3, SIGMA, DOF).residual(reading, [0.0, 0.0, 0.0])
    covariance = _dense(pairs, np.sqrt(SIGMA**2 + variances))[np.ix_(seen, seen)]
    factor = np.linalg.cholesky(covariance) if seen.any() else np.zeros((0, 0))
    whitened = np.linalg.solve(factor, errors[seen])
    np.testing.assert_allclose(np.array(residual.whitened)[seen], whitened, rtol=1e-9)
    assert not np.array(residual.whitened)[~seen].any()
    squares = np.array(residual.whitened) ** 2
    density = float(residual.log_scale) - 0.5 * (DOF + 1) * np.log1p(squares / DOF).sum()
    expected = student_t.logpdf(whitened, DOF).sum() - np.log(np.diag(factor)).sum()
    assert density == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert float(residual.nis_dof) == seen.sum()


def test_likelihood_and_moments_are_those_of_dense_conditioning():
    """Anchors so far that distances are linear, normal noise: all states and readings are jointly normal."""
    rng, rows, constant, sigma_a, sigma_bias = np.random.default_rng(2), 8, 7.0, 0.6, 0.3
    directions = rng.normal(size=(4, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    anchors = -1e7 * directions
    times, pairs = np.cumsum(rng.uniform(0.1, 0.5, rows)), np.array(STAR)
    H = np.zeros((3, 10))
    for k, (first, second) in enumerate(pairs):
        H[k, :3] = directions[first] - directions[second]
        H[k, 6 + first], H[k, 6 + second] = 1.0, -1.0
    values, seen = 0.4 * rng.normal(size=(rows, 3)), rng.random((rows, 3)) > 0.3
    given = correlations(np.tile(pairs, (rows, 1, 1)), seen)
    inputs = {
        "pairs": np.tile(anchors[pairs].ravel(), (rows, 1)),
        "pair": np.tile(pairs.ravel().astype(float), (rows, 1)),
        "nearby": np.tile([0.0, 0.0, 0.0, 1.0], (rows, 1)),
        "height": np.zeros(rows),
    }
    tracker = difference_tracker(
        4, 3, False, sigma_a, sigma_a, 5.0, SIGMA, 1e6, sigma_bias, time_constant=constant, length=1e9
    )
    readings = Readings(values, seen, np.concatenate([np.zeros((rows, 3)), given], axis=1))
    estimates = replace(tracker, track_loss=NEVER_LOST).run(Recording(times, {TDOA: readings}, inputs))
    A = np.zeros((10, 10))
    A[:3, 3:6], A[3:6, 3:6], A[6:, 6:] = np.eye(3), -np.eye(3) / 5.0, -np.eye(4) / constant
    noise = np.diag([*[0.0] * 3, *[sigma_a**2] * 3, *[2 * sigma_bias**2 / constant] * 4])
    links = [van_loan(A, noise, dt) for dt in np.diff(times)]
    cov = np.diag([*[1.0] * 6, *[sigma_bias**2] * 4])
    R = _dense(STAR, np.full(3, SIGMA))
    means, covs, density = joint_conditioning(links, H, R, values[1:], seen[1:], np.zeros(10), cov)
    mean = np.stack([np.asarray(x) for x in jax.tree_util.tree_leaves(estimates.mean)], axis=-1)
    # A million degrees of freedom, and distances of 10,000 km, are normal and linear to five digits.
    np.testing.assert_allclose(mean[1:], means, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(estimates.covariance[1:], covs, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(estimates.log_likelihood[1:], density, rtol=1e-4, atol=1e-4)


ANCHORS = {
    f"A{k}": np.array(place, float)
    for k, place in enumerate([(0, 0, 0.2), (8, 0, 2.7), (8, 6, 0.3), (0, 6, 2.6), (4, 0, 2.5), (4, 6, 0.2)])
}
TIMES = np.arange(0.0, 15.0, 0.1)
PATH = np.column_stack([4 + 2 * np.cos(TIMES / 2), 3 + 1.5 * np.sin(TIMES / 2), np.full(len(TIMES), 1.1)])


def _folder(pairs, sigma=0.05, height=None, change=lambda table: table):
    """A tag on an ellipse in a room of six anchors: the differences of these pairs ten times a second, with truth."""
    rng, ids = np.random.default_rng(3), list(ANCHORS)
    distances = np.linalg.norm(PATH[:, None] - np.array(list(ANCHORS.values())), axis=2)
    arrival = distances + sigma / np.sqrt(2) * rng.normal(size=distances.shape)
    rows = [
        {
            "t_s": t,
            "tag": "T",
            "anchor": ids[i],
            "anchor_2": ids[j],
            "range_difference_m": arrival[k, i] - arrival[k, j],
        }
        for k, t in enumerate(TIMES)
        for i, j in pairs
    ]
    truth = pl.DataFrame({"t_s": TIMES, "tag": "T", **dict(zip(("x_m", "y_m", "z_m"), PATH.T, strict=True))})
    rig = Rig("room", anchors=ANCHORS, tags={"T": Tag(height=height)})
    return RecordingFolder("room", None, rig, {TDOA: change(pl.DataFrame(rows)), "truth": truth})


RING = [(k, (k + 1) % 6) for k in range(6)]


@pytest.mark.slow
@pytest.mark.parametrize("height", [1.1, pytest.param(None, marks=pytest.mark.slow)])
def test_a_folder_of_differences_alone_is_tracked(height):
    folder = _folder(RING, height=height)
    assert fitting(folder) == TDOA
    tracker = build(TDOA, folder)
    for named in (tracker, tracker.smoothing()) if height is None else (tracker,):
        table = named.run(folder).to_polars().filter(pl.col("t_s") > 2.0)
        errors = table.select("x_m", "y_m").to_numpy() - PATH[TIMES > 2.0, :2]
        # Six differences of 5 cm a row; the biases that the tracker allows for are not in this world.
        assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.06


def test_the_differences_of_a_time_are_one_row_and_longer_messages_several():
    (trajectory,) = difference_trajectories(_folder(RING), False)
    readings = trajectory.recording.readings[TDOA]
    assert readings.values.shape == (len(TIMES), 8)
    assert (readings.seen.sum(axis=1) == 6).all()
    (trajectory,) = difference_trajectories(_folder([(i, j) for i in range(6) for j in range(6) if i != j]), False)
    assert trajectory.recording.readings[TDOA].values.shape == (2 * len(TIMES), MOST_SLOTS)
    assert trajectory.recording.readings[TDOA].seen.sum() == 30 * len(TIMES)


def test_a_message_of_fifteen_differences_is_whitened_as_one():
    everyone = [(i, j) for i in range(6) for j in range(i)]
    (trajectory,) = difference_trajectories(_folder(everyone, change=lambda table: table.head(30)), False)
    readings = trajectory.recording.readings[TDOA]
    values, seen, reported = (np.asarray(x)[0] for x in (readings.values, readings.seen, readings.reported))
    reading = Reading(list(values), list(seen), list(reported))
    residual = RangeDifferenceSensor(len(values), SIGMA, DOF).residual(reading, [0.0] * len(values))
    factor = np.linalg.cholesky(_dense(everyone, np.full(15, SIGMA)))
    np.testing.assert_allclose(np.array(residual.whitened)[seen], np.linalg.solve(factor, values[seen]), rtol=1e-6)


def test_a_difference_beyond_the_distance_of_its_anchors_is_no_reading():
    def wild(table):
        limit = 8.0 + BEYOND
        changed = pl.when(pl.int_range(pl.len()) == 6).then(limit + 5.0).otherwise("range_difference_m")
        return table.with_columns(range_difference_m=changed)

    (trajectory,) = difference_trajectories(_folder(RING, change=wild), False)
    assert (~trajectory.recording.readings[TDOA].seen[:, :6]).sum() == 1


def test_reported_standard_deviations_are_used():
    def with_std(table):
        return table.with_columns(range_difference_std_m=pl.lit(0.3))

    (trajectory,) = difference_trajectories(_folder(RING, change=with_std), False)
    reported = trajectory.recording.readings[TDOA].reported
    np.testing.assert_allclose(reported[:, :6], 0.09)
    # Neighbours in the ring have one anchor in common, to and from it.
    np.testing.assert_allclose(reported[:, 8], -0.5 * SHARED)


def test_starts_near_the_truth_ten_times_in_two_seconds():
    (trajectory,) = difference_trajectories(_folder(RING, change=lambda table: table.head(120)), False)
    nearby = trajectory.recording.inputs["nearby"]
    known = nearby[:, 3] > 0
    assert known.sum() == 10
    # The differences of a second, in which the tag moves by a metre.
    assert np.linalg.norm(nearby[known, :2] - PATH[:20][known, :2], axis=1).max() < 0.6
