"""The band and the quantiles of NIS, and the noise that makes its tail."""

from typing import Any

import equinox as eqx
import numpy as np
import pytest

from tests.tuning.worlds import Gauge, line_tracker
from trackwright.trackers.aoa.fusion import bearing_tracker
from trackwright.trackers.baselines.fixes import MovingWindow, fix_tracker
from trackwright.trackers.core.data.consistency import nis_band, nis_quantile, student_t_dof_of
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.mhk.tracker import mhk_tracker


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
