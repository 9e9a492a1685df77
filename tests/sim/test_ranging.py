"""Simulated ranges: clocks, obstruction and order of arrival, each against its closed form."""

import numpy as np

from trackwright.sim.corruptions import obstruction, on_anchors, round_robin
from trackwright.sim.imu import ImuDraw, level
from trackwright.sim.keys import trajectory_keys
from trackwright.sim.ranging import CENTRE, CHAMBER, SPEED, WANDER, Protocol, RangeDraw, chamber, rounds, two_way_ranges
from trackwright.trackers.parts.ranges import range_trajectories
from trackwright.trackers.uwb_imu.trilateration import SPEED_OF_LIGHT

TAGS, ROWS = 40, 100
KEYS = trajectory_keys(0, np.arange(TAGS))
DISTANCES = np.broadcast_to(np.array([1.0, 4.0, 7.5, 20.0]), (TAGS, ROWS, 4))
TIMES = np.arange(ROWS) * 0.1


def test_perfect_clocks_and_stamps_give_the_distance():
    ranges = two_way_ranges(KEYS, DISTANCES, Protocol(drift=0.0, sigma_stamp=0.0))
    # Rounding of 0.3 ms in seconds, times the speed of light.
    np.testing.assert_allclose(ranges, DISTANCES, atol=1e-9)


def test_double_sided_ranging_cancels_the_clock_drift():
    ranges = two_way_ranges(KEYS, DISTANCES, Protocol(reply_s=1e-3, drift=1e-5, sigma_stamp=0.0))
    # Four sigmas of a clock times 20 m.
    assert np.abs(ranges - DISTANCES).max() < 4.5e-5 * 20


def test_range_noise_from_time_stamps_agrees_with_its_formula():
    double = two_way_ranges(KEYS, DISTANCES, Protocol(drift=0.0, sigma_stamp=1e-10))
    # With equal replies (2·back − 2·answered − asked + heard − again + end)/4: variance (4 + 4 + 1 + 1 + 1 + 1)/16.
    assert abs(np.std(double - DISTANCES) / (SPEED_OF_LIGHT * 1e-10 * np.sqrt(12) / 4) - 1) < 0.03


def test_obstruction_lengthens_only_the_stated_share_of_the_ranges():
    zero = np.zeros(DISTANCES.shape)
    values, seen = obstruction(0.3, 1.0, 0.25, 0.1)(KEYS, TIMES, zero, zero == 0)
    assert seen.all()
    struck = values > 0
    assert values[struck].min() >= 0.25
    # 16,000 rows of bursts of ten: 1,600 independent ones at most, one sigma is 0.012.
    assert abs(struck.mean() - 0.3) < 0.05
    # The mean of 4,800 exponential numbers is known to 1.5 per cent.
    assert abs(values[struck].mean() - 0.35) < 0.01


def test_round_robin_leaves_one_anchor_per_row_in_turn():
    _, seen = round_robin()(KEYS, TIMES, DISTANCES, np.ones(DISTANCES.shape, bool))
    assert (seen.sum(axis=2) == 1).all()
    assert np.argmax(seen[0], axis=1)[:6].tolist() == [0, 1, 2, 3, 0, 1]


def test_the_folder_has_the_seen_ranges_and_gives_the_rows_of_a_tracker():
    world = RangeDraw(chamber(), n_points=20, corruptions={"turns": round_robin()}).drawn(2, seed=1)
    folder = world.folder("chamber")
    assert folder.tables["ranges"].height == 40
    trajectories = list(range_trajectories(folder, False))
    place, known = trajectories[1].recording.truth["position"]
    assert known.all()
    np.testing.assert_allclose(place, world.positions[1], atol=1e-12)
    distances = np.linalg.norm(place - trajectories[1].recording.inputs["anchors"], axis=1)
    # Double-sided ranging with stamps of 0.1 ns: 2.6 cm.
    assert np.abs(trajectories[1].recording.readings["ranges"].values[:, 0] - distances).max() < 0.15
    assert np.array_equal(np.unique(trajectories[1].recording.inputs["anchors"], axis=0), np.unique(CHAMBER, axis=0))


def test_a_corruption_of_some_anchors_leaves_the_others_unchanged():
    keys, times = trajectory_keys(0, np.arange(2)), np.arange(5.0)
    ranges, seen = np.full((2, 5, 4), 3.0), np.ones((2, 5, 4), bool)
    piece = on_anchors([1, 3], obstruction(0.9, 0.0, 0.5, 0.0))
    found, still_seen = piece(keys, times, ranges, seen)
    assert still_seen.all()
    assert np.array_equal(found[..., [0, 2]], ranges[..., [0, 2]])
    assert set(np.unique(found[..., [1, 3]])) == {3.0, 3.5}
    assert (ranges == 3.0).all()


def test_a_level_body_at_rest_measures_gravity_alone():
    def rest(keys, times):
        return np.ones((len(keys), len(times), 3))

    world = ImuDraw(RangeDraw(chamber(), rest, n_points=4), {}, {}, attitude=level).drawn(2)
    np.testing.assert_allclose(world.accel, np.tile([0.0, 0.0, 9.81], (2, 10, 1)), atol=1e-9)
    np.testing.assert_allclose(world.gyro, 0.0, atol=1e-12)


def test_a_trolley_goes_round_at_its_speed_and_wanders_a_fifth_as_fast():
    path = rounds(trajectory_keys(3, np.arange(40)), np.arange(600) / 10.0)
    speed = np.linalg.norm(np.diff(path, axis=1), axis=-1) * 10.0
    assert abs(speed.mean() - SPEED) < 0.02
    # The part along the way of a random motion of 0.1 m/s in two directions.
    assert abs(speed.std() - SPEED / 5 / np.sqrt(2)) < 0.01
    assert 0.2 < speed.min() < speed.max() < 1.0
    assert np.abs(path.mean(axis=(0, 1)) - CENTRE)[:2].max() < WANDER[0]
