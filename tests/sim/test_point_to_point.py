"""Point-to-point hand motion: rests, order, speed profile."""

import numpy as np
import pytest

from trackwright.sim.keys import trajectory_keys
from trackwright.sim.paths import point_to_point

POINTS = np.array([[0.0, 0.0, 0.1], [0.3, 0.0, 0.1], [0.0, 0.3, 0.1], [0.3, 0.3, 0.1]])
TIMES = np.arange(0, 20, 0.05)


@pytest.fixture(scope="module")
def paths():
    """Twenty paths over four points, one second at rest on each."""
    return point_to_point(trajectory_keys(3, np.arange(20)), TIMES, POINTS, speed=0.3, rest_s=1.0)


def _nearest(paths):
    apart = np.linalg.norm(paths[:, :, None] - POINTS, axis=-1)
    return apart.argmin(axis=-1), apart.min(axis=-1)


def test_a_path_rests_at_the_points_and_reaches_all_of_them(paths):
    at, off = _nearest(paths)
    # A second at rest, then 1 s for the sides and 1.4 s for the diagonals.
    assert 0.4 < np.mean(off < 1e-9) < 0.65
    assert set(at[off < 1e-9]) == {0, 1, 2, 3}


def test_no_point_follows_itself(paths):
    at, off = _nearest(paths)
    for row, still in zip(at, off < 1e-9, strict=True):
        begun = np.flatnonzero(still & ~np.append(False, still[:-1]))
        assert np.all(np.diff(row[begun]) != 0)


def test_motions_have_the_speed_profile_of_minimum_jerk(paths):
    speed = np.linalg.norm(np.diff(paths, axis=1), axis=-1) / 0.05
    # Minimum jerk: 15/8 of the mean speed in the middle, zero at the ends.
    assert speed.max() == pytest.approx(0.3 * 15 / 8, rel=0.02)
    # The largest acceleration is 10/√3 of distance over time squared, largest for the shortest distance, 0.3 m in 1 s.
    assert np.abs(np.diff(speed, axis=1)).max() / 0.05 < 10 / np.sqrt(3) * 0.3


def test_a_path_depends_on_its_own_id_alone(paths):
    alone = point_to_point(trajectory_keys(3, np.array([7])), TIMES, POINTS, speed=0.3, rest_s=1.0)
    assert np.array_equal(alone[0], paths[7])


def test_a_single_point_and_speeds_that_are_not_positive_are_refused():
    keys = trajectory_keys(0, np.arange(1))
    with pytest.raises(ValueError, match="2 points"):
        point_to_point(keys, TIMES, POINTS[:1])
    with pytest.raises(ValueError, match="positive"):
        point_to_point(keys, TIMES, POINTS, speed=0.0)
