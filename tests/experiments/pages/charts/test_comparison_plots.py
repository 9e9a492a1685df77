"""The figures of a comparison: of many recordings the worst, the median and the best have floor plans."""

import dataclasses

import numpy as np
import polars as pl

from tests.experiments.pages.charts.small_runs import ANCHORS, chart_data, small_run
from trackwright.experiments.pages.charts import comparison


def test_floor_plans_are_of_the_worst_the_median_and_the_best_by_the_first_run():
    first = small_run("uwb", {"a": 0.2, "b": 0.9, "c": 0.1, "d": 0.5, "e": 0.3})
    second = small_run("median", {"b": 0.1, "c": 0.8, "d": 0.7, "e": 0.6, "a": 0.5})
    charts = [chart for chart in comparison.comparison_charts([first, second], []) if "plan" in chart.name]
    assert [chart.name for chart in charts] == [
        f"floor_plan-{name}-{run}" for name in "bec" for run in ("uwb", "median")
    ]
    title = chart_data(charts[0].address)["layout"]["title"]
    assert title == "uwb, b,\nworst of 5, RMSE 90 cm by uwb"


def test_few_recordings_all_have_floor_plans():
    assert comparison._planned([small_run("uwb", {"a": 0.2, "b": 0.9})]) == {"a": "", "b": ""}


def test_floor_plans_of_the_page_have_names_a_legend_and_the_shape_of_the_floor():
    runs = [small_run("uwb", {"a": 0.2}), small_run("median", {"a": 0.5})]
    charts = comparison.comparison_charts(runs, [])
    plans = [chart_data(chart.address) for chart in charts if "Floor plan" in chart.title]
    assert len(plans) == 2
    for plan in plans:
        named = {trace["name"]: trace for trace in plan["data"] if trace["showlegend"]}
        assert set(named) == {"truth", "estimates", "start", "end", "anchor"}
        truth, estimates = named["truth"], named["estimates"]
        assert truth["line"]["color"] != estimates["line"]["color"]
        assert {label["text"] for label in plan["layout"]["annotations"]} == set(ANCHORS)
        low, high = np.transpose([plan["layout"][axis]["range"] for axis in ("xaxis", "yaxis")])
        assert low.max() < 0
        assert (high > [12, 8]).all()
        assert plan["height"] < 1.0


def test_the_tail_of_one_run_does_not_set_the_axis_of_errors():
    good, bad = small_run("good", {"a": 0.2}), small_run("bad", {"a": 0.2})
    last = pl.int_range(len(bad.rows)) == len(bad.rows) - 1
    bad = dataclasses.replace(bad, rows=bad.rows.with_columns(size_m=pl.when(last).then(50.0).otherwise("size_m")))
    for runs in ([good, bad], [bad, good]):
        distributions, violins = (chart_data(one.address) for one in comparison.comparison_charts(runs, [])[:2])
        assert distributions["layout"]["xaxis"]["range"][1] < 25  # cm
        assert violins["layout"]["yaxis"]["range"][1] < 25
        assert {trace["name"] for trace in distributions["data"]} == {"good", "bad, 3.3 % beyond"}
        assert violins["layout"]["title"] == "Errors by run"
        assert "quartiles" in violins["layout"]["xaxis"]["title"]["text"]
