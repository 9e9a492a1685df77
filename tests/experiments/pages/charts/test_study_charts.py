"""Charts of a study: a bound is a line among the errors, and a grid of a world's parameter has its unit."""

import base64
from types import SimpleNamespace

import numpy as np
import pytest

from trackwright.experiments.monte_carlo import Study, TrackerConfig, World
from trackwright.experiments.pages.charts.study import metric_chart
from trackwright.experiments.text.expectations import Value
from trackwright.experiments.text.wording import Unit
from trackwright.sim.worlds import WORLDS
from trackwright.trackers.evaluation.metrics import METRICS

USUAL = Value(0.01, 0.009, 0.06)


def _chart(name, values, bounds=None, metric="rmse_m", value=USUAL):
    """The chart of a metric over a grid of two trackers."""
    study = Study(
        name="grid",
        about="",
        worlds={"hand": World(WORLDS["station"])},
        trackers={"direct": TrackerConfig("direct"), "cascade": TrackerConfig("cascade")},
        grid={name: values},
        runs=2,
    )
    found = {
        (c.index, t): value._replace(value=value.value * (1 + c.index))
        for c in study.conditions
        for t in study.trackers
    }
    limits = None if bounds is None else {key: Value(b, b, b) for key, b in zip(found, bounds, strict=True)}
    return metric_chart(SimpleNamespace(study=study), metric, found, Unit("cm", 100.0), limits)


def _drawn(*given, **named):
    """The SVG of that chart."""
    chart = _chart(*given, **named)
    return base64.b64decode(chart.address.split(",", 1)[1]).decode().partition("<metadata")[0]


def test_the_bound_is_a_line_among_the_errors():
    with_bound = _drawn("world.sigma_p", [0.1, 0.2, 0.3], [0.005, np.nan] * 3)
    assert with_bound.count("Cramér–Rao bound") == 1
    assert "direct: Cramér–Rao bound" in with_bound
    assert "Cramér–Rao bound" not in _drawn("world.sigma_p", [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("name", "label"),
    [("world.sigma_p, sensors.*.sigma_p", "sigma_p (rad)"), ("world.drop_outs", "drop_outs"), ("motion.sigma_a", "motion.sigma_a")],
)  # fmt: skip
def test_the_grid_of_a_worlds_parameter_has_its_unit(name, label):
    assert f">{label}</text>" in _drawn(name, [0.1, 0.2, 0.3])


def test_what_right_covariances_give_is_a_line_at_its_value():
    assert [METRICS[m].right for m in ("coverage_95", "coverage_50_3d", "nis_ratio", "nees_3d_mean", "rmse_m")] == [
        0.95, 0.5, 1.0, 3.0, None,
    ]  # fmt: skip
    assert [name for name, metric in METRICS.items() if name.startswith("coverage") and metric.page] == ["coverage_95"]
    grid = "world.sigma_p", [0.1, 0.2, 0.3]
    assert "95 expected" in _drawn(*grid, metric="coverage_95")
    assert "expected" not in _drawn(*grid)
    assert "(line: 95)" in _drawn("world.path", ["helix", "hand"], metric="coverage_95")


def test_a_metric_without_a_value_above_zero_has_no_chart():
    grid = "world.sigma_p", [0.1, 0.2, 0.3]
    assert _chart(*grid, metric="diverged", value=Value(0.0, 0.0, 0.0)) is None
    # An interval may reach down to zero.
    assert _chart(*grid, metric="diverged", value=Value(0.01, 0.0, 0.03)) is not None
