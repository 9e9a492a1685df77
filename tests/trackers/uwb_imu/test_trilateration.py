"""Trilateration: the paper's closed form where it exists, and circles that touch, miss or share a centre."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.uwb_imu.trilateration import compensation, intersections, trilaterate, trilateration_tracker

ROUNDING = 1e-11


@pytest.fixture(scope="module")
def meet():
    """Both points of two circles, (2, 2)."""

    @jax.jit
    def both(first, second, radius, other):
        points = intersections(Vector(*first), Vector(*second), radius, other)
        return jnp.stack([p.array() for p in points])

    def call(first, second, radius, other):
        return np.array(both(*(jnp.asarray(x, float) for x in (first, second, radius, other))))

    return call


@pytest.fixture(scope="module")
def locate():
    """The trilaterated position, (2,)."""
    solve = jax.jit(lambda anchors, radii: trilaterate([Vector(*a) for a in anchors], list(radii)).array())
    return lambda anchors, radii: np.array(solve(jnp.asarray(anchors, float), jnp.asarray(radii, float)))


def _paper(first, second, radius, other):
    """(11)–(13) with the corrections: the sign in (13), the y of (11), and the point relative to anchor i."""
    dx, dy = second - first
    a, b = dx / dy, (dx**2 + dy**2 - other**2 + radius**2) / (2 * dy)
    epsilon = np.sqrt(a**2 * b**2 - (1 + a**2) * (b**2 - radius**2))
    points = [[(a * b + s * epsilon) / (1 + a**2), (b - s * a * epsilon) / (1 + a**2)] for s in (1, -1)]
    return np.array(points) + first


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
def test_the_points_are_those_of_the_papers_corrected_formula(seed):
    rng = np.random.default_rng(seed)
    first, second, position = rng.uniform(-5, 5, (3, 2))
    if abs(second[1] - first[1]) < 0.1:
        second[1] += 1.0
    radii = np.linalg.norm(position - first), np.linalg.norm(position - second)
    points = intersections(Vector(*first), Vector(*second), *(jnp.asarray(r) for r in radii))
    ours = np.array([[float(x) for x in p] for p in points])
    theirs = _paper(first, second, *radii)
    # The paper's ε is a difference of squares, whose root carries half the digits where circles touch.
    apart = min(np.abs(ours - theirs).max(), np.abs(ours - theirs[::-1]).max())
    assert apart < 1e-6


@pytest.mark.parametrize(
    ("second", "radius", "other", "middle"),
    [([10, 0], 3, 5, [4, 0]), ([1, 0], 5, 2, [4, 0]), ([1, 0], 2, 5, [-3, 0]), ([0, 4], 1, 1, [0, 2])],
    ids=["apart", "the first holds the second", "the second holds the first", "apart along y"],
)
def test_circles_that_miss_each_other_give_the_middle_of_the_gap(meet, second, radius, other, middle):
    points = meet([0, 0], second, radius, other)
    np.testing.assert_allclose(points, [middle, middle], atol=ROUNDING)
    # As far from one circle as from the other.
    assert abs(abs(np.hypot(*points[0]) - radius) - abs(np.hypot(*(points[0] - second)) - other)) < ROUNDING


def test_exact_ranges_give_the_position(locate):
    anchors = np.array([[0.0, 0.0], [6.0, 0.0], [2.0, 5.0]])
    position = np.array([2.7, 2.7])
    # The roots of nearly equal squares keep eleven digits.
    np.testing.assert_allclose(locate(anchors, np.linalg.norm(position - anchors, axis=1)), position, atol=1e-10)


def test_anchors_on_one_line_leave_two_mirror_images_and_no_nan(locate):
    anchors = np.array([[0.0, 0.0], [2.0, 2.0], [5.0, 5.0]])
    position = np.array([3.0, 1.0])
    located = locate(anchors, np.linalg.norm(position - anchors, axis=1))
    # Each pair's point is on either side of the line; along the line they agree.
    assert abs((located - position) @ [1.0, 1.0]) < 1e-9


def test_compensation_lengthens_every_range_and_moves_no_tag_in_the_middle(locate):
    anchors = 4.0 * np.array([[np.cos(t), np.sin(t)] for t in 2 * np.pi * np.arange(3) / 3])
    assert abs(float(compensation(0.1)) - 1.96 * 0.1 / np.sqrt(3)) < 1e-15
    np.testing.assert_allclose(locate(anchors, np.full(3, 4.0) + compensation(0.1)), 0.0, atol=1e-9)
    position = np.array([1.5, 0.4])
    exact = np.linalg.norm(position - anchors, axis=1)
    # Ranges that are right already are made wrong by 11 cm.
    assert 0.005 < np.linalg.norm(locate(anchors, exact + compensation(0.1)) - position) < 0.3


def test_the_tracker_waits_for_rows_with_three_ranges():
    anchors = np.array([[0.0, 0.0, 2.0], [6.0, 0.0, 2.5], [2.0, 5.0, 1.0]])
    positions = np.array([[2.0, 1.0, 0.5], [2.1, 1.2, 0.5], [2.2, 1.4, 0.5]])
    ranges = np.linalg.norm(positions[:, None] - anchors, axis=2)
    seen = np.ones((3, 3), bool)
    seen[1, 2] = False
    inputs = {"anchors": np.tile(anchors.ravel(), (3, 1)), "height": np.full(3, 0.5)}
    recording = Recording(np.arange(3.0), {RANGES: Readings(ranges, seen)}, inputs)
    estimates = trilateration_tracker(compensated=False).run(recording)
    estimated = np.stack([np.asarray(x) for x in estimates.mean.position], axis=1)
    assert estimates.usable.tolist() == [True, False, True]
    np.testing.assert_allclose(estimated[[0, 2]], positions[[0, 2], :2], atol=1e-9)
