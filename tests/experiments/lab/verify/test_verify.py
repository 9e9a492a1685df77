"""The oracles have converged; the library agrees with them; the biased estimators do not."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.in_process import trackwright
from trackwright.experiments.lab.verify import checks
from trackwright.experiments.lab.verify.checks import (
    CORRIDOR_25,
    HALT,
    PARAMETERS,
    CheckResult,
    chain_checks,
    gradients,
    kalman_checks,
    marginal_gradients,
    order_checks,
    random_check,
    score_checks,
    table,
)
from trackwright.experiments.lab.verify.oracles import (
    corridor_gradient,
    corridor_log_likelihood,
    halt_gradient,
    halt_log_likelihood,
    kalman_fixes,
)
from trackwright.experiments.lab.verify.worlds import (
    CORRIDOR,
    CORRIDOR_START,
    CORRIDOR_TUNABLES,
    HALT_TUNABLES,
    corridor_batch,
    corridor_fixes,
    corridor_tracker,
    halt_batch,
    halt_tracker,
    rectangle,
    score_form,
)
from trackwright.experiments.lab.verify.wrong_estimators import NAIVE, REPARAMETERISED
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.filters.particle.filter import ParticleFilter, Particles
from trackwright.trackers.core.filters.particle.resampling import LOG_ZERO
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.motion import ConstantPosition, Placed
from trackwright.trackers.line.fixes import FIXES
from trackwright.trackers.parts.walls import Walls

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


def test_the_kalman_filter_and_the_chain_agree_with_their_oracles():
    results = kalman_checks() + chain_checks()
    assert len(results) == 8
    assert all(r.passed for r in results), table(results)


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


def _result(mean, biased=False):
    return CheckResult("world", "quantity", "estimator", 1.0, mean, 0.1, biased=biased)


def test_outcomes_name_failures_and_unexpected_passes():
    assert [_result(m).outcome for m in (1.05, 1.2, np.nan)] == ["pass", "FAIL", "FAIL"]
    assert [_result(m, True).outcome for m in (1.2, 1.05, np.nan)] == [
        "fails as expected", "PASSES UNEXPECTEDLY", "PASSES UNEXPECTEDLY",
    ]  # fmt: skip
    found = random_check("w", "f", "e", 0.0, np.array([-1.0, 1.0, 3.0, 1.0]))
    assert (found.mean, found.error, found.allowed) == pytest.approx((1.0, np.sqrt(8 / 3) / 2, 2 * np.sqrt(8 / 3)))


@pytest.mark.parametrize(("mean", "code", "word"), [(1.0, 0, "1 of 1 checks passed"), (2.0, 1, "0 of 1 checks passed")])
def test_verify_exits_1_if_a_check_fails(monkeypatch, mean, code, word):
    monkeypatch.setattr(checks, "CHECKS", (lambda: [_result(mean)],))
    said = trackwright("verify")
    assert said.code == code
    assert word in said.out
    (result,) = json.loads(trackwright("verify", "--json").out)
    assert (result["mean"], result["passed"]) == (mean, code == 0)


@pytest.mark.slow
def test_400_keys_agree_at_a_halt_and_bias_and_spread_decay_as_expected():
    results = score_checks(HALT) + order_checks(CORRIDOR_25) + order_checks(HALT)
    assert all(r.passed for r in results), table(results)


@pytest.mark.slow
def test_the_whole_of_verify_passes():
    said = trackwright("verify")
    assert said.code == 0, said.out
    assert said.out.count("fails as expected") == 3


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
