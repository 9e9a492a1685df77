"""The O(N) forward recursion against enumeration of all state sequences; its transition over any interval; its start."""

from itertools import pairwise, product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.mhk.accelerations import AccelerationSphere
from trackwright.trackers.mhk.fusion import AccelerationFilter, chain_predicted, chain_updated
from trackwright.trackers.mhk.tracker import mhk_tracker

STATIONARY = np.array([0.5, 0.3, 0.2])


@pytest.mark.parametrize("kappa", [0.0, 0.6])
def test_forward_recursion_is_the_sum_over_every_sequence_of_states(kappa):
    rng = np.random.default_rng(0)
    log_likelihoods = rng.normal(size=(5, 3)) * 2
    A = kappa * np.eye(3) + (1 - kappa) * STATIONARY
    joint = np.zeros(3)
    for path in product(range(3), repeat=5):
        p = STATIONARY[path[0]] * np.prod([A[i, j] for i, j in pairwise(path)])
        joint[path[-1]] += p * np.exp(sum(row[s] for row, s in zip(log_likelihoods, path, strict=True)))
    weights, evidence = jnp.asarray(STATIONARY), 0.0
    for k, row in enumerate(log_likelihoods):
        weights = chain_predicted(weights, jnp.asarray(STATIONARY), kappa) if k else weights
        weights, log = chain_updated(weights, jnp.asarray(row))
        evidence += float(log)
    np.testing.assert_allclose(weights, joint / joint.sum(), rtol=1e-12)
    assert evidence == pytest.approx(np.log(joint.sum()), rel=1e-12)


def test_two_steps_are_one_long_step():
    weights, stationary = jnp.array([0.9, 0.1, 0.0]), jnp.asarray(STATIONARY)
    twice = chain_predicted(chain_predicted(weights, stationary, np.exp(-0.3)), stationary, np.exp(-0.5))
    np.testing.assert_allclose(twice, chain_predicted(weights, stationary, np.exp(-0.8)), rtol=1e-13)


def test_an_outlier_leaves_finite_probabilities():
    weights, log = chain_updated(jnp.asarray(STATIONARY), jnp.array([-1e6, -2e6, -3e6]))
    np.testing.assert_allclose(weights, [1.0, 0.0, 0.0])
    assert float(log) == pytest.approx(-1e6 + np.log(0.5))


@jax.jit
def _mean(sigma, displacement, elapsed):
    model = freeze(AccelerationFilter(AccelerationSphere(), sigma, None))
    return model.posterior(jnp.zeros(0), Vector(*displacement), elapsed)[1].array()


# At the smallest noise Bessel functions no longer give the sums over azimuths.
@pytest.mark.parametrize("sigma", [0.3, 0.03, 0.002])
def test_the_posterior_mean_is_bayes_rule_over_all_states(sigma):
    accelerations, probabilities = (np.asarray(x) for x in AccelerationSphere().blocks())
    displacement, elapsed = np.array([0.08, -0.02, 0.01]), 0.4
    squares = np.sum((displacement - 0.5 * elapsed**2 * accelerations) ** 2, axis=1) / sigma**2
    density = np.exp(-0.5 * (squares - squares.min()))
    expected = (probabilities * density) @ accelerations / (probabilities @ density)
    np.testing.assert_allclose(_mean(sigma, displacement, elapsed), expected, rtol=1e-9)


def test_at_the_papers_rate_and_noise_a_displacement_carries_little_information():
    # 2 m/s² for 0.1 s move 1 cm; the fixes' noise is 3 cm and a displacement's √2 of that.
    displacement = np.array([0.01, 0.0, 0.0])
    assert 0 < _mean(0.042, displacement, 0.1)[0] < 0.1
    assert float(_mean(0.0005, displacement, 0.1)[0]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(("start", "moved_mm"), [("stationary", 0.101), ("uniform", 0.190)])
def test_a_first_displacement_of_3_cm_moves_the_prediction_by_a_tenth_of_a_millimetre_more_or_less(start, moved_mm):
    chain = mhk_tracker(rate=1.0).fusion.filter
    stationary = chain.sphere.blocks().probabilities
    weights = stationary if start == "stationary" else jnp.full_like(stationary, 1.0 / len(stationary))
    displacement, dt = Vector(*(jnp.asarray(x) for x in (0.03, 0.0, 0.0))), jnp.asarray(0.1)
    _, acceleration = chain.posterior(weights, displacement, dt)
    assert 1000 * 0.5 * float(next(iter(acceleration))) * 0.1**2 == pytest.approx(moved_mm, abs=0.001)
