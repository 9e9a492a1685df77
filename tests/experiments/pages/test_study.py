"""The chart of a study: its first metric with intervals, along a grid of numbers or by condition."""

from types import SimpleNamespace

import pytest

from trackwright.experiments.monte_carlo import Study, TrackerConfig, World
from trackwright.experiments.pages.study import study_charts
from trackwright.experiments.text.expectations import Value
from trackwright.sim.worlds import WORLDS


@pytest.mark.parametrize("values", [[0.3, 0.1, 0.2], [0.1, 0.2]], ids=["lines", "rows"])
def test_the_first_metric_with_values_is_drawn_with_its_intervals(values):
    trackers = {"direct": TrackerConfig("direct"), "cascade": TrackerConfig("cascade")}
    study = Study(name="grid", about="", worlds={"hand": World(WORLDS["station"])}, trackers=trackers,
                  grid={"world.sigma_p": values}, runs=2)  # fmt: skip
    found = {(c.index, t): Value(0.01 * (1 + c.index), 0.009, 0.06) for c in study.conditions for t in trackers}
    nothing = dict.fromkeys(found, Value(0.0, 0.0, 0.0))
    results = SimpleNamespace(study=study, main_metrics=lambda: {"max_m": nothing, "rmse_m": found})
    (chart,) = study_charts(results)
    assert chart.title == "RMSE, mm" if len(values) > 2 else chart.yticks
    drawn = {part.name: part for part in chart.parts if part.marker}
    assert [*drawn] == [*trackers]
    first = drawn["direct"]
    along, expected = (first.y, [20, 30, 10]) if len(values) > 2 else (first.x, [10, 20])
    assert [*along] == pytest.approx(expected)
    if len(values) > 2:
        assert [*first.x] == sorted(values)
    assert study_charts(SimpleNamespace(study=study, main_metrics=lambda: {"max_m": nothing})) == []
