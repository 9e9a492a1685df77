"""NEES against a solver row by row, chi-square against closed forms, consistency and the band of NIS against Monte Carlo."""

import math
from typing import Any

import equinox as eqx
import numpy as np
import pytest

from tests.tuning.worlds import Gauge, line_tracker
from trackwright.trackers.aoa.fusion import bearing_tracker
from trackwright.trackers.baselines.fixes import MovingWindow, fix_tracker
from trackwright.trackers.core.data.consistency import consistency, nees, nis_band, nis_quantile, student_t_dof_of
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.mhk.tracker import mhk_tracker


@pytest.fixture
def rng():
    return np.random.default_rng(20240611)


def _covariances(rng, n, d):
    factors = rng.normal(size=(n, d, d)) + 2 * np.eye(d)
    return factors @ factors.transpose(0, 2, 1)


def _even_chi_square_cdf(x, dof):
    """The closed form for even degrees of freedom: one minus a sum of Poisson probabilities."""
    k = np.arange(dof // 2)
    return 1.0 - math.fsum(np.exp(k * math.log(x / 2) - x / 2 - np.array([math.lgamma(j + 1.0) for j in k])))


@pytest.mark.parametrize("d", [1, 2, 3, 6])
def test_nees_is_the_quadratic_form_solved_row_by_row(rng, d):
    covs, errors = _covariances(rng, 30, d), rng.normal(size=(30, d))
    expected = [e @ np.linalg.solve(P, e) for e, P in zip(errors, covs, strict=True)]
    # Both are direct solvers in double precision on matrices with condition numbers up to some thousands.
    np.testing.assert_allclose(nees(errors, covs), expected, rtol=1e-9)


def test_nees_is_nan_where_the_covariance_is_singular_and_right_elsewhere(rng):
    covs, errors = _covariances(rng, 4, 3), rng.normal(size=(4, 3))
    alone = nees(errors, covs)
    covs[1, 2, :] = covs[1, :, 2] = 0.0
    covs[2] = np.diag([1.0, -1.0, 1.0])
    values = nees(errors, covs)
    assert np.isnan(values[[1, 2]]).all()
    assert (values[[0, 3]] == alone[[0, 3]]).all()


def test_nees_of_a_damaged_covariance_is_no_number_or_infinite_and_the_others_are_right(rng):
    covs, errors = _covariances(rng, 4, 2), np.ones((4, 2))
    right = nees(errors, covs)
    covs[0] = [[1e-300, 1e200], [1e200, 1.0]]
    values = nees(errors, covs)
    assert not np.isfinite(values[0])
    np.testing.assert_array_equal(values[1:], right[1:])


def test_mean_nees_of_true_covariances_lies_inside_its_bounds_as_often_as_promised(rng):
    studies, runs, d = 2000, 20, 3
    covs = _covariances(rng, runs, d)
    inside = []
    for _ in range(studies):
        errors = np.einsum("nij,nj->ni", np.linalg.cholesky(covs), rng.normal(size=covs.shape[:2]))
        interval = consistency(nees(errors, covs), d)
        inside.append(interval.low <= interval.mean <= interval.high)
    # Four standard errors of a share of 0.95 in 2,000 studies.
    assert np.mean(inside) == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / studies))


def test_bounds_of_values_with_different_dof_are_those_of_their_sum(rng):
    interval = consistency(np.array([2.0, 8.0, 5.0, 5.0]), dof=np.array([2.0, 8.0, 5.0, 5.0]))
    assert (interval.mean, interval.expected, interval.n) == (5.0, 5.0, 4)
    assert _even_chi_square_cdf(4 * interval.low, 20) == pytest.approx(0.025, abs=1e-9)
    assert _even_chi_square_cdf(4 * interval.high, 20) == pytest.approx(0.975, abs=1e-9)


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


@pytest.mark.parametrize("nu", [None, 4.0])
def test_a_quantile_is_that_of_rows_with_the_noise(nu):
    rng = np.random.default_rng(2)
    square = (rng.normal(size=200_000) if nu is None else rng.standard_t(nu, 200_000)) ** 2
    nis = square if nu is None else square * (nu + 1) / (nu + square)
    assert np.mean(nis < nis_quantile(0.9, 1.0, nu)) == pytest.approx(0.9, abs=0.003)


def test_what_makes_the_nis_says_its_tail():
    assert float(student_t_dof_of(bearing_tracker(4, dof=5.0).nis_sensors)) == pytest.approx(5.0)
    assert student_t_dof_of(line_tracker().nis_sensors) is None
    assert float(student_t_dof_of(fix_tracker(dof=7.0).nis_sensors)) == pytest.approx(7.0)
    # the NIS of a smoothed tracker is its filter's, and that of MH-K is its fusion's
    assert float(student_t_dof_of(Smoothed(fix_tracker(dof=7.0)).nis_sensors)) == pytest.approx(7.0)
    assert student_t_dof_of(mhk_tracker().nis_sensors) is None
    assert student_t_dof_of(MovingWindow(5, False).nis_sensors) is None


class Heavy(Gauge):
    """A gauge whose noise is of Student's t, by a number of another name."""

    tail_weight: Any = eqx.field(default_factory=lambda: Scale(6.0))

    def residual(self, reading, predicted):
        return super().residual(reading, predicted)._replace(dof=self.tail_weight.value)


def test_the_degrees_of_freedom_are_those_of_the_residuals_whatever_the_field_is_called():
    whole = line_tracker()
    gauge = whole.sensors["gauge"]
    heavy = Heavy(gauge.sigma, gauge.offset, gauge.bias)
    own = Tracker(whole.motion, {"gauge": heavy}, whole.start, track_loss=whole.track_loss)
    assert float(student_t_dof_of(own.nis_sensors)) == pytest.approx(6.0)
    both = Tracker(whole.motion, {"gauge": heavy, "other": gauge}, whole.start, track_loss=whole.track_loss)
    with pytest.raises(ValueError, match="2 sensors, 1 of them with Student's t"):
        student_t_dof_of(both.nis_sensors)
