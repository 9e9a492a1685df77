"""Simulated range differences: of the true distances, with errors of arrivals that differences share."""

import numpy as np
import pytest

from trackwright.sim import worlds
from trackwright.sim.corruptions import antenna_biases, drop_outs, white_noise
from trackwright.sim.ranging import CORNERS, DifferenceDraw, chamber
from trackwright.trackers.recordings.kinds import KINDS

RIG = chamber(CORNERS)


def _errors(**given):
    """The numbers of both anchors of each difference (N, 2), by tag and time, and their errors against truth (N,)."""
    folder = DifferenceDraw(RIG, n_points=300, **given).drawn(6, seed=2).folder("world")
    rows = folder.rows("tdoa")
    measured = KINDS["tdoa"].measured(folder.rig, rows)
    return measured.sensors.number, measured.errors(folder.paths.at(rows.tags, rows.starts, rows.times)[0])[:, 0]


@pytest.mark.parametrize(("schedule", "rows"), [("messages", 7), ("turns", 1)])
def test_without_errors_the_differences_are_those_of_the_distances(schedule, rows):
    _, errors = _errors(schedule=schedule)
    assert len(errors) == 6 * 300 * rows
    assert np.abs(errors).max() < 1e-5


def test_the_differences_of_a_message_share_the_noise_of_its_reference():
    number, errors = _errors(corruptions={"white": white_noise(0.1)})
    assert not number[:, 1].any()
    covariance = np.cov(errors.reshape(-1, 7).T)
    # 1,800 messages know a variance to 3 %.
    np.testing.assert_allclose(np.diag(covariance), 0.02, rtol=0.15)
    np.testing.assert_allclose(covariance[np.triu_indices(7, 1)], 0.01, rtol=0.2)


def test_a_lost_signal_takes_all_its_differences_and_the_next_anchor_is_the_reference():
    number, errors = _errors(corruptions={"lost": drop_outs(0.3)})
    assert np.abs(errors).max() < 1e-5
    assert (number[:, 1] < number[:, 0]).all()
    # A message needs its reference: of eight signals at 70 %, 5.6 less the reference.
    assert len(errors) / 1800 == pytest.approx(8 * 0.7 - 1, abs=0.15)
    # The first anchor is the reference of seven tenths of the messages, the second of seven tenths of the rest.
    assert np.mean(number[:, 1] == 1) / np.mean(number[:, 1] == 0) == pytest.approx(0.3, abs=0.06)


def test_a_clock_offset_is_in_both_differences_of_its_anchor_with_opposite_signs():
    number, errors = _errors(schedule="turns", corruptions={"biases": antenna_biases(0.1)})
    # Of the first tag, two turns of the ring: the sum round it is zero.
    of_pairs = errors[:8]
    np.testing.assert_allclose(errors[8:16], of_pairs, atol=1e-5)
    assert sorted(map(tuple, number[:8].tolist())) == [(0, 7), *((k, k - 1) for k in range(1, 8))]
    assert of_pairs.sum() == pytest.approx(0.0, abs=1e-4)
    assert np.abs(of_pairs).max() > 0.05


def test_an_imu_leaves_the_differences_as_they_are_and_is_at_the_same_tags():
    alone, with_imu = (worlds.tdoa(n=2, seed=3, rows=15, imu=imu).folder().tables for imu in (False, True))
    assert with_imu["tdoa"].equals(alone["tdoa"])
    assert len(with_imu["imu"]) == len(with_imu["truth"]) == 2 * 141
    shared = with_imu["truth"].join(alone["truth"], on=["t_s", "tag"])
    assert len(shared) == 2 * 15
    assert np.abs(shared["x_m"] - shared["x_m_right"]).max() < 1e-9
    assert set(worlds.tdoa(n=1, rows=1, imu=True).folder().tables) == {"tdoa", "imu", "truth"}
