"""Robust least squares on ranges: exact positions, minimum of the loss, outliers, mirror images, too few anchors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.parts.multilaterate import RangePlaces, multilaterate, recent_positions, recent_rows
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


@pytest.fixture(scope="module")
def rows_of_ranges():
    """Two tags' rows at .2 s, each of the six anchors every time; half of them lost, a tenth too long, silent for 2 s."""
    rng = np.random.default_rng(5)
    times = np.tile(np.repeat(np.delete(np.arange(60), np.arange(30, 40)) * 0.2, 6), 2)
    numbers, starts = np.tile(np.arange(6), 100), np.array([0, 300, 600])
    place = np.stack([np.sin(times), np.cos(0.7 * times), 1.0 + 0.1 * times / 12], axis=1)
    ranges = np.linalg.norm(place - ANCHORS[numbers], axis=1) + rng.normal(0, 0.05, 600)
    return starts, times, numbers, ranges + (rng.random(600) < 0.1) * 1.5, rng.random(600) < 0.5


@pytest.mark.parametrize("heights", [np.array([np.nan, np.nan]), np.array([1.05, np.nan])], ids=["free", "one known"])
def test_all_rows_of_a_time_have_the_place_from_the_medians_of_the_last_seconds(rows_of_ranges, heights):
    starts, times, numbers, ranges, seen = rows_of_ranges
    found = recent_positions(starts, times, ANCHORS, numbers, ranges, seen, heights)
    windows_used = set()
    for row in range(0, 600, 15):
        tag = int(row >= 300)
        own = np.arange(600)[300 * tag : 300 * tag + 300]
        for window in (1.0, 5.0):
            part = own[(times[own] <= times[row]) & (times[row] - times[own] <= window) & seen[own]]
            latest = [ranges[part[numbers[part] == k][-5:]] for k in range(6)]
            heard = np.array([len(x) > 0 for x in latest])
            medians = np.array([np.median(x) if len(x) else 0.0 for x in latest])
            height = None if np.isnan(heights[tag]) else heights[tag]
            fit = jax.jit(multilaterate)(medians, ANCHORS, heard, height, SCALE)
            if fit.determined:
                break
        windows_used.add(window)
        position = [*fit.position, heights[tag]][:3]
        expected = [*position, 1.0] if fit.determined else np.zeros(4)
        np.testing.assert_allclose(found[row], expected, atol=2e-6)
    assert windows_used == {1.0, 5.0}


def test_places_of_several_trajectories_at_once_are_those_of_each(rows_of_ranges):
    _, times, numbers, ranges, seen = rows_of_ranges
    one = np.array([0, 300])
    recent, windows = recent_rows(np.arange(5, 300, 6), one, times[:300], numbers[:300], np.ones(300, bool), 6)
    slots, of_row = int((windows > 1).sum(axis=2).max()), np.repeat(np.arange(50), 6)
    places = RangePlaces(recent, windows, of_row, ANCHORS, None, np.array([-9.0, 9.0]), slots)
    together = np.stack(np.split(ranges, 2), axis=-1)[:, None], np.stack(np.split(seen, 2), axis=-1)[:, None]
    for k, part in enumerate((slice(300), slice(300, 600))):
        rows = np.flatnonzero(seen[part])
        of = np.array([0, len(rows)]), times[part][rows], ANCHORS, numbers[part][rows], ranges[part][rows]
        alone = recent_positions(*of, np.ones(len(rows), bool), np.array([np.nan]))
        np.testing.assert_allclose(eqx.filter_jit(places)(*together)[rows, :, k], alone, atol=2e-6)
