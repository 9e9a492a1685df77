"""Paths by arclength, and motions along them."""

import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.line.motion import HaltingMotion, HaltingState, LineMotion, PathState
from trackwright.trackers.line.tracker import line_motion

KNOTS = [[2.615, 8.26], [6.665, 8.26], [6.665, 6.151], [2.615, 6.151], [2.615, 4.065], [6.665, 4.065]]


def _printed(d):
    """Equation (2.5) with its last case corrected: x = 2.615 + d − 12.295."""
    if d <= 4.05:
        return 2.615 + d, 8.26
    if d <= 6.159:
        return 6.665, 8.26 - (d - 4.05)
    if d <= 10.209:
        return 6.665 - d + 6.159, 6.151
    if d <= 12.295:
        return 2.615, 6.151 - (d - 10.209)
    return 2.615 + d - 12.295, 4.065


def test_the_thesis_path_is_its_equation_with_the_last_case_corrected():
    line = Polyline(KNOTS)
    for d in np.linspace(0.0, 16.345, 60):
        np.testing.assert_allclose(list(line.position(jnp.asarray(d))), _printed(d), atol=1e-12)
    np.testing.assert_allclose(line.joins, [4.05, 6.159, 10.209, 12.295], atol=1e-12)
    assert line.length == pytest.approx(16.345)


def test_the_direction_is_the_slope_of_the_place_on_slanting_segments_too():
    line = Polyline([[0.0, 0.0], [3.0, 4.0], [3.0, 9.0], [-2.0, 9.0], [-3.0, 7.0]])
    for d in (0.5, 4.9, 5.1, 9.0, 12.0, 16.0):
        ends = [np.array(list(line.position(jnp.asarray(d + s)))) for s in (1e-6, -1e-6)]
        np.testing.assert_allclose(list(line.direction(jnp.asarray(d))), (ends[0] - ends[1]) / 2e-6, atol=1e-6)


def test_a_step_is_the_printed_one():
    moved = LineMotion(Polyline(KNOTS), 0.2).step(PathState(1.0, 0.5), {}, jnp.asarray(0.25), Vector(-1.0))
    assert (float(moved.arclength), float(moved.speed)) == (pytest.approx(1.125), pytest.approx(0.4))
    assert (
        float(LineMotion(Polyline(KNOTS), 0.2).step(PathState(1.0, 0.5), {}, jnp.asarray(0.25), Vector(-9.0)).speed)
        == 0
    )


def test_a_tag_that_reaches_a_join_rests_on_it_or_goes_on_and_leaves_again():
    motion = HaltingMotion(Polyline(KNOTS), 0.1, halting=0.3, rest=4.0, sigma_departure=0.5)
    dt = jnp.asarray(1.0)
    halted = motion.step(HaltingState(4.0, 0.5, 0.0), {}, dt, Vector(0.0, -0.6))
    assert [float(x) for x in halted] == [pytest.approx(4.05), 0.0, 1.0]
    passed = motion.step(HaltingState(4.0, 0.5, 0.0), {}, dt, Vector(0.0, -0.5))
    assert [float(x) for x in passed] == [pytest.approx(4.5), 0.5, 0.0]
    still = motion.step(halted, {}, dt, Vector(2.0, 0.0))
    assert [float(x) for x in still] == [pytest.approx(4.05), 0.0, 1.0]
    left = motion.step(halted, {}, dt, Vector(-2.0, -2.0))
    assert [float(x) for x in left] == [pytest.approx(4.05), 1.0, 0.0]
    onward = motion.step(left, {}, dt, Vector(0.0, -9.0))
    assert [float(x) for x in onward] == [pytest.approx(5.05), 1.0, 0.0]


@pytest.mark.parametrize("closed", [False, True])
def test_a_path_of_many_knots_is_the_polyline_through_them(closed):
    angles = np.linspace(0.0, 2 * np.pi if closed else 5.0, 40)
    knots = np.stack([2 * np.cos(angles), np.sin(angles)], axis=1)
    knots[-1] = knots[0] if closed else knots[-1]
    line = Polyline(knots)
    starts = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    d = np.linspace(1e-6, line.length - 1e-6, 333)
    points = np.stack([np.interp(d, starts, axis) for axis in knots.T])
    np.testing.assert_allclose(list(line.position(jnp.asarray(d))), points, atol=1e-9)
    directions = (np.asarray(list(line.position(jnp.asarray(d + 1e-7)))) - points) / 1e-7
    np.testing.assert_allclose(list(line.direction(jnp.asarray(d))), directions, atol=1e-5)
    joins = starts[1:] if closed else starts[1:-1]
    expected = [min((j for j in joins if j > x), default=np.inf) for x in d]
    np.testing.assert_allclose(line.next_join(jnp.asarray(d)), expected, atol=1e-9)


def test_knots_that_draw_a_curve_are_no_places_to_rest():
    angles = np.linspace(0.0, 6.0, 61)
    assert isinstance(line_motion(Polyline(np.stack([np.cos(angles), np.sin(angles)], axis=1))), LineMotion)
    assert isinstance(line_motion(Polyline(KNOTS)), HaltingMotion)
    assert isinstance(line_motion(Polyline(KNOTS[:2])), LineMotion)
