"""Charts hold the numbers they were given, for plotly.js and matplotlib alike, and take odd input."""

from dataclasses import replace
from types import SimpleNamespace

import matplotlib as mpl
import matplotlib.pyplot
import numpy as np
import polars as pl
import pytest
import scipy.stats
from matplotlib.image import imread

from tests.experiments.pages.charts.small_runs import ANCHORS, small_run
from tests.experiments.pages.reports.small_tracks import BIAS, small_bearings, small_tracks
from trackwright.experiments.monte_carlo import Study, TrackerConfig, World
from trackwright.experiments.pages.charts import recording as charts
from trackwright.experiments.pages.charts.distributions import nis_chart
from trackwright.experiments.pages.charts.drawing import draw, write
from trackwright.experiments.pages.charts.residuals import error_map, residual_charts, residuals
from trackwright.experiments.pages.charts.style import Chart, Field, Line, band, broken_at_gaps, numbers
from trackwright.experiments.pages.charts.tuning import (
    OptimiserTrace,
    error_charts,
    innovation_charts,
    objective_chart,
    parameter_chart,
    rmse_chart,
    sweep_plot,
)
from trackwright.experiments.pages.reports.before_after import ErrorTrack
from trackwright.experiments.pages.reports.comparison import comparison_charts
from trackwright.experiments.pages.reports.study import metric_chart
from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.experiments.text.expectations import Value
from trackwright.experiments.text.wording import Unit
from trackwright.sim.worlds import WORLDS
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.evaluation.rows import scored_rows
from trackwright.tuning.diagnostics import Innovations
from trackwright.tuning.parameters import Parameter
from trackwright.tuning.sweeping import Sweep

mpl.use("Agg")


@pytest.fixture(autouse=True)
def _closed_figures():
    yield
    mpl.pyplot.close("all")


def _lines(chart):
    """The named lines of a chart, by the part of their name before a colon."""
    return {part.name.partition(":")[0]: part for part in chart.parts if isinstance(part, Line) and part.name}


def _changed(tracks, **columns):
    """The recording with other columns in its table."""
    return replace(tracks.recordings[0], rows=tracks.rows.with_columns(**columns))


@pytest.fixture(scope="module")
def scored():
    return small_tracks().recordings[0]


CHART = Chart(
    "one",
    "A <title>",
    "x (m)",
    "y",
    [
        band([0, 1, 2, 3, 4], [0, 0, np.nan, 1, 1], [1, 1, 2, 2, 2], "band"),
        Field([1, 2], [1, 2], [[1.0, np.nan], [3, 4]], "unit", "Viridis", 0, 4),
        Line([1, 2, np.nan, 4], [10, 20, 30, 40], "<line> $5", marker="circle-open", text=["a", "b"]),
    ],
    log="y",
    note="a note",
)


def test_a_chart_has_the_same_numbers_for_a_page_and_for_matplotlib(tmp_path):
    page, axes = CHART.plotly(), draw(CHART)
    area, field, line = page["data"]
    assert [area["x"], area["y"]] == [[0, 1, 1, 0, None, 3, 4, 4, 3, None], [0, 0, 1, 1, None, 1, 1, 2, 2, None]]
    assert field["z"] == [[1, None], [3, 4]]
    assert (line["name"], line["x"], line["mode"]) == ("&lt;line&gt; $5", [1, 2, None, 4], "lines+markers+text")
    assert page["layout"]["yaxis"]["type"] == axes.get_yscale() == "log"
    np.testing.assert_allclose(10 ** np.array(page["layout"]["yaxis"]["range"]), axes.get_ylim(), rtol=1e-3)
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [1, 2, np.nan, 4])
    assert len(axes.patches) == 2
    assert axes.get_xlabel() == "x (m)\na note"
    assert [label.partition("$")[0] for label in axes.get_legend_handles_labels()[1]] == ["band", "<line> \\"]
    picture = imread(write(CHART, tmp_path / "one.png"))
    assert min(picture.shape[:2]) > 200
    assert np.ptp(picture) > 0.5
    with pytest.raises(UnusableInput, match="cannot write"):
        write(CHART, tmp_path / "none" / "one.png")


def test_numbers_of_a_chart_have_five_digits_of_their_span():
    assert numbers([4e6, 4e6 + 1.23456, np.nan, np.inf]) == [4e6, 4000001.2346, None, None]
    assert numbers([0.000123456, 10.0]) == [0.00012346, 10.0]


def test_lines_are_broken_in_gaps_only():
    times = np.array([0.0, 0.1, 0.2, 5.0, 5.1])
    at, values = broken_at_gaps(times, np.arange(5.0))
    np.testing.assert_array_equal(values, [0, 1, 2, np.nan, 3, 4])
    assert at[3] == pytest.approx(2.6)


def test_wild_estimates_are_counted_and_do_not_decide_the_scale_of_the_plan():
    tracks = small_tracks(tags=("A",))
    wild = pl.when(pl.int_range(pl.len()) == 40).then(1e4).otherwise(pl.col("x_m"))
    chart = charts.floor_plan(_changed(tracks, x_m=wild))
    assert chart.limits("x")[1] < 20
    assert "1 of 80 estimates lie outside the axes." in chart.note
    assert {"truth", "tag A", "start", "end", "anchor"} == {*_lines(chart)}
    assert [*_lines(chart)["anchor"].text] == ["1", "2", "10, 11"]


@pytest.mark.parametrize("rows", [2, 3, 80])
def test_every_chart_of_a_recording_takes_next_to_no_rows(rows):
    one = small_tracks(rows=rows, tags=("A",)).recordings[0]
    made = [charts.floor_plan(one), charts.error_cdf(one), charts.coverage(one), charts.nis_histogram(one)]
    made += [charts.nis_over_time(one), charts.nees_over_time(one), *residual_charts(residuals(one)[1])]
    made += [charts.error_over_time(one, axis=axis) for axis in ("", "x", "y")]
    assert all(np.isfinite(draw(chart).get_ylim()).all() for chart in made)
    with pytest.raises(UnusableInput, match="no error along 'z'"):
        charts.error_over_time(one, axis="z")


def test_an_error_over_time_has_its_band(scored):
    lines = _lines(charts.error_over_time(scored, "A", "x"))
    rows = scored.rows_of(charts.track_number(scored, "A"))
    np.testing.assert_allclose(lines["error"].y, scored.errors[rows, 0])
    assert np.nanmax(lines["reported ± 3 σ"].y) == pytest.approx(0.15)


@pytest.mark.parametrize("in_plane", [True, False])
def test_directions_have_a_chart_for_each_angle(in_plane, tmp_path):
    tracks, estimate, _ = small_bearings(in_plane)
    chart = charts.bearing_over_time(tracks.recordings[0])
    drawn = np.asarray(_lines(chart)["estimate"].y)
    turned = (drawn - estimate[:, 0] + 180) % 360 - 180
    np.testing.assert_allclose(turned[np.isfinite(drawn)], 0, atol=1e-6)
    files = charts.plot_tracks(tmp_path, tracks)
    assert [name for name in files if "bearings" in name] == [
        f"bearings-yard-tag_A-station_S-{angle}.png"
        for angle in (["in-plane_angle"] if in_plane else ["azimuth", "elevation"])
    ]


def test_means_of_nees_over_time_are_those_of_the_rows_in_windows_of_time(scored):
    lines = _lines(charts.nees_over_time(scored))
    (mean,) = (line for name, line in lines.items() if name.startswith("mean of"))
    order = np.argsort(scored.times, kind="stable")
    nees = scored.rows["nees"].to_numpy()[order]
    expected = [part.mean() / 2 for part in np.array_split(nees[np.isfinite(nees)], len(np.asarray(mean.y)))]
    np.testing.assert_allclose(mean.y, expected)
    assert "95 % band, rows as correlated as these" in lines
    unknown = charts.nis_over_time(replace(scored, student_t_dof=float("nan")))
    assert not any("band" in name for name in _lines(unknown))


@pytest.mark.parametrize("odd", [{"nis": None}, {"nis_dof": 0.0}, {"nis": float("inf")}, {"nis": float("nan")}])
def test_consistency_takes_odd_rows(odd):
    one = _changed(small_tracks(tags=("A",)), **{k: pl.lit(v, pl.Float64) for k, v in odd.items()})
    assert draw(charts.nis_over_time(one)).get_ylabel() == "NIS / dof"
    assert draw(charts.nis_histogram(one)).get_ylabel() == "density"


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
    several = charts.coverage(dict.fromkeys("abcdefgh", scored))
    assert [*_lines(several)] == ["correct covariances", "all rows"]
    assert len(several.parts) == 10


def test_the_bias_of_an_anchor_is_its_median_residual_about_the_truth(scored):
    boxes, means = residual_charts(residuals(scored)[1])
    medians = [part for part in boxes.parts if part.marker][1]
    assert [*boxes.xticks.values()] == ["1", "2", "10", "11"]
    np.testing.assert_allclose(medians.y, [0, BIAS, 0, 0], atol=0.015)
    assert {*_lines(means)} == {"1", "10", "11", "2"}
    assert np.asarray(_lines(means)["2"].y).mean() == pytest.approx(BIAS, abs=0.01)


def test_the_map_holds_the_root_mean_square_error_of_each_cell(scored):
    (chart,) = error_map(scored)
    field, squares, true = chart.parts[0], scored.miss**2, scored.columns("true_x_m", "true_y_m")
    i, j = (np.abs(true[:, k, None] - middles).argmin(axis=1) for k, middles in enumerate((field.x, field.y)))
    for a, b in {(0, 0), *zip(i.tolist(), j.tolist(), strict=True)}:
        own = (i == a) & (j == b) & np.isfinite(squares)
        expected = np.sqrt(np.mean(squares[own])) if own.any() else np.nan
        np.testing.assert_allclose(field.values[b, a], expected)


def test_the_density_of_nis_is_that_of_the_noise_and_missing_where_it_is_unknown():
    nis = np.random.default_rng(5).chisquare(2, 4000)
    seen = Innovations(nis, np.full(4000, 2.0), np.zeros(4000, int))
    line = _lines(nis_chart("nis", "", seen))["consistent (χ²)"]
    np.testing.assert_allclose(line.y, scipy.stats.chi2.pdf(line.x, 2))
    assert [*_lines(nis_chart("nis", "", replace(seen, student_t_dof=np.nan)))] == ["4000 rows"]
    white = innovation_charts(seen, seen)[2].parts[0]
    assert np.nanmax(white.y) == pytest.approx(1.96 / np.sqrt(3999))


def test_errors_before_and_after_are_root_mean_squares_of_blocks_of_a_long_track():
    rng = np.random.default_rng(5)
    track = ErrorTrack("long " * 20, 0.1 * np.arange(4001), *np.abs(rng.normal(size=(2, 4001))))
    (chart,) = error_charts([track], "m")
    for line, whole in zip(chart.parts, (track.before, track.after), strict=True):
        blocks = [np.sqrt(np.mean(whole[k : k + 5] ** 2)) for k in range(0, 4001, 5)]
        np.testing.assert_allclose(line.y, blocks)
    worse = ErrorTrack("worse", track.times, track.before, 2 * track.before)
    points = _lines(rmse_chart([track, worse], "m"))
    np.testing.assert_allclose(np.asarray(points["after, larger"].x)[-1], 2 * np.sqrt(np.mean(track.before**2)))


def test_the_steps_of_an_optimiser_take_one_step_and_one_without_a_value():
    traces = [
        OptimiserTrace(np.array([3.0, np.nan]), np.array([[1.0], [2.0]])),
        OptimiserTrace(np.array([9e9]), np.ones((1, 1))),
    ]
    chart = objective_chart(traces, "nll")
    assert chart.limits("y")[1] < 10
    assert "selected: 3" in [part.name for part in chart.parts]
    assert draw(parameter_chart(traces, 0, "motion.sigma_a", "m")).get_ylim()[0] > 0


def test_the_axes_of_a_sweep_over_two_numbers_end_where_the_grid_does(tmp_path, monkeypatch):
    grids = [np.geomspace(0.1, 1.0, 5), np.linspace(1.0, 2.0, 4)]
    values = (np.log(grids[0])[:, None] + 1) ** 2 + (grids[1] - 1.5) ** 2
    made = []
    monkeypatch.setattr("trackwright.experiments.pages.charts.drawing.write", lambda chart, path: made.append(chart))
    parameters = [Parameter((name,), Scale(1.0, "m"), name) for name in ("a", "b")]
    for swept in (Sweep(parameters, grids, values[None], 1), Sweep(parameters[:1], grids[:1], values[None, :, 0], 1)):
        sweep_plot(tmp_path / "sweep.png", swept, "rmse (m)")
    surface, curve = made
    assert (surface.limits("x"), surface.limits("y"), surface.log) == ((0.1, 1.0), (1.0, 2.0), "x")
    assert surface.parts[0].plotly()["type"] == "contour"
    np.testing.assert_allclose(curve.parts[0].y, values[:, 0])
    assert draw(surface).get_xlabel() == "a (m)"


def test_floor_plans_of_a_comparison_are_of_the_worst_the_median_and_the_best_by_the_first_run():
    first = small_run("uwb", {"a": 0.2, "b": 0.9, "c": 0.1, "d": 0.5, "e": 0.3})
    second = small_run("median", {"b": 0.1, "c": 0.8, "d": 0.7, "e": 0.6, "a": 0.5})
    plans = [chart for chart in comparison_charts([first, second]) if "plan" in chart.name]
    assert [chart.name for chart in plans] == [f"floor_plan-{n}-{run}" for n in "bec" for run in ("uwb", "median")]
    assert plans[0].title == "uwb, b, worst of 5, RMSE 90 cm by uwb"
    assert {*_lines(plans[0])} == {"truth", "estimates", "start", "end", "anchor"}
    assert {*_lines(plans[0])["anchor"].text} == {*ANCHORS}


def test_the_tail_of_one_run_does_not_set_the_axis_of_errors():
    good, bad = small_run("good", {"a": 0.2}), small_run("bad", {"a": 0.2})
    last = pl.int_range(len(bad.rows)) == len(bad.rows) - 1
    bad = replace(bad, rows=bad.rows.with_columns(size_m=pl.when(last).then(50.0).otherwise("size_m")))
    for runs in ([good, bad], [bad, good]):
        distributions, boxes = comparison_charts(runs)[:2]
        assert distributions.limits("x")[1] < 25  # cm
        assert boxes.limits("y")[1] < 25
        assert {*_lines(distributions)} == {"good", "bad, 3.3 % beyond"}


@pytest.mark.parametrize("values", [[0.1, 0.2, 0.3], [0.1, 0.2]], ids=["lines", "rows"])
def test_a_metric_of_a_study_has_its_intervals_its_bound_and_its_target(values):
    trackers = {"direct": TrackerConfig("direct"), "cascade": TrackerConfig("cascade")}
    study = Study(name="grid", about="", worlds={"hand": World(WORLDS["station"])}, trackers=trackers,
                  grid={"world.sigma_p": values}, runs=2)  # fmt: skip
    found = {(c.index, t): Value(0.01 * (1 + c.index), 0.009, 0.06) for c in study.conditions for t in trackers}
    bounds = {key: Value(0.005, 0.005, 0.005) for key in list(found)[:2]}
    results = SimpleNamespace(study=study)
    chart = metric_chart(results, "rmse_m", found, Unit("cm", 100.0), bounds)
    drawn = _lines(chart)
    points = [part for part in chart.parts if part.marker and not part.marker.startswith("line")]
    assert sorted({float(x) for part in points for x in (part.y if len(values) > 2 else part.x)}) == [
        1.0 * (1 + k) for k in range(len(values))
    ]
    assert any("Cramér–Rao bound" in part.name for part in chart.parts)
    assert {"direct", "cascade"} <= {*drawn} or len(values) < 3
    shares = metric_chart(results, "coverage_95", found, Unit("%", 100.0), {})
    assert "95 expected" in _lines(shares)
    nothing = dict.fromkeys(found, Value(0.0, 0.0, 0.0))
    assert metric_chart(results, "rmse_m", nothing, Unit("cm", 100.0), {}) is None


def test_times_that_count_from_1970_are_shown_since_the_first_reading():
    unix = small_tracks(later=1777896797.26).recordings[0]
    assert unix.zero == 1777896800.26
    chart = charts.error_over_time(unix)
    assert chart.x == "time (s) since 2026-05-04 12:13:20.26 UTC"
    assert 7.5 < chart.limits("x")[1] < 8.5


def test_of_many_recordings_three_have_files_and_all_share_one_coverage(tmp_path):
    one = small_tracks(tags=("A",), rows=30)
    folders = [replace(one.folders[0], name=f"hall-{k}") for k in range(5)]
    shifted = [one.rows.with_columns(pl.col("x_m") + 0.2 * k, recording=pl.lit(f.name)) for k, f in enumerate(folders)]
    truth = one.folders[0].tables["truth"]
    tracks = ScoredTracks(scored_rows(pl.concat(shifted), {f.name: truth for f in folders}), folders, [])
    files = charts.plot_tracks(tmp_path, tracks)
    plans = [name for name in files if name.startswith("floor-plan")]
    assert sorted(plans) == [f"floor-plan-hall-{k}.png" for k in (0, 2, 4)]
    assert files.count("coverage.png") == 1
    assert {path.name for path in tmp_path.iterdir()} == {*files}
