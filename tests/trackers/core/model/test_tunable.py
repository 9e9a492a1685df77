"""Tunables keep their physical value, are found by name, and refuse what they can't hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trackwright.trackers.core.model.motion import ConstantVelocity
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.model.tunable import (
    Covariance,
    Fraction,
    Real,
    Scale,
    Threshold,
    matching,
    replaced,
    tunables,
    with_values,
)
from trackwright.trackers.core.run.track_loss import TrackLossPolicy


class Gauge(AbstractSensor):
    """A sensor with tunables under it, never read."""

    sigma_p: Scale
    offsets: Real

    channels, measure, residual = (), None, None


TREE = {
    "motion": ConstantVelocity(0.3, 2),
    "sensors": {
        "north": Gauge(Scale(0.1, "rad"), Real(np.zeros(3), "rad")),
        "south": Gauge(Scale(0.2, "rad"), Real(0.5)),
    },
}


@settings(max_examples=100, deadline=None)
@given(st.floats(1e-12, 1e12), st.floats(1e-9, 1 - 1e-9), st.floats(-1e6, 1e6), st.floats(1e-3, 1e3))
def test_a_value_comes_back_from_its_unconstrained_form(positive, fraction, real, typical):
    assert float(Scale(positive).value) == pytest.approx(positive, rel=1e-13)
    assert float(Fraction(fraction).value) == pytest.approx(fraction, rel=1e-9)
    assert float(Real(real, typical=typical).value) == pytest.approx(real, rel=1e-13, abs=1e-300)


def test_a_threshold_is_set_by_name_and_disabled_without_another_tree():
    tree = {"policy": TrackLossPolicy(), "sigma": Scale(0.1)}
    assert set(tunables(tree)) == {"policy.nis_limit", "policy.nis_window", "policy.max_gap", "sigma"}
    disabled = with_values(tree, {"policy.max_gap": np.inf})
    assert np.isinf(disabled["policy"].max_gap.value)
    structures = [jax.tree_util.tree_structure(t) for t in (tree, disabled, tree | {"policy": TrackLossPolicy(np.inf)})]
    assert structures[0] == structures[1] == structures[2]
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="a Threshold is positive, np.inf to disable it, found"):
            Threshold(wrong)


def test_a_covariance_comes_back_from_its_factor():
    # Measured on a still tag, cm² (SPEC D.3): all signs of correlation.
    R = np.array([[8.410, 3.510, -1.230], [3.510, 10.345, -0.769], [-1.230, -0.769, 0.584]])
    np.testing.assert_allclose(Covariance(R, "cm^2").value, R, rtol=1e-13)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_any_raw_numbers_are_a_covariance(raw):
    some = Covariance(np.eye(3))
    lower = np.zeros((3, 3))
    lower[np.tril_indices(3)] = raw
    value = np.asarray(jax.tree_util.tree_map(lambda _: lower, some).value)
    np.testing.assert_array_equal(value, value.T)
    # Roots of the eigenvalues range from e⁻³ to e³ with couplings of 3: a condition number of 1e8 at most.
    assert np.linalg.eigvalsh(value).min() > -1e-12 * np.linalg.eigvalsh(value).max()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Scale(0.0), "positive and finite, found 0.0; a noise that is absent is left out"),
        (lambda: Scale([1.0, -2.0]), "positive and finite"),
        (lambda: Fraction(1.0), "strictly between 0 and 1, found 1.0"),
        (lambda: Real(np.inf), "finite, found inf"),
        (lambda: Covariance([[1.0, 2.0], [2.0, 1.0]]), "symmetric positive definite"),
    ],
)
def test_a_value_that_a_tunable_cannot_have_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_patterns_choose_by_name():
    assert list(matching(TREE, "sensors.*.sigma_p")) == ["sensors.north.sigma_p", "sensors.south.sigma_p"]
    assert list(matching(TREE, ("motion.*", "*.north.offsets"))) == ["motion.sigma_a", "sensors.north.offsets"]
    assert list(matching(TREE, ("motion.*", "*"))) == list(tunables(TREE))


def test_replacing_changes_what_is_named_and_nothing_else():
    other = replaced(TREE, {"sensors.south.sigma_p": Scale(0.7, "rad")})
    values = {name: np.asarray(node.value) for name, node in tunables(other).items()}
    assert float(values.pop("sensors.south.sigma_p")) == pytest.approx(0.7)
    for name, value in values.items():
        np.testing.assert_array_equal(value, tunables(TREE)[name].value)


@pytest.mark.parametrize(
    ("tunable", "values"),
    [
        (Scale(1.0, "m", "process noise", "horizontal"), np.array([0.3, 2.0])),
        (Fraction(0.5), np.array([0.1, 0.9])),
        (Real(1.0, "rad", 0.1), np.array([-0.3, 2.0])),
        (Covariance(np.eye(2), "m^2"), np.array([[[2.0, 0.5], [0.5, 1.0]], [[1.0, -0.3], [-0.3, 4.0]]])),
    ],
    ids=lambda x: type(x).__name__,
)
def test_a_traced_value_is_taken_without_a_check(tunable, values):
    traced = jax.jit(jax.vmap(lambda value: tunable.with_value(value).raw))(values)
    np.testing.assert_allclose(traced, [tunable.with_value(value).raw for value in values], rtol=1e-14)
    slope = jax.jit(jax.grad(lambda value: jnp.sum(tunable.with_value(value).value)))(values[0])
    # The value itself, seen through its unconstrained number.
    np.testing.assert_allclose(slope + np.transpose(slope), 2 * np.ones(np.shape(values[0])), rtol=1e-12)
