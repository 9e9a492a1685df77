"""The discretised distribution of accelerations: normalised, layers of equal volume, density and mean as published."""

import numpy as np
import pytest

from trackwright.trackers.mhk.accelerations import AccelerationSphere, layers

SPHERE = AccelerationSphere(a_still=0.2, a_full=1.8, p_still=0.5, p_full=0.2)


@pytest.fixture(scope="module")
def blocks():
    return tuple(np.asarray(x) for x in SPHERE.blocks())


def test_there_are_7129_states_whose_probabilities_add_up_to_one(blocks):
    accelerations, probabilities = blocks
    assert accelerations.shape == (7129, 3)
    assert probabilities.shape == (7129,)
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-12)
    assert probabilities.min() > 0


def test_layers_hold_equal_volumes():
    radii = np.asarray(layers(np.float64(0.2), np.float64(2.0)))
    volumes = 4 / 3 * np.pi * np.diff(radii**3)
    np.testing.assert_allclose(volumes, volumes[0], rtol=1e-12)
    assert radii[[0, -1]] == pytest.approx([0.2, 2.0], rel=1e-12)


def test_still_and_full_have_the_probabilities_of_equation_7(blocks):
    _, probabilities = blocks
    assert probabilities[-1] == pytest.approx(0.5)
    assert probabilities[6480:-1].sum() == pytest.approx(0.5 * 0.2)


def test_blocks_between_have_the_density_of_equation_5_and_the_centroids_of_uniform_draws(blocks):
    accelerations, probabilities = blocks
    rng = np.random.default_rng(0)
    draws = rng.uniform(-2, 2, (400_000, 3))
    size = np.linalg.norm(draws, axis=1)
    draws, size = draws[(size > 0.2) & (size < 2)], size[(size > 0.2) & (size < 2)]
    radii = np.asarray(layers(np.float64(0.2), np.float64(2.0)))
    layer = np.digitize(size, radii[1:-1])
    elevation = np.digitize(np.arcsin(draws[:, 2] / size), np.deg2rad(np.arange(-80, 90, 10)))
    azimuth = (np.arctan2(draws[:, 1], draws[:, 0]) % (2 * np.pi) // (np.pi / 18)).astype(int)
    block = (layer * 18 + elevation) * 36 + azimuth
    counts = np.bincount(block, minlength=6480)
    expected = probabilities[:6480] / probabilities[:6480].sum() * len(draws)
    # Poisson counts of 2 to 60: the mean of (n − m)²/m over 6480 blocks is 1 within 0.02.
    assert np.mean((counts - expected) ** 2 / expected) == pytest.approx(1.0, abs=0.1)
    # Each draw against its block's centroid: the mean of each block is within its scatter.
    off = np.stack([np.bincount(block, draws[:, k] - accelerations[block, k], 6480) for k in range(3)], axis=1)
    assert np.abs(off[counts > 20] / counts[counts > 20, None]).max() < 0.1
