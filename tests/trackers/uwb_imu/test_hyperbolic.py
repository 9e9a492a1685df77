"""Positions from range differences: exact where the differences are, robust, and none where they determine none."""

import numpy as np
import pytest

from trackwright.trackers.uwb_imu.hyperbolic import Differences, hyperbolic_positions

ROOM = np.array(
    [[0, 0, 0.2], [8, 0, 2.7], [8, 6, 0.3], [0, 6, 2.6], [4, 0, 2.5], [4, 6, 0.2], [0, 3, 0.4], [8, 3, 2.4]], float
)
RING = np.array([(k, (k + 1) % 8) for k in range(8)] * 2)
STAR = np.array([(k, 2) for k in range(8) if k != 2] * 2)
RNG = np.random.default_rng(5)
MIXED = np.array([RNG.permutation(8)[:2] for _ in range(20)])
INSIDE = RNG.uniform([1.0, 1.0, 0.2], [7.0, 5.0, 2.0], (40, 3))
BESIDE = RNG.uniform([9.0, -3.0, 0.2], [12.0, 8.0, 2.5], (40, 3))


def _solved(positions, pairs, known=False, anchors=ROOM, noise=0.0):
    distances = np.linalg.norm(positions[:, None] - anchors, axis=2)
    values = distances[:, pairs[:, 0]] - distances[:, pairs[:, 1]] + noise
    first, second = (np.tile(pairs[:, k], (len(positions), 1)) for k in range(2))
    heights = positions[:, 2] if known else np.full(len(positions), np.nan)
    return hyperbolic_positions(Differences(values, np.isfinite(values), first, second, anchors), heights)


@pytest.mark.parametrize("positions", [INSIDE, BESIDE], ids=["inside", "beside"])
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("pairs", [RING, STAR, MIXED], ids=["ring", "star", "mixed"])
def test_exact_differences_of_any_pairs_give_the_position(positions, pairs, known):
    places, determined = _solved(positions, pairs, known)
    assert determined.all()
    # The ridge leaves a thousandth of what a step moves.
    np.testing.assert_allclose(places, positions, atol=2e-3)


def test_a_tenth_of_wild_values_costs_centimetres():
    wild = np.random.default_rng(6)
    noise = 0.05 * wild.normal(size=(40, 20))
    noise[:, [3, 11]] += wild.choice([-30.0, 5.0, 200.0], (40, 2))
    places, determined = _solved(INSIDE, MIXED, True, noise=noise)
    assert determined.all()
    assert np.linalg.norm(places - INSIDE, axis=1).max() < 0.25


@pytest.mark.parametrize("known", [False, True])
def test_one_anchor_more_than_needed_must_agree(known):
    least = 4 if known else 5
    for count in (least - 1, least):
        pairs = np.array([(k, 0) for k in range(1, count)] * 2)
        places, determined = _solved(INSIDE, pairs, known)
        assert determined.any() == (count == least)
        np.testing.assert_allclose(places[determined], INSIDE[determined], atol=0.01)


def test_below_coplanar_anchors_the_lower_of_both_mirror_images_is_taken():
    ceiling = np.where([True, True, False], ROOM, 2.7)
    places, determined = _solved(INSIDE, MIXED, anchors=ceiling)
    assert determined.all()
    np.testing.assert_allclose(places, INSIDE, atol=0.02)
