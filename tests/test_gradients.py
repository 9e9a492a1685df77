"""Gradients of filters against oracles that share no code with them; common particle gradients that must fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.oracles import quadrature
from tests.oracles.gradients import CORRIDOR_25, CORRIDOR_100, HALT, gradients, marginal_gradients
from tests.oracles.particle_worlds import (
    CORRIDOR,
    CORRIDOR_START,
    CORRIDOR_TUNABLES,
    HALT_DT,
    HALT_TUNABLES,
    corridor_batch,
    corridor_fixes,
    corridor_tracker,
    halt_batch,
    halt_tracker,
    rectangle,
    score_form,
)
from tests.oracles.pathwise import NAIVE, REPARAMETERISED
from tests.oracles.quadrature import (
    corridor_gradient,
    corridor_log_likelihood,
    halt_gradient,
    halt_log_likelihood,
    kalman_fixes,
)
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.baselines.floor import Walls
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.filters.particle.filter import ParticleFilter, Particles
from trackwright.trackers.core.filters.particle.resampling import LOG_ZERO
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.motion import ConstantPosition, Placed
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.tunable import Real, Scale, replaced
from trackwright.trackers.line.grid import GridFilter
from trackwright.trackers.line.motion import PathOutputMap
from trackwright.trackers.line.tracker import FIXES
from trackwright.trackers.mhk.fusion import chain_predicted, chain_updated
from trackwright.trackers.parts import fixes as parts

PARAMETERS = {
    "motion.sigma_a": 1.0,
    "sensors.fixes.sigma_horizontal": 0.3,
    "start.sigma_position": 1.0,
    "start.sigma_velocity": 1.0,
    quadrature.LATENCY: 0.1,
}
"""Tunables of the Kalman filter: m/s² per √Hz, m, m, m/s, s."""

KEYS, PARTICLES = 64, 400


@pytest.mark.parametrize(
    ("rows", "value", "slope"), [(25, -75.183116463, -8.136640464), (100, -283.030498525, -48.889980552)]
)
def test_the_corridors_quadrature_has_converged(rows, value, slope):
    fixes = corridor_fixes(rows)
    for points in ((48, 18), (64, 24), (96, 36)):
        assert corridor_log_likelihood(fixes, points=points) == pytest.approx(value, abs=1e-8)
        assert corridor_gradient(fixes, points)[0] == pytest.approx(slope, abs=1e-7)


def test_the_halts_quadrature_has_converged():
    for points in ((128, 48), (160, 56), (192, 64)):
        assert halt_log_likelihood(points=points) == pytest.approx(-13.7710834, abs=1e-6)
        assert halt_gradient(points) == pytest.approx((0.235494, 6.516646, -0.180706), abs=1e-5)


def test_the_kalman_filter_on_late_fixes_with_gaps_has_the_likelihood_and_gradient_of_the_joint_density():
    times, values, seen = kalman_fixes()
    missing = np.zeros((len(times), 1))
    readings = Readings(np.hstack([values, missing]), np.hstack([seen, missing > 0]), np.zeros((len(times), 3)))
    batch = stack([Recording(times, {parts.FIXES: readings}, {"height": np.zeros(len(times))})])
    latency = quadrature.LATENCY
    new = {n: Real(x, "s", typical=1.0) if n == latency else Scale(x) for n, x in PARAMETERS.items()}
    found = gradients(replaced(fix_tracker(dof=None, planar=True), new), batch, list(PARAMETERS))
    exact = [quadrature.kalman_log_likelihood(PARAMETERS), *quadrature.kalman_gradient(PARAMETERS)]
    np.testing.assert_allclose([found.values[0], *found.gradient[:, 0]], exact, rtol=1e-4, atol=1e-4)


def test_the_forward_algorithm_has_the_gradient_of_the_sum_over_all_state_sequences():
    shares, levels = jnp.asarray(quadrature.CHAIN_PROBABILITIES), jnp.asarray(quadrature.CHAIN_LEVELS)
    measured, intervals = jnp.asarray(quadrature.chain_measurements()), jnp.asarray(quadrature.CHAIN_INTERVALS)

    def log_likelihood(raw):
        rate, sigma = jnp.exp(raw[0]), jnp.exp(raw[1])
        weights, value = shares, 0.0
        for k in range(len(measured)):
            weights = chain_predicted(weights, shares, jnp.exp(-rate * intervals[k - 1])) if k else weights
            weights, log = chain_updated(weights, -0.5 * ((measured[k] - levels) / sigma) ** 2 - jnp.log(sigma))
            value = value + log
        return value

    raw = jnp.log(jnp.asarray([quadrature.CHAIN_RATE, quadrature.CHAIN_SIGMA]))
    slopes = jax.jit(jax.jacfwd(log_likelihood))(raw)
    np.testing.assert_allclose(slopes, quadrature.chain_gradient(), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_the_grid_filter_at_a_halt_has_the_likelihood_and_gradient_of_quadrature():
    # A tag crosses whole cells, so that travel is exact; the error is quadratic in the cell size.
    speeds, fastest = 81, 2.0
    cells = round(12.0 / (fastest / (speeds - 1) * HALT_DT)) + 1
    report = PathOutputMap(Polyline([[0.0, 0.0], [12.0, 0.0]]), Scale(0.01, "m"))
    found = gradients(halt_tracker(GridFilter(report, cells, speeds, fastest)), halt_batch(1), HALT_TUNABLES)
    exact = [halt_log_likelihood(), *halt_gradient()]
    np.testing.assert_allclose([found.values[0], *found.gradient[:, 0]], exact, rtol=5e-3, atol=5e-3)


def _score(estimator):
    return gradients(corridor_tracker(PARTICLES, estimator), corridor_batch(25, KEYS), CORRIDOR_TUNABLES).gradient[0]


def _deviation(scores):
    """Deviation of the mean from the oracle, in standard errors."""
    return abs(scores.mean() - corridor_gradient(corridor_fixes(25))[0]) / scores.std() * np.sqrt(len(scores))


@pytest.fixture(scope="module")
def scores():
    return _score(score_form)


def test_the_score_form_is_unbiased_by_walls(scores):
    # The bias of 400 particles is a tenth of a standard error of 64 keys.
    assert _deviation(scores) < 4


@pytest.mark.slow
@pytest.mark.parametrize("estimator", [NAIVE, REPARAMETERISED])
def test_pathwise_estimators_are_biased_by_walls(estimator):
    assert _deviation(_score(estimator)) > 12


KEY = np.array([1, 2], np.uint32)


@pytest.mark.parametrize("estimator", [NAIVE, REPARAMETERISED])
@pytest.mark.parametrize(("alive", "shares"), [(3, 8), (5, 5)])
def test_pathwise_estimators_resample_and_move_as_the_filter_and_kill_outside_of_walls(estimator, alive, shares):
    # The effective sample size is the number of equal weights above zero; below four of eight, all are drawn again.
    log_weights = jnp.where(jnp.arange(8) < alive, -np.log(alive), LOG_ZERO)
    belief = Particles(Placed(Vector(jnp.linspace(1.0, 5.0, 8), jnp.full(8, 0.75))), log_weights, KEY)
    walled, motion = ParticleFilter(8, potential=Walls(rectangle(CORRIDOR))), ConstantPosition(0.75, 2)
    own, found = (p.predict(belief, motion, {}, jnp.asarray(1.0)) for p in (walled, estimator(walled)))
    np.testing.assert_allclose(found.states.position, own.states.position, rtol=1e-6)
    low, high = CORRIDOR
    inside = np.all([(a < x) & (x < b) for a, x, b in zip(low, found.states.position, high, strict=True)], axis=0)
    assert 0 < np.sum(inside[:alive]) < alive
    kept = inside if alive == 3 else inside & (np.arange(8) < alive)
    np.testing.assert_allclose(found.log_weights, np.where(kept, -np.log(shares), LOG_ZERO), rtol=1e-6)


@pytest.mark.parametrize("estimator", [NAIVE, REPARAMETERISED])
def test_initial_particles_of_pathwise_estimators_move_with_the_spread_of_the_prior(estimator):
    def drawn(sigma, estimator):
        prior = Gaussian(Placed(Vector(jnp.asarray(2.0))), (sigma**2,))
        return estimator(ParticleFilter(5)).init(prior, KEY).states.position[0]

    sigma = jnp.asarray(0.3)
    positions = drawn(sigma, estimator)
    np.testing.assert_array_equal(positions, drawn(sigma, score_form))
    # x = 2 + sigma·w for a fixed w; the score form leaves the particles where they are.
    np.testing.assert_allclose(jax.jacfwd(drawn)(sigma, estimator), (positions - 2.0) / sigma, rtol=1e-4)


def _recording(rows, key):
    """The corridor's first fixes at these seconds, the fix of a second on the first of its rows."""
    fixes = np.vstack([np.zeros((1, 2)), corridor_fixes(25)])[rows]
    seen = np.concatenate([[False], np.diff(rows) > 0])
    return Recording(rows.astype(float), {FIXES: Readings(fixes, np.stack([seen] * 2, axis=1))}, name=f"key {key}")


@pytest.fixture(scope="module")
def marginal():
    """Marginal scores of all 25 fixes and of the first four, plain and with rows that take no time; 64 keys of each."""
    kinds = [np.arange(26), np.arange(5), np.array([0, 1, 1, 2, 3, 3, 4])]
    batch = stack([_recording(rows, key) for rows in kinds for key in range(KEYS)])
    return np.split(marginal_gradients(corridor_tracker(PARTICLES // 4), batch, CORRIDOR_TUNABLES).gradient[0], 3)


@pytest.mark.slow
def test_rows_of_padding_do_not_change_the_marginal_score():
    short, long = (_recording(np.arange(rows), 0) for rows in (3, 5))
    tracker = corridor_tracker(8)
    alone, beside = (marginal_gradients(tracker, stack(r), CORRIDOR_TUNABLES) for r in ([short], [short, long]))
    assert beside.gradient[0, 0] == pytest.approx(alone.gradient[0, 0], rel=1e-5)
    assert beside.gradient[0, 1] != pytest.approx(alone.gradient[0, 0], rel=0.01)


@pytest.mark.slow
def test_the_marginal_score_scatters_less_than_half_as_much_as_the_same_particles_would(marginal, scores):
    # The bias of 100 particles, some 0.1 of −8.1, is one standard error.
    assert _deviation(marginal[0]) < 5
    assert marginal[0].std() < 0.5 * 2 * scores.std()


@pytest.mark.slow
def test_rows_in_no_time_and_without_readings_do_not_change_the_marginal_score(marginal):
    _, plain, twice = marginal
    exact = corridor_gradient(corridor_fixes(25)[:4])[0]
    for found in (plain, twice):
        assert abs(found.mean() - exact) < 4 * found.std() / np.sqrt(KEYS)


def test_the_marginal_score_is_refused_where_the_noise_does_not_reach_the_state():
    with pytest.raises(ValueError, match=r"(?s)LineMotion .* \(arclength has none\)"):
        marginal_gradients(halt_tracker(ParticleFilter(10)), halt_batch(1), HALT_TUNABLES)


def _standard_error(x):
    return x.std(ddof=1, axis=-1) / np.sqrt(x.shape[-1])


def _line(x, y, errors):
    """Intercept and slope of the weighted straight-line fit, and the standard errors of both."""
    design = np.stack([np.ones(len(x)), x], axis=1) / errors[:, None]
    found, *_ = np.linalg.lstsq(design, y / errors)
    return found, np.sqrt(np.diag(np.linalg.inv(design.T @ design)))


@pytest.mark.slow
@pytest.mark.parametrize("world", [CORRIDOR_25, CORRIDOR_100, HALT], ids=lambda world: world.name)
def test_400_keys_have_the_exact_likelihood_and_score_on_average(world):
    found = world.run(score_form, 2000, 400)
    ratios = np.exp(found.values - world.value())
    assert abs(ratios.mean() - 1) < 4 * _standard_error(ratios)
    off = np.abs(found.gradient.mean(axis=1) - world.slopes()) / _standard_error(found.gradient)
    assert np.all(off < 4), off


@pytest.mark.slow
@pytest.mark.parametrize(("estimator", "wrong"), [(NAIVE, True), (REPARAMETERISED, False)])
def test_at_a_halt_the_naive_gradient_is_wrong_and_the_reparameterised_one_is_not(estimator, wrong):
    # A clamp at zero speed is continuous.
    found = HALT.run(estimator, 2000, 400).gradient[0]
    assert (abs(found.mean() - HALT.slopes()[0]) > 4 * _standard_error(found)) == wrong


@pytest.mark.slow
@pytest.mark.parametrize("world", [CORRIDOR_25, HALT], ids=lambda world: world.name)
def test_bias_and_spread_of_the_score_decay_with_the_number_of_particles(world):
    """L̂·s is unbiased for any N, so that the bias of s is −cov(L̂/L, s), far more precise than the mean of s."""
    sizes, value = (125, 500, 2000), world.value()
    runs = [world.run(score_form, n, 400 * 2000 // n) for n in sizes]
    spreads = [r.gradient[0].std(ddof=1) for r in runs]
    assert np.polyfit(np.log(sizes), np.log(spreads), 1)[0] == pytest.approx(-0.5, abs=0.08)
    products = [-(np.exp(r.values - value) - 1.0) * (r.gradient[1] - r.gradient[1].mean()) for r in runs]
    biases, errors = np.array([(p.mean(), _standard_error(p)) for p in products]).T
    (_, power), (_, error) = _line(np.log(sizes), np.log(np.abs(biases)), errors / np.abs(biases))
    assert abs(power + 1.0) < 4 * error
    for k, exact in enumerate(world.slopes()[:2]):
        means, errors = np.array([(r.gradient[k].mean() - exact, _standard_error(r.gradient[k])) for r in runs]).T
        (limit, _), (error, _) = _line(1.0 / np.array(sizes), means, errors)
        assert abs(limit) < 4 * error


def test_the_fixes_of_the_kalman_filter_have_the_noise_of_its_model():
    _, fixes, _ = kalman_fixes(rows=2000)
    # Third differences of the walk are below 0.1 m; white noise is amplified by 1 + 9 + 9 + 1.
    assert np.diff(fixes, 3, axis=0).std() / np.sqrt(20) == pytest.approx(
        PARAMETERS["sensors.fixes.sigma_horizontal"], rel=0.05
    )


def test_the_prior_of_the_corridor_is_standard_normal():
    belief = CORRIDOR_START.belief(None, corridor_batch(2, 1))
    np.testing.assert_array_equal(np.ravel(belief.mean.position), 0.0)
    assert [float(x[0, 0]) for x in belief.cov] == [1.0, 0.0, 1.0]
