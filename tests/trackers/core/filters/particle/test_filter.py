"""The particle filter: effective sample size and resampling as printed, weights of zero, and a Kalman filter as oracle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, LinearSensor, flat, recording
from tests.oracles import kalman
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.filters.particle.filter import ParticleFilter, Particles
from trackwright.trackers.core.filters.particle.resampling import effective_sample_size, systematic
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.motion import ConstantPosition, Placed
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.tunable import Constant
from trackwright.trackers.core.run.tracker import Tracker

KEYS, ROWS = 200, 12

# One by one, each of their operations would be compiled for itself.
systematic = jax.jit(systematic)


@eqx.filter_jit
def _updated(filter, belief, motion, sensor, reading):
    return filter.update(belief, motion, sensor, reading, {})


@eqx.filter_jit
def _predicted(filter, belief, motion):
    return filter.predict(belief, motion, {}, 1.0)


def _ruler(sigma):
    """A sensor of x and y."""
    return LinearSensor(np.eye(2), [sigma] * 2, 2)


class Wall(LinearSensor):
    """A sensor under which states of negative x are impossible."""

    def measure(self, view, inputs):
        return [jnp.where(x < 0, jnp.inf, x) for x in view.position]


def _weights(n, seed=0, spread=2.0):
    w = np.exp(spread * np.random.default_rng(seed).normal(size=n))
    return w / w.sum()


def test_the_effective_sample_size_is_the_corrected_printed_one():
    w = _weights(100)
    cv2 = np.var(w) / np.mean(w) ** 2
    np.testing.assert_allclose(effective_sample_size(jnp.asarray(w)), 100 / (1 + cv2), rtol=1e-12)


def test_every_particle_has_offspring_as_many_as_its_share_rounded_down_or_up():
    w = _weights(300)
    for u in (0.0, 0.3, 0.999):
        counts = np.bincount(systematic(jnp.asarray(w), jnp.asarray(u)), minlength=300)
        assert counts.sum() == 300
        assert np.all(np.abs(counts - 300 * w) < 1.0)


def test_the_mean_number_of_offspring_is_the_share():
    w = _weights(40, seed=3)
    offsets = (np.arange(2000) + 0.5) / 2000
    ancestors = jax.jit(jax.vmap(systematic, in_axes=(None, 0)))(w, offsets)
    mean = np.bincount(np.asarray(ancestors).ravel(), minlength=40) / 2000
    # The offsets are a grid of 1/2000: each share is exact to two of its steps.
    np.testing.assert_allclose(mean, 40 * w, atol=1e-3)


def test_no_particle_of_weight_zero_has_offspring_in_single_precision():
    rng = np.random.default_rng(5)
    for _ in range(300):
        weights = np.where(rng.random(1000) < 0.5, 0.0, np.exp(rng.normal(size=1000)))
        weights = (weights / weights.sum()).astype(np.float32)
        ancestors = np.asarray(systematic(jnp.asarray(weights), jnp.float32(rng.random())))
        assert len(ancestors) == 1000
        assert np.all(weights[ancestors] > 0)
        assert np.all(np.diff(ancestors) >= 0)


def _still(log_weights):
    key = jax.random.key_data(jax.random.key(0))
    return Particles(Placed(Vector(jnp.arange(4.0), jnp.zeros(4))), jnp.asarray(log_weights), key)


def test_particles_are_drawn_again_below_half_the_number_and_not_above():
    motion = ConstantPosition(Constant(1e-12), 2)
    few, enough = _still(np.log([0.97, 0.01, 0.01, 0.01])), _still(np.log([0.4, 0.3, 0.2, 0.1]))
    drawn = _predicted(ParticleFilter(4), few, motion)
    np.testing.assert_allclose(drawn.log_weights, -np.log(4.0))
    assert np.sum(np.round(drawn.states.position[0]) == 0) >= 3
    kept = _predicted(ParticleFilter(4), enough, motion)
    np.testing.assert_array_equal(kept.log_weights, enough.log_weights)
    np.testing.assert_allclose(kept.states.position[0], np.arange(4.0), atol=1e-9)
    assert not np.array_equal(kept.key, enough.key)


def _reading(x, y=0.0):
    return Reading(jnp.array([x, y]), jnp.array([True, True]), jnp.zeros(0))


def test_weights_and_log_likelihood_are_those_of_bayes_rule():
    w = np.array([0.4, 0.3, 0.2, 0.1])
    belief, innovation = _updated(
        ParticleFilter(4), _still(np.log(w)), ConstantPosition(Constant(1.0), 2), _ruler(0.5), _reading(1.2, 0.1)
    )
    density = np.exp(-0.5 * ((1.2 - np.arange(4)) ** 2 + 0.1**2) / 0.25) / (2 * np.pi * 0.25)
    np.testing.assert_allclose(np.exp(belief.log_weights), w * density / np.sum(w * density), rtol=1e-12)
    np.testing.assert_allclose(innovation.log_likelihood, np.log(np.sum(w * density)), rtol=1e-12)
    # The particles' residuals are (1.2 − x)/0.5 and 0.2: mean and variance of the first by hand.
    r = (1.2 - np.arange(4)) / 0.5
    mean = np.sum(w * r)
    nis = mean**2 / (1 + np.sum(w * (r - mean) ** 2)) + 0.2**2
    np.testing.assert_allclose(innovation.nis, nis, rtol=1e-12)


def test_states_that_a_reading_rules_out_have_weight_zero_for_good():
    states = Placed(Vector(jnp.array([-1.0, 0.5, 1.0, -2.0]), jnp.zeros(4)))
    belief = Particles(states, jnp.full(4, -np.log(4.0)), jax.random.key_data(jax.random.key(1)))
    motion, filter = ConstantPosition(Constant(1e-12), 2), ParticleFilter(4, fraction=0.9)
    once, innovation = _updated(filter, belief, motion, Wall(np.eye(2), [1.0] * 2, 2), _reading(0.7))
    assert np.all(np.exp(once.log_weights[np.array([0, 3])]) == 0)
    assert np.isfinite(innovation.log_likelihood)
    twice = _predicted(filter, once, motion)
    assert np.all(twice.states.position[0] > 0)


def test_where_all_states_are_ruled_out_the_belief_is_not_finite():
    states = Placed(Vector(jnp.full(4, -1.0), jnp.zeros(4)))
    belief = Particles(states, jnp.full(4, -np.log(4.0)), jax.random.key_data(jax.random.key(1)))
    after, _ = _updated(
        ParticleFilter(4), belief, ConstantPosition(Constant(1.0), 2), Wall(np.eye(2), [1.0] * 2, 2), _reading(0.7)
    )
    assert not np.any(np.isfinite(after.log_weights))


def test_the_first_particles_have_the_moments_of_the_normal_belief():
    cov = (jnp.asarray(2.0), jnp.asarray(0.6), jnp.asarray(0.5))
    filter = ParticleFilter(40_000)
    belief = eqx.filter_jit(filter.init)(
        Gaussian(Placed(Vector(1.0, -2.0)), cov), jax.random.key_data(jax.random.key(3))
    )
    mean, spread = filter.moments(belief)
    # 40,000 draws: standard errors of 0.007 and, relative to a variance, of 0.007; four of them.
    np.testing.assert_allclose(list(mean.position), [1.0, -2.0], atol=0.03)
    np.testing.assert_allclose(spread, cov, atol=0.06)


class Oracle:
    """One recording under 200 random keys, and what the Kalman filter makes of it."""

    def __init__(self):
        rng = np.random.default_rng(4)
        times = np.cumsum(rng.uniform(0.1, 0.5, ROWS))
        # A walk as the model has it: what surprises by many sigmas would leave few particles, and bias with them.
        steps = 0.6 * np.sqrt(np.diff(times, prepend=times[0]))[:, None] * rng.normal(size=(ROWS, 2))
        values = np.array([0.3, -0.2]) + np.cumsum(steps, axis=0) + 0.5 * rng.normal(size=(ROWS, 2))
        seen = rng.random((ROWS, 2)) > 0.2
        mean, cov = np.array([0.3, -0.2]), np.diag([0.5, 0.8])
        tracker = Tracker(
            ConstantPosition(0.6, 2), {"a": _ruler(0.5)},
            KnownStart(lambda x: Placed(Vector(x[0], x[1]))), ParticleFilter(1600), NEVER_LOST,
        )  # fmt: skip
        trajectories = [recording(times, {"a": (values, seen)}, mean, cov, name=f"key {k}") for k in range(KEYS)]
        self.estimates = tracker.run(stack(trajectories))
        steps = [(np.eye(2), 0.36 * dt * np.eye(2)) for dt in np.diff(times)]
        R = 0.25 * np.eye(2)
        self.mean, self.cov, self.log_likelihood, self.nis = kalman(
            steps, np.eye(2), R, values[1:], seen[1:], mean, cov
        )


@pytest.fixture(scope="module")
def oracle():
    return Oracle()


def test_estimates_over_200_keys_are_the_kalman_filters_within_3_standard_errors(oracle):
    means = flat(oracle.estimates.mean)[:, 1:]
    error = means.mean(axis=0) - oracle.mean
    # Of 22 numbers one may pass 3 by chance (6 %); 3.5 (1 %). The bias of 1/N is at most 0.7 standard errors here.
    assert np.abs(error / (means.std(axis=0) / np.sqrt(KEYS))).max() < 3.5
    variances = oracle.estimates.cov_upper[[0, 2], :, 1:].mean(axis=1).T
    # The spread about the particles' own mean is too small by one part in the effective sample size, which falls to 40.
    np.testing.assert_allclose(variances, np.diagonal(oracle.cov, axis1=1, axis2=2), rtol=0.06)


def test_the_likelihood_is_unbiased_over_200_keys(oracle):
    ratio = np.exp(oracle.estimates.log_likelihood[:, 1:].sum(axis=1) - oracle.log_likelihood.sum())
    assert abs(ratio.mean() - 1) < 3 * ratio.std() / np.sqrt(KEYS)


def test_the_nis_is_about_the_kalman_filters(oracle):
    # The NIS of a finite sample scatters by the mean's error in units of the noise: a few percent here.
    np.testing.assert_allclose(oracle.estimates.nis[:, 1:].mean(axis=0), oracle.nis, rtol=0.05, atol=0.04)
