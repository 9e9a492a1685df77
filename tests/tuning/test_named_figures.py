"""Figures of trackers by name: best for the true model, and what is left without truth; the tails of the NIS."""

from typing import Any

import equinox as eqx
import numpy as np
import pytest

from tests.tuning.worlds import Gauge, line_tracker, walks
from trackwright.trackers.aoa.fusion import bearing_tracker
from trackwright.trackers.baselines.fixes import MovingWindow, fix_tracker
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.mhk.tracker import mhk_tracker
from trackwright.tuning.diagnostics import student_t_dof_of
from trackwright.tuning.named_objectives import all_metrics


@pytest.fixture(scope="module")
def figures():
    """All figures of the true model and of two that lie, over 12,800 rows of the model's own world."""
    world = stack(walks([200] * 64, 1))
    levels = {"true": (0.3, 0.2), "too sure": (0.3, 0.1), "wild": (3.0, 0.2)}
    return {k: all_metrics(line_tracker(*v), world, "position", 1) for k, v in levels.items()}


def test_every_figure_is_best_for_the_true_model(figures):
    for name in ("nll", "rmse", "state-nll"):
        assert figures["true"][name] == min(f[name] for f in figures.values())
    assert np.isnan(figures["true"]["rmse-3d"])


def test_without_truth_what_needs_none_is_left(figures):
    silent = [r.__class__(r.times, r.readings, r.inputs) for r in walks([200] * 64, 1)]
    found = all_metrics(line_tracker(), stack(silent), "position", 1)
    assert {k for k, v in found.items() if np.isfinite(v)} == {"nll"}
    assert found["nll"] == pytest.approx(figures["true"]["nll"], rel=1e-12)


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
