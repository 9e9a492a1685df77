"""Paths stay in their volume and move as their docstrings state."""

from functools import partial

import numpy as np
import pytest

from trackwright.sim.keys import trajectory_keys
from trackwright.sim.paths import WORK_VOLUME, hand_motion, helix

ELSEWHERE = np.array([[2.0, -1.0, 0.8], [3.5, 0.5, 1.0]])
KEYS, TIMES = trajectory_keys(0, np.arange(100)), np.arange(200) / 10
EVERY_PATH = {"helix": helix, "hand": hand_motion, "hurried hand": partial(hand_motion, speed=3.0)}


@pytest.mark.parametrize("path", EVERY_PATH.values(), ids=EVERY_PATH.keys())
@pytest.mark.parametrize("volume", [WORK_VOLUME, ELSEWHERE], ids=["work", "elsewhere"])
def test_every_path_stays_within_its_volume(path, volume):
    positions = path(KEYS, TIMES, volume)
    assert positions.shape == (100, 200, 3)
    assert positions.dtype == np.float64
    assert np.all((positions >= volume[0]) & (positions <= volume[1]))


@pytest.mark.parametrize("path", EVERY_PATH.values(), ids=EVERY_PATH.keys())
def test_a_path_is_the_same_in_any_batch(path):
    together, alone = path(KEYS, TIMES), path(trajectory_keys(0, [41]), TIMES)
    assert np.array_equal(alone[0], together[41])


@pytest.mark.parametrize("path", EVERY_PATH.values(), ids=EVERY_PATH.keys())
def test_a_path_sampled_at_fewer_and_irregular_times_is_the_same_path(path):
    some = np.array([0, 1, 5, 6, 30, 77, 199])
    # The products of a hand's path may sum in another order when there are fewer rows.
    np.testing.assert_allclose(path(KEYS, TIMES[some]), path(KEYS, TIMES)[:, some], rtol=0, atol=1e-14)


def test_the_helix_climbs_from_the_floor_to_the_lid_at_its_radius():
    path = helix(KEYS, TIMES, turns=2.0, radius=0.3)[0]
    turned = np.unwrap(np.arctan2(path[:, 1], path[:, 0]))
    np.testing.assert_allclose(np.hypot(path[:, 0], path[:, 1]), 0.3, rtol=1e-12)
    np.testing.assert_allclose(path[:, 2], np.linspace(0, 0.3, 200), atol=1e-12)
    assert turned[-1] - turned[0] == pytest.approx(4 * np.pi)


@pytest.mark.parametrize("volume", [WORK_VOLUME, ELSEWHERE], ids=["work", "elsewhere"])
def test_hand_motion_has_the_stated_speed_and_acceleration(volume):
    dt, speed = 0.02, 0.4
    path = hand_motion(trajectory_keys(0, np.arange(1500)), np.arange(0, 3, dt), volume, speed=speed)
    velocity = np.diff(path, axis=1) / dt
    acceleration = np.diff(velocity, axis=1) / dt
    reach = np.linalg.norm(volume[1] - volume[0]) / 2
    # About 10,000 independent values: a standard error of about 1 % of each, the squash's tails included.
    assert np.sqrt((velocity**2).sum(axis=-1).mean()) == pytest.approx(speed, rel=0.04)
    assert np.sqrt((acceleration**2).sum(axis=-1).mean()) == pytest.approx(2.9 * speed**2 / reach, rel=0.05)
