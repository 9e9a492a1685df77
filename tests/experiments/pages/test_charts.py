"""Charts hold the numbers they were given, for plotly.js and matplotlib alike, and take odd input; those of studies too."""

from dataclasses import replace
from types import SimpleNamespace

import matplotlib as mpl
import matplotlib.pyplot
import numpy as np
import polars as pl
import pytest
import scipy.stats
from matplotlib.image import imread

from tests.experiments.pages.small_tracks import BIAS, TAGS, small_bearings, small_run, small_tracks
from trackwright.experiments.monte_carlo import Study, TrackerConfig, World
from trackwright.experiments.pages import charts
from trackwright.experiments.pages.calibration import Source
from trackwright.experiments.pages.chart import Chart, Line, band, broken_at_gaps, draw, numbers, write
from trackwright.experiments.pages.comparison import comparison_charts
from trackwright.experiments.pages.study import study_charts
from trackwright.experiments.text.expectations import Value
from trackwright.sim.worlds import WORLDS
from trackwright.trackers.core.errors import UnusableInput
from trackwright.tuning.calibrating import Pairs

mpl.use("Agg")


@pytest.fixture(autouse=True)
def _closed_figures():
    yield
    mpl.pyplot.close("all")


def _lines(chart):
    """The named lines of a chart, by the part of their name before a colon."""
    return {part.name.partition(":")[0]: part for part in chart.parts if part.name}


@pytest.fixture(scope="module")
def scored():
    return small_tracks().recordings[0]


PARTS = [
    band([0, 1, 2, 3, 4], [0, 0, np.nan, 1, 1], [1, 1, 2, 2, 2], "band"),
    Line([1, 2, np.nan, 4], [10, 20, 30, 40], "<line> $5", marker="circle", text=["a", "b"]),
]
CHART = Chart("one", "A <title>", "x (m)", "y", PARTS, ylim=(0.1, 100), log="y", note="a note")


def test_a_chart_has_the_same_numbers_for_a_page_and_for_matplotlib(tmp_path):
    page, axes = CHART.plotly(), draw(CHART)
    area, line = page["data"]
    assert [area["x"], area["y"]] == [[0, 1, 1, 0, None, 3, 4, 4, 3, None], [0, 0, 1, 1, None, 1, 1, 2, 2, None]]
    assert (line["name"], line["x"], line["mode"]) == ("&lt;line&gt; $5", [1, 2, None, 4], "lines+markers+text")
    assert page["layout"]["yaxis"]["type"] == axes.get_yscale() == "log"
    np.testing.assert_allclose(10 ** np.array(page["layout"]["yaxis"]["range"]), axes.get_ylim())
    assert page["layout"]["xaxis"]["range"] == [None, None]
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [1, 2, np.nan, 4])
    assert len(axes.patches) == 2
    assert axes.get_xlabel() == "x (m)\na note"
    assert [label.partition("$")[0] for label in axes.get_legend_handles_labels()[1]] == ["band", "<line> \\"]
    picture = imread(write(CHART, tmp_path / "one.png"))
    assert min(picture.shape[:2]) > 200
    assert np.ptp(picture) > 0.5
    with pytest.raises(UnusableInput, match="cannot write"):
        write(CHART, tmp_path / "none" / "one.png")


def test_lines_are_broken_in_gaps_only_and_numbers_have_nine_digits():
    assert numbers([4e6, 4e6 + 1.23456, np.nan, np.inf]) == [4e6, 4000001.23, None, None]
    at, values = broken_at_gaps(np.array([0.0, 0.1, 0.2, 5.0, 5.1]), np.arange(5.0))
    np.testing.assert_array_equal(values, [0, 1, 2, np.nan, 3, 4])
    assert at[3] == pytest.approx(2.6)


def test_wild_estimates_are_counted_and_do_not_decide_the_scale_of_the_plan():
    wild = pl.when(pl.int_range(pl.len()) == 40).then(1e4).otherwise(pl.col("x_m"))
    tracks = small_tracks(tags=("A",))
    chart = charts.floor_plan(replace(tracks.recordings[0], rows=tracks.rows.with_columns(x_m=wild)))
    assert chart.xlim[1] < 20
    assert "1 of 80 estimates lie outside the axes." in chart.note
    assert {"truth", "tag A", "anchor"} == {*_lines(chart)}
    assert [*_lines(chart)["anchor"].text] == ["1", "2", "10", "11"]


def test_the_ellipses_of_a_plan_hold_95_percent_of_the_reported_normal_distribution():
    centre, cov = np.array([[1.0, 2.0]]), np.array([[[0.5, 0.2], [0.2, 0.3]]])
    off = (charts.ellipses(centre, cov)[:-1] - centre).T
    np.testing.assert_allclose((off * np.linalg.solve(cov[0], off)).sum(axis=0), scipy.stats.chi2.ppf(0.95, 2))


@pytest.mark.parametrize("rows", [2, 3, 80])
def test_every_chart_of_a_recording_takes_next_to_no_rows(rows):
    one = small_tracks(rows=rows, tags=("A",)).recordings[0]
    made = [charts.floor_plan(one), charts.error_cdf(one), charts.coverage(one), charts.error_over_time(one)]
    made += [charts.nis_over_time(one), charts.nees_over_time(one)]
    assert all(np.isfinite(draw(chart).get_ylim()).all() for chart in made)


def test_errors_over_time_are_those_of_the_rows(scored):
    lines, rows = _lines(charts.error_over_time(scored, "A")), scored.rows_of(charts.track_number(scored, "A"))
    np.testing.assert_allclose(lines["error"].y, scored.miss[rows])
    assert np.nanmax(lines["reported standard deviation"].y) == pytest.approx(0.05 * np.sqrt(1.5))
    bearings = small_bearings(False)[0].recordings[0]
    np.testing.assert_allclose(_lines(charts.error_over_time(bearings))["error"].y, np.degrees(bearings.miss))


def test_means_of_nees_over_time_are_those_of_the_rows_in_windows_of_time(scored):
    lines = _lines(charts.nees_over_time(scored))
    (mean,) = (line for name, line in lines.items() if name.startswith("mean of"))
    nees = scored.rows["nees"].to_numpy()[np.argsort(scored.times, kind="stable")]
    expected = [part.mean() / 2 for part in np.array_split(nees[np.isfinite(nees)], len(np.asarray(mean.y)))]
    np.testing.assert_allclose(mean.y, expected)
    assert "95 % band, rows as correlated as these" in lines
    unknown = charts.nis_over_time(replace(scored, student_t_dof=float("nan")))
    assert not any("band" in name for name in _lines(unknown))


def test_the_error_cdf_and_the_coverage_are_shares_of_rows(scored):
    errors = scored.miss[np.isfinite(scored.miss)]
    line = _lines(charts.error_cdf(scored))["horizontal"]
    below = 100 * (errors[:, None] < np.asarray(line.x) / 100).mean(axis=0)
    np.testing.assert_allclose(line.y, below, atol=101 / len(errors))
    assert f"p95 {100 * np.percentile(errors, 95):.3g}" in line.name
    nees = scored.rows["nees"].drop_nulls().drop_nans().to_numpy()
    curve = _lines(charts.coverage(scored))["horizontal"]
    for level, share in zip(np.asarray(curve.x)[::20], np.asarray(curve.y)[::20], strict=True):
        assert share == pytest.approx(100 * np.mean(nees <= scipy.stats.chi2.ppf(level / 100, 2)))


def test_the_bias_of_an_anchor_is_its_median_residual(scored):
    tags, (found,) = charts.residuals(scored)
    assert (tags, found.sources) == ([*TAGS], ["1", "2", "10", "11"])
    medians = [np.nanmedian(found.values[(found.source == k) & (found.tag == 0)]) for k in range(4)]
    np.testing.assert_allclose(medians, [0, BIAS, 0, 0], atol=0.03)


def test_the_tail_of_one_run_does_not_set_the_axis_of_errors():
    good = small_run({"a": 0.2})
    last = pl.int_range(pl.len()) == pl.len() - 1
    bad = good.with_columns(size_m=pl.when(last).then(50.0).otherwise("size_m"))
    for runs in ({"good": good, "bad": bad}, {"bad": bad, "good": good}):
        errors, _ = comparison_charts(runs)
        assert errors.xlim[1] < 25  # cm
        assert sorted(part.name.partition(" cm")[2] for part in errors.parts) == ["", ", 3.3 % beyond"]


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


def _source(true, error, number):
    values = np.asarray(true)[:, None]
    pairs = Pairs(values, values + np.asarray(error)[:, None], np.zeros((len(true), 3)), number, *[number] * 5)
    return Source("anchors", "A", "range", 0, pairs)


def test_a_short_recording_counts_as_much_as_a_long_one_in_the_spread_of_errors():
    errors, number = np.array([0.1, -1.0, -0.3, 0.2, np.nan, 0.4]), np.array([0, 1, 0, 0, 0, 0])
    source = _source(np.zeros(6), errors, number)
    # Half of the weight is that of the one row of 1 m: it holds the percentiles above the 50th.
    assert source.spread(errors) == 1.0
    assert source.spread(np.where(number == 0, errors, np.nan)) == 0.3
    assert np.isnan(source.spread(np.full(6, np.nan)))
