"""The band of NIS, and the spread that a scale of Student's t implies."""

import numpy as np
import pytest

import trackwright as tw
from trackwright.tuning.diagnostics import (
    Innovations,
    implied_spread,
    nis_band,
    nis_quantile,
    student_t_spread,
)

ROWS = 20_000


def _squares(noise):
    """Innovations of two numbers a row, from standardised noise (n, 2)."""
    return Innovations((noise**2).sum(axis=1), np.full(len(noise), 2.0), np.zeros(len(noise), int))


@pytest.fixture(scope="module")
def white():
    return np.random.default_rng(3).normal(size=(ROWS, 2))


@pytest.mark.parametrize(("nu", "skew"), [(None, 1.0), (1.8, 4.0), (4.0, 1.0)])
def test_means_of_nis_lie_in_the_band_of_the_noise_that_made_them(nu, skew):
    rng = np.random.default_rng(1)
    # Residuals of a two-piece density, each half over its own scale, as `RangeSensor` whitens them.
    up = rng.random((4000, 50)) < skew / (1 + skew)
    raw = np.abs(rng.normal(size=up.shape) if nu is None else rng.standard_t(nu, up.shape)) * np.where(up, skew, -1)
    square = np.where(raw > 0, raw / skew, raw) ** 2
    mean = (square if nu is None else square * (nu + 1) / (nu + square)).mean(axis=1)
    assert mean.mean() == pytest.approx(1.0, abs=0.01)
    low, high = nis_band(np.full(len(mean), 50.0), nu)
    assert np.mean((low <= mean) & (mean <= high)) == pytest.approx(0.95, abs=0.015)


def test_the_quantile_of_one_row_is_that_of_its_noise():
    t = np.random.default_rng(2).standard_t(1.8, 200_000) ** 2
    q = t * 2.8 / (1.8 + t)
    for p in (0.025, 0.5, 0.975):
        assert np.mean(q <= nis_quantile(p, 1.0, 1.8)) == pytest.approx(p, abs=3e-3)
        assert nis_quantile(p, 2.0) == pytest.approx(-2 * np.log(1 - p))


@pytest.mark.parametrize(("dof", "skew"), [(30.0, 1.0), (6.0, 3.0), (1.8, 4.0), (1.0, 1.0)])
def test_the_spread_is_that_of_draws(dof, skew):
    rng = np.random.default_rng(4)
    up = rng.random(2_000_000) < skew / (1 + skew)
    drawn = 0.02 * np.abs(rng.standard_t(dof, len(up))) * np.where(up, skew, -1.0)
    found = student_t_spread(0.02, dof, skew)
    assert found.is_deviation is (dof > 2)
    expected = drawn.std() if found.is_deviation else np.subtract(*np.quantile(drawn, [0.84, 0.16])) / 2
    assert found.value == pytest.approx(expected, rel=0.02)


def test_only_a_scale_of_students_t_has_one():
    tracker = tw.range_tracker(4)
    found, expected = implied_spread(tracker, "sensors.ranges.sigma_r"), student_t_spread(0.09, 1.8, 4.0)
    assert (found.value, found.is_deviation) == (pytest.approx(expected.value), False)
    assert implied_spread(tracker, "sensors.ranges.dof") is None
    assert implied_spread(tracker, "motion.sigma_a") is None
    assert implied_spread(tw.fix_tracker(dof=None), "sensors.fixes.sigma_horizontal") is None
