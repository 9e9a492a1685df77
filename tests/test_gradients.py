"""Gradients of filters against oracles that share no code with them."""

import numpy as np
import pytest

from tests.oracles.gradients import CORRIDOR_25, CORRIDOR_100, HALT, gradients, marginal_gradients
from tests.oracles.particle_worlds import (
    CORRIDOR_TUNABLES,
    HALT_DT,
    HALT_TUNABLES,
    corridor_batch,
    corridor_fixes,
    corridor_tracker,
    halt_batch,
    halt_tracker,
)
from tests.oracles.quadrature import corridor_gradient, corridor_log_likelihood, halt_gradient, halt_log_likelihood
from trackwright.trackers.core.filters.particle.filter import ParticleFilter
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.line.grid import GridFilter
from trackwright.trackers.line.motion import PathOutputMap

pytestmark = pytest.mark.slow

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


def test_the_grid_filter_at_a_halt_has_the_likelihood_and_gradient_of_quadrature():
    # A tag crosses whole cells, so that travel is exact; the error is quadratic in the cell size.
    speeds, fastest = 81, 2.0
    cells = round(12.0 / (fastest / (speeds - 1) * HALT_DT)) + 1
    report = PathOutputMap(Polyline([[0.0, 0.0], [12.0, 0.0]]), Scale(0.01, "m"))
    found = gradients(halt_tracker(GridFilter(report, cells, speeds, fastest)), halt_batch(1), HALT_TUNABLES)
    exact = [halt_log_likelihood(), *halt_gradient()]
    np.testing.assert_allclose([found.values[0], *found.gradient[:, 0]], exact, rtol=5e-3, atol=5e-3)


def _deviation(scores):
    """Deviation of the mean from the oracle, in standard errors."""
    return abs(scores.mean() - corridor_gradient(corridor_fixes(25))[0]) / scores.std() * np.sqrt(len(scores))


@pytest.fixture(scope="module")
def scores():
    return gradients(corridor_tracker(PARTICLES), corridor_batch(25, KEYS), CORRIDOR_TUNABLES).gradient[0]


def test_the_score_form_is_unbiased_by_walls(scores):
    # The bias of 400 particles is a tenth of a standard error of 64 keys.
    assert _deviation(scores) < 4


def test_the_marginal_score_scatters_less_than_half_as_much_as_the_same_particles_would(scores):
    tracker = corridor_tracker(PARTICLES // 4)
    marginal = marginal_gradients(tracker, corridor_batch(25, KEYS), CORRIDOR_TUNABLES).gradient[0]
    # The bias of 100 particles, some 0.1 of −8.1, is one standard error.
    assert _deviation(marginal) < 5
    assert marginal.std() < 0.5 * 2 * scores.std()


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


@pytest.mark.parametrize("world", [CORRIDOR_25, CORRIDOR_100, HALT], ids=lambda world: world.name)
def test_400_keys_have_the_exact_likelihood_and_score_on_average(world):
    found = world.run(2000, 400)
    ratios = np.exp(found.values - world.value())
    assert abs(ratios.mean() - 1) < 4 * _standard_error(ratios)
    off = np.abs(found.gradient.mean(axis=1) - world.slopes()) / _standard_error(found.gradient)
    assert np.all(off < 4), off


@pytest.mark.parametrize("world", [CORRIDOR_25, HALT], ids=lambda world: world.name)
def test_bias_and_spread_of_the_score_decay_with_the_number_of_particles(world):
    """L̂·s is unbiased for any N, so that the bias of s is −cov(L̂/L, s), far more precise than the mean of s."""
    sizes, value = (125, 500, 2000), world.value()
    runs = [world.run(n, 400 * 2000 // n) for n in sizes]
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
