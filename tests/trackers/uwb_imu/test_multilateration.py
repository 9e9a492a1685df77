"""Robust least squares on ranges: exact positions, minimum of the loss, outliers, mirror images, too few anchors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.parts.multilaterate import multilaterate
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.uwb_imu.trilateration import multilateration_tracker

ANCHORS = np.array(
    [[5.0, 0.0, 2.0], [0.0, 6.0, 1.0], [-4.0, -3.0, 2.5], [1.0, -6.0, 2.2], [-5.0, 4.0, 0.3], [4.0, 4.0, 2.8]]
)
POSITION = np.array([0.7, -1.2, 1.1])
SCALE = 0.3


@pytest.fixture(scope="module", params=[POSITION[2], None], ids=["at a known height", "in three dimensions"])
def locate(request):
    """`multilaterate` for ranges and the anchors that count, and how many coordinates it finds."""
    height = request.param
    solve = jax.jit(lambda ranges, anchors, counts: multilaterate(ranges, anchors, counts, height, jnp.asarray(SCALE)))

    def call(ranges, anchors=ANCHORS, counts=None):
        counts = np.ones(len(ranges), bool) if counts is None else counts
        return solve(jnp.asarray(ranges), jnp.asarray(anchors), jnp.asarray(counts))

    return call, 3 if height is None else 2


def _exact(anchors=ANCHORS):
    return np.linalg.norm(POSITION - anchors, axis=1)


def _loss(position, ranges):
    full = np.append(position, POSITION[2])[:3]
    return np.sum(np.log1p(((ranges - np.linalg.norm(full - ANCHORS, axis=1)) / SCALE) ** 2))


def test_exact_ranges_give_the_position(locate):
    call, n = locate
    fit = call(_exact())
    assert bool(fit.determined)
    # Each step leaves a thousandth of the way to the ridge: twenty of them leave the rounding of 6 m.
    np.testing.assert_allclose(fit.position, POSITION[:n], atol=1e-9)


def test_noisy_ranges_give_the_minimum_of_the_loss(locate):
    call, n = locate
    rng = np.random.default_rng(0)
    ranges = _exact() + rng.normal(0.0, 0.1, len(ANCHORS))
    position = np.asarray(call(ranges).position)
    least = _loss(position, ranges)
    around = [_loss(position + d, ranges) for d in rng.normal(0.0, 0.02, (200, n))]
    # Convergence is linear: the remaining excess of the loss is far below the effect of 2 cm.
    assert least <= min(around) + 1e-5


def test_a_range_of_kilometres_has_no_influence(locate):
    call, n = locate
    ranges = _exact()
    ranges[1] += 4000.0
    # A range at 4 km keeps a weight of (0.3/4000)².
    np.testing.assert_allclose(call(ranges).position, POSITION[:n], atol=1e-3)


def test_four_ranges_of_which_one_is_ignored_determine_nothing():
    # Three ranges are met exactly by two positions; the loss hardly counts a fourth one that is hundreds of metres off.
    anchors = 1000.0 * np.array([[0, 0, 0.1], [1, 0, 0.9], [1, 1, 0.1], [0, 1, 0.9]])
    places = 1000.0 * np.random.default_rng(0).uniform(0.3, 0.7, (256, 3))
    ranges = np.linalg.norm(places[:, None] - anchors, axis=-1)
    solve = jax.vmap(lambda r: multilaterate(r, jnp.asarray(anchors), jnp.ones(4, bool), None, jnp.asarray(SCALE)))
    fits = jax.jit(solve)(ranges)
    error = np.linalg.norm(fits.position - places, axis=1)
    assert (error[np.asarray(fits.determined)] < 1e-3).all()
    assert (error > 100.0).any()
    assert np.asarray(fits.determined).mean() > 0.95


def test_coplanar_anchors_give_the_horizontal_position():
    flat = ANCHORS * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.0]
    fit = jax.jit(multilaterate)(_exact(flat), flat, np.ones(6, bool), None, SCALE)
    np.testing.assert_allclose(fit.position[:2], POSITION[:2], atol=1e-6)
    # Either image: below the plane or above it.
    assert abs(abs(float(fit.position[2]) - 2.0) - 0.9) < 1e-5


def test_the_tracker_waits_for_rows_with_enough_ranges_and_reports_a_covariance():
    rng = np.random.default_rng(1)
    rows, sigma = 400, 0.05
    ranges = _exact() + rng.normal(0.0, sigma, (rows, len(ANCHORS)))
    seen = np.ones(ranges.shape, bool)
    seen[0, 1:] = False
    inputs = {"anchors": np.tile(ANCHORS.ravel(), (rows, 1)), "height": np.full(rows, POSITION[2])}
    recording = Recording(np.arange(rows) * 0.1, {RANGES: Readings(ranges, seen)}, inputs)
    estimates = multilateration_tracker(planar=True, sigma_r=sigma).run(recording)
    assert not estimates.usable[0]
    assert estimates.usable[1:].all()
    errors = np.stack([np.asarray(x) for x in estimates.mean.position], axis=1)[1:] - POSITION[:2]
    nees = np.einsum("ti,tij,tj->t", errors, np.linalg.inv(estimates.covariance[1:]), errors)
    # Cauchy's loss with its scale at three sigmas loses a few per cent of efficiency and the covariance grows with it.
    assert 1.7 < nees.mean() < 2.4


def test_rows_solved_side_by_side_are_those_solved_one_by_one():
    # More rows than a block holds, and no multiple of it.
    rows, random = 70, np.random.default_rng(3)
    truth = random.uniform([-4.0, -4.0, 0.0], [4.0, 4.0, 1.0], (rows, 3))
    ranges = np.linalg.norm(truth[:, None] - ANCHORS, axis=2) + 0.05 * random.standard_normal((rows, len(ANCHORS)))
    # Five ranges: with four both images may fit exactly, and rounding chooses one.
    seen = np.ones(ranges.shape, bool)
    seen[np.arange(rows), random.integers(len(ANCHORS), size=rows)] = False
    anchors = np.tile(ANCHORS.ravel(), (rows, 1))
    recording = Recording(np.arange(float(rows)), {RANGES: Readings(ranges, seen)}, {"anchors": anchors})
    estimates = multilateration_tracker(sigma_r=0.1).run(recording)
    solve = jax.jit(lambda r, s: multilaterate(r, ANCHORS, s, None, 0.3).position)
    alone = np.array([solve(r, s) for r, s in zip(ranges, seen, strict=True)])
    np.testing.assert_allclose(np.stack([*estimates.mean.position], axis=-1), alone, atol=1e-6)
