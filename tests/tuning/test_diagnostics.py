"""The band, the quantiles and the density of NIS, and the noise that makes its tail."""

from typing import Any

import equinox as eqx
import numpy as np
import pytest
from scipy import stats

from tests.tuning.worlds import Gauge, line_tracker
from trackwright.trackers.aoa.fusion import bearing_tracker
from trackwright.trackers.baselines.fixes import MovingWindow, fix_tracker
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.mhk.tracker import mhk_tracker
from trackwright.tuning.diagnostics import Innovations, expected_density, nis_band, nis_quantile, student_t_dof_of


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


def test_the_density_is_the_mixture_of_the_rows_degrees_of_freedom():
    x = np.linspace(0.1, 9, 5)
    wanted = 0.75 * stats.chi2.pdf(x, 2) + 0.25 * stats.chi2.pdf(x, 5)
    seen = Innovations(np.ones(4), np.array([2.0, 5.0, 2.0, 2.0]))
    np.testing.assert_allclose(expected_density(x, seen), wanted, rtol=1e-12)


@pytest.mark.parametrize("nu", [None, 4.0])
def test_the_quantile_and_the_density_belong_together(nu):
    end = nis_quantile(0.9, 2.0, nu)
    x = (np.arange(4000) + 0.5) * end / 4000
    density = expected_density(x, Innovations(x, np.full(len(x), 2.0), student_t_dof=nu))
    assert density.mean() * end == pytest.approx(0.9, abs=1e-4)


def test_the_density_of_a_heavy_tail_is_finite_and_ends():
    x = np.linspace(0.01, 12, 500)
    seen = Innovations(x, np.ones(len(x)), student_t_dof=1.8)
    density = expected_density(x, seen)
    assert np.isfinite(density).all()
    # The NIS of a row with one degree of freedom is below 1 + 1.8.
    assert (density[x < 2.8] > 0).all()
    assert (density[x > 2.8] == 0).all()


def test_what_makes_the_nis_says_its_tail():
    assert float(student_t_dof_of(bearing_tracker(4, dof=5.0))) == pytest.approx(5.0)
    assert student_t_dof_of(line_tracker()) is None
    assert float(student_t_dof_of(fix_tracker(dof=7.0))) == pytest.approx(7.0)
    # the NIS of a smoothed tracker is its filter's, and that of MH-K is its fusion's
    assert float(student_t_dof_of(Smoothed(fix_tracker(dof=7.0)))) == pytest.approx(7.0)
    assert student_t_dof_of(mhk_tracker()) is None
    assert student_t_dof_of(MovingWindow(5, False)) is None


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
    assert float(student_t_dof_of(own)) == pytest.approx(6.0)
    both = Tracker(whole.motion, {"gauge": heavy, "other": gauge}, whole.start, track_loss=whole.track_loss)
    with pytest.raises(ValueError, match="2 sensors, 1 of them with Student's t"):
        student_t_dof_of(both)
