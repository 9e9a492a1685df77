"""The paths of simulated trolleys: about as fast as stated, and a fifth of it at random."""

import numpy as np

from trackwright.sim.bodies import CENTRE, SPEED, WANDER, rounds
from trackwright.sim.keys import trajectory_keys


def test_a_trolley_goes_round_at_its_speed_and_wanders_a_fifth_as_fast():
    path = rounds(trajectory_keys(3, np.arange(40)), np.arange(600) / 10.0)
    speed = np.linalg.norm(np.diff(path, axis=1), axis=-1) * 10.0
    assert abs(speed.mean() - SPEED) < 0.02
    # The part along the way of a random motion of 0.1 m/s in two directions.
    assert abs(speed.std() - SPEED / 5 / np.sqrt(2)) < 0.01
    assert 0.2 < speed.min() < speed.max() < 1.0
    assert np.abs(path.mean(axis=(0, 1)) - CENTRE)[:2].max() < WANDER[0]
