"""The band of NIS, and the spread that a scale of Student's t implies."""

import numpy as np
import pytest

from trackwright.tuning.diagnostics import (
    nis_band,
    student_t_spread,
)


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


@pytest.mark.parametrize(("dof", "skew"), [(30.0, 1.0), (6.0, 3.0), (1.8, 4.0), (1.0, 1.0)])
def test_the_spread_is_that_of_draws(dof, skew):
    rng = np.random.default_rng(4)
    up = rng.random(2_000_000) < skew / (1 + skew)
    drawn = 0.02 * np.abs(rng.standard_t(dof, len(up))) * np.where(up, skew, -1.0)
    found = student_t_spread(0.02, dof, skew)
    assert found.is_deviation is (dof > 2)
    expected = drawn.std() if found.is_deviation else np.subtract(*np.quantile(drawn, [0.84, 0.16])) / 2
    assert found.value == pytest.approx(expected, rel=0.02)
