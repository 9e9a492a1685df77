"""Residuals of phases with a common offset: density, wrapping, masks and offsets."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.aoa.phases import arctangent, centred, circular_mean, pairwise
from trackwright.trackers.core.model.sensor import Reading

FORMS = {"default": centred, "paper": pairwise}
TURN = 2 * np.pi


@partial(jax.jit, static_argnums=0)
def _residual(form, phases, seen, sigma):
    """Whitened residuals (…, n), log scale, count and wrapped flag of phases (…, n) that were predicted to be zero."""

    def one(values):
        result = form(Reading(values, seen), [jnp.zeros(())] * len(seen), sigma)
        return jnp.stack(list(result.whitened)), result.log_scale, result.nis_dof, result.wrapped

    return jax.vmap(one)(phases)


@pytest.mark.parametrize(
    ("seen", "free"), [([1, 1, 0, 0], [1]), ([0, 1, 0, 1], [3]), ([1, 1, 1, 0], [1, 2]), ([1, 0, 1, 1], [2, 3])]
)
def test_the_density_of_a_reading_integrates_to_one_over_the_torus_of_differences(seen, free):
    # The first antenna seen is held at zero, whatever the common offset. The trapezoidal rule on a period is exact
    # but for what lies beyond half a turn, 5 sigma of a difference: 6e-7 for each.
    sigma, steps = np.pi / 5 / np.sqrt(2), 120
    axis = -np.pi + TURN * (np.arange(steps) + 0.5) / steps
    phases = np.zeros((steps ** len(free), 4))
    phases[:, free] = np.array(list(itertools.product(axis, repeat=len(free))))
    whitened, log_scale, count, _ = _residual(centred, phases, np.array(seen, bool), sigma)
    density = np.exp(log_scale - 0.5 * np.sum(np.asarray(whitened) ** 2, axis=1))
    assert np.all(count == len(free))
    assert np.sum(density) * (TURN / steps) ** len(free) == pytest.approx(1, abs=4e-6)


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_the_density_is_that_of_the_differences_to_one_antenna(form):
    rng, sigma = np.random.default_rng(0), 0.1
    phases = rng.normal(size=(50, 8)) * sigma + rng.uniform(-40, 40, (50, 1))
    seen = np.array([1, 1, 0, 1, 1, 1, 0, 1], bool)
    whitened, log_scale, _, wrapped = _residual(form, phases, seen, sigma)
    differences = phases[:, seen][:, 1:] - phases[:, seen][:, :1]
    cov = sigma**2 * (np.eye(5) + 1)
    quadratic = np.einsum("ni,ij,nj->n", differences, np.linalg.inv(cov), differences)
    expected = -0.5 * (quadratic + np.linalg.slogdet(TURN * cov)[1])
    np.testing.assert_allclose(log_scale - 0.5 * np.sum(np.asarray(whitened) ** 2, axis=1), expected, rtol=1e-9)
    assert not wrapped.any()


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_whole_turns_and_a_common_offset_change_nothing(form):
    rng = np.random.default_rng(1)
    phases = rng.normal(size=(200, 8)) * 0.8
    seen = rng.random(8) < 0.8
    turned = phases + TURN * rng.integers(-3, 4, phases.shape) + rng.uniform(-3, 3, (200, 1))
    for a, b in zip(_residual(form, phases, seen, 0.5), _residual(form, turned, seen, 0.5), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_both_forms_agree_where_neither_flags_a_wrap_and_flag_the_same_rows():
    phases = np.random.default_rng(2).normal(size=(4000, 8)) * 0.9
    seen = np.array([1, 1, 1, 0, 1, 1, 1, 1], bool)
    default, paper = (_residual(form, phases, seen, 1.0) for form in (centred, pairwise))
    apart = np.abs(np.asarray(default[0] - paper[0])).max(axis=1) > 1e-9
    flagged = np.asarray(default[3]), np.asarray(paper[3])
    assert 0.05 < apart.mean() < 0.95
    np.testing.assert_array_equal(apart, flagged[0])
    np.testing.assert_array_equal(apart, flagged[1])


def test_three_phases_a_third_of_a_turn_apart_are_flagged_by_both_forms():
    phases = np.array([[0.0, TURN / 3, -TURN / 3]])
    for form in FORMS.values():
        assert bool(_residual(form, phases, np.ones(3, bool), 0.3)[3][0])


def test_the_default_form_is_closer_to_the_truth_than_the_papers_when_noise_wraps():
    # At 0.7 rad pairwise differences wrap often; the error of the centred residuals shows which form wraps correctly.
    noise = np.random.default_rng(3).normal(size=(4000, 8)) * 0.9
    exact = noise - noise.mean(axis=1, keepdims=True)
    errors = [
        np.sqrt(np.mean((np.asarray(_residual(form, noise, np.ones(8, bool), 1.0)[0]) - exact) ** 2))
        for form in FORMS.values()
    ]
    assert errors[0] < 0.8 * errors[1]


def test_the_circular_mean_is_the_angle_of_the_sum_of_phasors():
    rng = np.random.default_rng(4)
    angles, seen = rng.uniform(-50, 50, (20_000, 8)), rng.random((20_000, 8)) < 0.8
    seen[:, 0] = True
    phasor = np.sum(np.where(seen, np.exp(1j * angles), 0), axis=1)

    def one(values, mask):
        weights = [jnp.where(m, 1.0, 0.0) for m in mask]
        return circular_mean(list(values), weights, sum(weights))

    mean = jax.jit(jax.vmap(one))(jnp.asarray(angles), jnp.asarray(seen))
    clear = np.abs(phasor) > 0.1
    # The promise is 1e-5 rad; phasors near zero amplify the sine's own error of 1e-8 by their inverse.
    difference = np.angle(np.exp(1j * (np.asarray(mean) - np.angle(phasor))))
    assert clear.mean() > 0.99
    assert np.abs(difference[clear]).max() < 1e-5


def test_the_arctangent_is_right_in_every_quadrant_and_zero_at_the_origin():
    angle = np.linspace(-np.pi, np.pi, 100_001)[1:]
    for length in (1e-6, 1.0, 1e6):
        result = np.asarray(jax.jit(arctangent)(length * np.sin(angle), length * np.cos(angle)))
        assert np.abs(np.angle(np.exp(1j * (result - angle)))).max() < 1e-5
    assert float(arctangent(jnp.asarray(0.0), jnp.asarray(0.0))) == 0
