"""The score form: values to the bit, derivatives of log-weights as given, inherited, discounted, or refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.filters.particle.filter import ParticleFilter, Particles, resample_with_score, with_score
from trackwright.trackers.core.filters.particle.resampling import resample
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.motion import ConstantPosition, ConstantVelocity, GroundMotion, Kinematic, Placed
from trackwright.trackers.core.model.tunable import Constant, freeze
from trackwright.trackers.parts.singer import Singer

N = 64


def _belief(log_weights=None):
    position = Vector(jnp.linspace(-1.0, 1.0, N), jnp.zeros(N))
    weights = jnp.full(N, -np.log(N)) if log_weights is None else log_weights
    return Particles(Placed(position), weights, jax.random.key_data(jax.random.key(2)))


def _moved(sigma, dt=1.0, **options):
    return ParticleFilter(N, **options).predict(_belief(), ConstantPosition(Constant(sigma), 2), {}, jnp.asarray(dt))


_run = jax.jit(_moved)
_both = jax.jit(lambda sigma, dt: jax.jvp(lambda s: _moved(s, dt), (sigma,), (1.0,)))


def _score(sigma, dt):
    slope = _both(sigma, dt)[1]
    assert not np.any(np.stack(list(slope.states.position)))
    return slope.log_weights


def test_a_derivative_leaves_the_values_as_they_are_to_the_bit():
    plain, differentiated = _run(0.3, 1.0), _both(0.3, 1.0)[0]
    jax.tree_util.tree_map(np.testing.assert_array_equal, plain, differentiated)


def test_a_log_weights_derivative_is_that_of_the_density_of_the_draw():
    sigma = 0.3
    steps = np.stack(list(_run(sigma, 1.0).states.position)) - np.stack(list(_belief().states.position))
    # d/dσ of −2 log σ − |step|²/2σ², the steps held fixed.
    np.testing.assert_allclose(_score(sigma, 1.0), -2 / sigma + (steps**2).sum(axis=0) / sigma**3, rtol=1e-9)


def test_nothing_is_drawn_in_no_time():
    np.testing.assert_array_equal(_score(0.3, 0.0), 0.0)


@pytest.mark.parametrize("discount", [1.0, 0.8])
def test_offspring_keep_the_derivative_of_their_ancestor_less_the_discount(discount):
    log_weights = jax.nn.log_softmax(3.0 * jax.random.normal(jax.random.key(0), (N,)))
    states, offset, weights = jnp.arange(float(N)), jnp.asarray(0.4), jnp.exp(log_weights)

    def drawn(slope, needed):
        return resample_with_score(needed, offset, states, log_weights + slope * states, weights, discount=discount)

    both = jax.jit(lambda needed: jax.jvp(lambda s: drawn(s, needed), (0.0,), (1.0,)))
    (ancestors, value, _), (still, inherited, _) = both(True)
    expected = jax.jit(resample)(True, offset, states, log_weights, weights)
    np.testing.assert_array_equal(ancestors, expected[0])
    np.testing.assert_array_equal(value, expected[1])
    np.testing.assert_allclose(inherited, discount * np.asarray(ancestors), rtol=1e-12)
    np.testing.assert_array_equal(still, 0.0)
    kept = both(False)[1][1]
    np.testing.assert_array_equal(kept, states)


def test_a_motion_that_does_not_say_its_density_is_refused_with_its_name_and_only_where_it_is_tuned():
    state = Kinematic(Vector(jnp.zeros(N)), Vector(jnp.zeros(N)))

    class Still(ConstantVelocity):
        def log_density(self, state, inputs, dt, w):
            return Singer(1.0, 1.0, 1).log_density(state, inputs, dt, w)

    def weights(sigma, other):
        belief = Particles(state, jnp.full(N, -np.log(N)) + 0.0 * other, _belief().key)
        return ParticleFilter(N).predict(belief, Still(Constant(sigma), 1), {}, jnp.asarray(1.0)).log_weights

    jax.eval_shape(lambda x: jax.jvp(lambda x: weights(0.3, x), (x,), (x,)), 1.0)
    with pytest.raises(ValueError, match="Singer has no log_density"):
        jax.eval_shape(lambda x: jax.jvp(lambda x: weights(x, 1.0), (x,), (x,)), 0.3)


def test_where_nothing_is_differentiated_no_density_is_asked_for():
    def never(x):
        raise AssertionError

    weights = jnp.zeros(3)
    value, slope = jax.jvp(lambda w: with_score(w, weights, log_density=never), (weights,), (weights + 1,))
    np.testing.assert_array_equal(value, 0.0)
    np.testing.assert_array_equal(slope, 1.0)


def test_the_first_particles_owe_the_density_of_the_normal_belief():
    key = jax.random.key_data(jax.random.key(4))
    at = jnp.array([0.3, -0.2, 0.9, 0.4])

    def belief(x):
        return Gaussian(Placed(Vector(x[0], x[1])), (x[2] ** 2, 0.3 * x[2] * x[3], x[3] ** 2))

    drawn = ParticleFilter(N).init(belief(at), key)
    init = jax.jit(lambda x, t: jax.jvp(lambda x: ParticleFilter(N).init(belief(x), key).log_weights, (x,), (t,))[1])
    scores = jnp.stack([init(at, unit) for unit in jnp.eye(4)], axis=-1)

    def density(x):
        mean, cov = x[:2], np.array([[x[2] ** 2, 0.3 * x[2] * x[3]], [0.3 * x[2] * x[3], x[3] ** 2]])
        deviations = np.stack(list(drawn.states.position), axis=-1) - mean
        return -0.5 * np.log(np.linalg.det(cov)) - 0.5 * np.einsum(
            "ni,ij,nj->n", deviations, np.linalg.inv(cov), deviations
        )

    step = 1e-5 * np.eye(4)
    expected = [(density(np.asarray(at) + s) - density(np.asarray(at) - s)) / 2e-5 for s in step]
    # The third derivative times the step's square: 1e-8 of the largest.
    np.testing.assert_allclose(scores, np.stack(expected, axis=-1), rtol=1e-5, atol=1e-6)


def _slope(motion, state, w, sizes):
    """d log_density by the logarithms of the motion's tunables, in their order."""
    raw, build = jax.tree_util.tree_flatten(motion)

    def density(*shift):
        other = jax.tree_util.tree_unflatten(build, [r + s for r, s in zip(raw, shift, strict=True)])
        return freeze(other).log_density(state, {}, jnp.asarray(0.5), Vector.of(w))

    return jax.jit(jax.jacfwd(density, argnums=tuple(range(sizes))))(*[0.0] * sizes)


def test_noise_in_proportion_to_a_sigma_owes_the_square_of_its_unit_draw_less_one():
    w = [0.5, -1.5, 0.3, 2.0, -0.7]
    square = np.square(w) - 1
    planar = Kinematic(Vector(0.0, 0.0), Vector(0.0, 0.0))
    raised = Kinematic(Vector(0.0, 0.0, 0.0), Vector(0.0, 0.0))
    np.testing.assert_allclose(_slope(ConstantVelocity(0.4, 2), planar, w[:4], 1), [square[:4].sum()])
    np.testing.assert_allclose(_slope(GroundMotion(0.4, 0.2), raised, w, 2), [square[:4].sum(), square[4]])
    np.testing.assert_allclose(_slope(GroundMotion(0.4, 0.2), planar, w, 2), [square[:4].sum(), 0.0])
