"""The workshop's world: a route within the limits of the vehicle, and corruptions of fixes with their stated statistics."""

import numpy as np
import pytest

from trackwright.sim.agv import Route, VehicleDraw
from trackwright.sim.corruptions import correlated_noise, delayed
from trackwright.sim.keys import trajectory_keys
from trackwright.trackers.mhk.tracker import STILL

TIMES = np.arange(400) / 10.0
STRAIGHT = (TIMES[:, None] * np.array([0.5, -0.2, 0.1]))[None]


def _apply(piece, values=STRAIGHT, n=1):
    return piece(trajectory_keys(0, np.arange(n)), TIMES, values, np.ones(values.shape, bool))[0]


@pytest.mark.parametrize("speed", [0.3, 1.4])
def test_the_vehicle_keeps_its_speed_within_its_limits(speed):
    world = VehicleDraw(speed=speed, errors={}).drawn(3)
    velocity = np.diff(world.positions, axis=1) * 10
    assert world.positions.shape == (3, 2000, 3)
    # Chords of a 1 m corner at 0.14 m a row are shorter than the way by 0.1 %.
    np.testing.assert_allclose(np.linalg.norm(velocity[:, 40:], axis=-1), speed, rtol=2e-3)
    assert np.linalg.norm(np.diff(velocity, axis=1) * 10, axis=-1).max() < 2.0
    np.testing.assert_array_equal(world.fixes, world.positions)
    np.testing.assert_allclose(Route().distance(world.positions[..., :2]), 0.0, atol=1e-12)


def test_the_route_closes_and_is_as_long_as_its_parts():
    route = Route(8.0, 5.0, 0.7)
    assert route.length == pytest.approx(2 * (8 + 5 - 4 * 0.7) + 2 * np.pi * 0.7)
    places = route.at(np.linspace(0, route.length, 20001))
    np.testing.assert_allclose(places[0], places[-1], atol=1e-12)
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).sum() == pytest.approx(route.length, rel=1e-6)
    np.testing.assert_allclose(np.abs(places).max(axis=0), [4.0, 2.5])


def test_noise_has_the_papers_covariance():
    found = np.cov(_apply(correlated_noise(STILL), np.zeros((50, 400, 3)), 50).reshape(-1, 3).T)
    # 20,000 draws: a covariance is known to about 1/100 of the product of its two sigmas, here four times that.
    sigmas = np.sqrt(np.diag(STILL))
    assert np.abs((found - STILL) / np.outer(sigmas, sigmas)).max() < 0.04


def test_a_delayed_fix_is_the_earlier_position():
    np.testing.assert_allclose(_apply(delayed(0.4))[0, 4:], STRAIGHT[0, :-4], atol=1e-12)
