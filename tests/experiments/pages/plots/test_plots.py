"""Every plot is a PNG that shows something, for full, odd and nearly empty input."""

import base64
import json
import re

import numpy as np
import polars as pl
import pytest
import scipy.stats
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.image import imread

from trackwright.experiments.pages.plots import style
from trackwright.experiments.pages.plots.bearings import bearings_over_time
from trackwright.experiments.pages.plots.coverage import coverage_curve, levels_of, observed_shares
from trackwright.experiments.pages.plots.errors import error_cdf, error_charts, error_over_time, rmse_chart
from trackwright.experiments.pages.plots.filters import autocorrelation_chart, consistency, inflation, nis_chart
from trackwright.experiments.pages.plots.objective import sweep_plot, tuning_trace
from trackwright.experiments.pages.plots.style import BLACK, BLUE, GREY, LINES, SKY, VERMILION, broken_at_gaps
from trackwright.experiments.pages.plots.tracks import TRUTH, floor_plan
from trackwright.experiments.pages.reports.tuning_data import ErrorTrack
from trackwright.experiments.text.wording import length_unit
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.tunable import Scale
from trackwright.tuning.diagnostics import Innovations
from trackwright.tuning.parameters import Parameter
from trackwright.tuning.sweeping import Sweep

T = np.arange(60) * 0.1


def _pixels(path):
    """The picture as (height, width, 3) in 0–255; also checks that it is a PNG that a person can read."""
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    picture = np.round(255 * imread(path)[:, :, :3]).astype(int)
    assert min(picture.shape[:2]) > 200
    return picture


def _shows(picture, colour):
    """Whether pixels of about this colour are there; a line that is not wholly opaque is a little lighter."""
    wanted = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    return int((np.abs(picture - wanted).max(axis=2) < 30).sum()) > 20


def _tracks(n_tags, sigma=0.2):
    frames = []
    for k in range(n_tags):
        columns = {"x_m": 5 + 3 * np.cos(T + k), "y_m": 3 + 2 * np.sin(T + 2 * k), "z_m": 1 + 0 * T}
        columns |= {"std_x_m": 0 * T + sigma, "std_y_m": 0 * T + sigma / 2, "cov_xy_m2": 0 * T + sigma**2 / 4}
        frames.append(pl.DataFrame({"recording": "hall", "tag": f"tag-{k}", "t_s": T, **columns}))
    return pl.concat(frames)


def _parameter(name):
    return Parameter((name,), Scale(1.0, "m/s^2"), name)


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    """Fewer dots per inch than users get: most of the time goes into compressing pixels."""
    monkeypatch.setitem(style.STYLE, "savefig.dpi", 80)


@pytest.fixture
def figures(monkeypatch):
    """The figures that are written, in their order."""
    made = []

    def canvas(kind):
        return lambda figure: made.append(figure) or kind(figure)

    monkeypatch.setattr(style, "FigureCanvasAgg", canvas(FigureCanvasAgg))
    monkeypatch.setattr(style, "FigureCanvasSVG", canvas(FigureCanvasSVG))
    return made


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_the_floor_plan_shows_each_tag_and_the_truth(tmp_path):
    half = np.sqrt(0.5)
    stations = {"N": Station(np.array([5.0, 8.0, 2.0]), np.array([half, half, 0.0, 0.0]))}
    anchors = {"A": np.array([0.0, 0.0, 2.0]), "B": np.array([10.0, 0.0, 2.0])}
    picture = _pixels(floor_plan(tmp_path / "plan.png", _tracks(2), _tracks(2), stations, anchors))
    assert all(_shows(picture, colour) for colour in LINES[:2])
    assert not _shows(picture, LINES[2])
    without = _pixels(floor_plan(tmp_path / "plan.png", _tracks(2), None, stations, anchors))
    grey = [int(TRUTH[k : k + 2], 16) for k in (1, 3, 5)]
    shown = [int((np.abs(p - grey).max(axis=2) < 6).sum()) for p in (picture, without)]
    assert shown[0] > shown[1] + 300


def test_the_floor_plan_draws_at_most_six_tags(tmp_path):
    assert all(_shows(_pixels(floor_plan(tmp_path / "plan.png", _tracks(9))), colour) for colour in LINES)


def test_wild_estimates_are_counted_and_do_not_decide_the_scale_of_the_floor_plan(tmp_path, figures):
    row = pl.int_range(pl.len())
    tracks = pl.concat([_tracks(1).with_columns(t_s=pl.col("t_s") + 6 * k) for k in range(10)])
    # Beyond the x axis alone, the y axis alone, and both.
    wild = tracks.with_columns(
        x_m=pl.when(row.is_in([50, 70])).then(1e4).otherwise("x_m"),
        y_m=pl.when(row.is_in([60, 70])).then(-1e4).otherwise("y_m"),
    )
    floor_plan(tmp_path / "plan.png", wild)
    (axes,) = figures[0].axes
    assert axes.get_title(loc="left").splitlines() == [
        "dots: estimates with their reported 95 % ellipses", "3 of 600 estimates lie outside the axes"
    ]  # fmt: skip
    floor_plan(tmp_path / "plan.png", tracks)
    assert "outside" not in figures[1].axes[0].get_title(loc="left")
    for limits in ("get_xlim", "get_ylim"):
        tame, spoiled = (getattr(figure.axes[0], limits)() for figure in figures[::-1])
        np.testing.assert_allclose(spoiled, tame, atol=0.1)


def test_times_are_written_along_three_tracks_and_not_along_four(tmp_path, figures):
    for n_tags in (3, 4):
        floor_plan(tmp_path / "plan.png", _tracks(n_tags))
    three, four = ([text.get_text() for text in figure.axes[0].texts] for figure in figures)
    assert three == ["2 s", "4 s"] * 3
    assert four == []


@pytest.mark.parametrize(
    ("end", "ratio"),
    [((60.0, 0.0), 0.25), ((20.0, 20.0), 1.0), ((0.0, 60.0), 2.5)],
    ids=["corridor along x", "square", "corridor along y"],
)
def test_the_ratio_of_a_plan_is_that_of_the_floor_and_limited_for_a_corridor(tmp_path, figures, end, ratio):
    x, y = np.outer(end, T / T[-1])
    floor_plan(tmp_path / "plan.png", pl.DataFrame({"tag": "a", "t_s": T, "x_m": x, "y_m": y}))
    # The legend at the side takes 1.9 inches, title and labels take 1.3.
    width, height = figures[0].get_size_inches() - (1.9, 1.3)
    assert height / width == pytest.approx(ratio)


def test_walls_are_drawn_below_truth_and_truth_below_tracks(tmp_path, figures):
    floor_plan(tmp_path / "plan.png", _tracks(1), _tracks(1), walls=np.array([[0.0, 3.0, 10.0, 3.0]]))
    in_order = sorted(figures[0].axes[0].lines, key=lambda line: line.zorder)
    assert [line.get_color() for line in in_order[:3]] == [GREY, TRUTH, LINES[0]]


@pytest.mark.parametrize(
    "tracks",
    [
        _tracks(1)[:1],
        _tracks(1).clear(),
        _tracks(1).with_columns(x_m=pl.lit(None, pl.Float64)),
        _tracks(1).drop("std_x_m", "std_y_m", "cov_xy_m2"),
        _tracks(1).with_columns(tag=pl.lit("a$^b$_")),
        _tracks(1).with_columns(tag=pl.lit("标签")),
        _tracks(1).with_columns(x_m=pl.lit(3.0), y_m=pl.lit(2.0)),
    ],
    ids=["one row", "no row", "no estimate", "no covariance", "formula signs", "script not in the font", "still"],
)
def test_the_floor_plan_takes_odd_tracks(tmp_path, tracks):
    _pixels(floor_plan(tmp_path / "plan.png", tracks, _tracks(1), title="50 $ worth"))


def test_error_over_time_shows_error_band_and_bound(tmp_path, rng):
    errors, sigmas = rng.normal(size=(60, 3)), np.ones((60, 3))
    picture = _pixels(error_over_time(tmp_path / "error.png", T, errors, sigmas, 0.9 * sigmas))
    assert _shows(picture, BLUE)
    assert _shows(picture, VERMILION)


def test_error_over_time_leaves_out_an_axis_without_errors(tmp_path, rng):
    errors, sigmas = rng.normal(size=(60, 3)), np.ones((60, 3))
    three = _pixels(error_over_time(tmp_path / "error.png", T, errors, sigmas))
    errors[:, 2] = np.nan
    two = _pixels(error_over_time(tmp_path / "error.png", T, errors, sigmas))
    assert len(two) < 0.8 * len(three)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_error_over_time_takes_next_to_nothing(tmp_path, n):
    error_over_time(tmp_path / "error.png", T[:n], np.zeros((n, 2)), np.full((n, 2), np.nan))
    assert (tmp_path / "error.png").stat().st_size > 1000


def test_the_error_cdf_shows_horizontal_and_3d(tmp_path, rng):
    picture = _pixels(error_cdf(tmp_path / "cdf.png", rng.normal(size=(500, 3))))
    assert _shows(picture, BLUE)
    assert _shows(picture, VERMILION)


@pytest.mark.parametrize(("rows", "block"), [(60, 1), (1000, 4), (1001, 5)])
def test_errors_before_and_after_are_root_mean_squares_of_blocks_of_a_long_track(rng, rows, block):
    times, before, after = 0.1 * np.arange(rows), *rng.uniform(1, 2, (2, rows))
    ((name, address),) = error_charts([ErrorTrack("hall, tag 1", times, before, after)], "cm")
    text = base64.b64decode(address.partition(",")[2]).decode()
    drawn = json.loads(re.search(r'<metadata id="chart">(.*?)</metadata>', text, re.DOTALL)[1])["data"]
    starts = range(0, rows, block)
    for trace, values in zip(drawn, (before, after), strict=True):
        np.testing.assert_allclose(trace["x"], [times[k : k + block].mean() for k in starts], rtol=1e-4)
        np.testing.assert_allclose(
            trace["y"], [np.sqrt(np.mean(values[k : k + block] ** 2)) for k in starts], rtol=1e-4
        )
    assert name == "hall, tag 1"


def test_the_errors_of_all_trajectories_lie_inside_their_chart(figures):
    times = np.arange(2.0)
    tracks = [ErrorTrack(f"tag {k}", times, np.full(2, old), np.full(2, new)) for k, (old, new) in
              enumerate([(12.0, 10.0), (20.0, 31.0), (40.0, 5.0)])]  # fmt: skip
    rmse_chart(tracks, "cm")
    (axes,) = figures[0].axes
    drawn = np.concatenate([line.get_xdata() for line in axes.lines])
    low, high = axes.get_xlim()
    assert (low, drawn.min(), drawn.max()) == (0.0, 5.0, 40.0)
    assert 40.0 < high < 50.0


@pytest.mark.parametrize("errors", [np.zeros((0, 3)), np.zeros((1, 2)), np.full((4, 3), np.nan), np.zeros((9, 3))])
def test_the_error_cdf_takes_next_to_nothing(tmp_path, errors):
    _pixels(error_cdf(tmp_path / "cdf.png", errors))


def test_the_coverage_curve_has_a_line_for_each_recording_and_one_for_all_rows(tmp_path, rng):
    names = np.repeat(["hall", "yard", "50 $ worth"], 200)
    nees = rng.chisquare(2, 600) * np.repeat([1.0, 9.0, 0.2], 200)
    nees[::7] = np.nan
    picture = _pixels(coverage_curve(tmp_path / "coverage.png", names, nees, None))
    assert all(_shows(picture, colour) for colour in (*LINES[:3], BLACK))
    wide = _pixels(coverage_curve(tmp_path / "coverage.png", names, nees, nees))
    assert wide.shape[1] > 1.5 * picture.shape[1]
    many = np.array([f"{k}" for k in range(600)])
    assert not _shows(_pixels(coverage_curve(tmp_path / "coverage.png", many, nees, None)), LINES[0])


def test_the_observed_share_is_that_of_the_rows_within_the_quantile(rng):
    nees, levels = np.append(rng.chisquare(3, 500), np.nan), np.array([0.0, 0.5, 0.95, 1.0])
    expected = [np.mean(nees[:-1] <= scipy.stats.chi2.ppf(level, 3)) for level in levels]
    np.testing.assert_allclose(observed_shares(levels_of(nees, 3), levels), expected, rtol=1e-12)


def test_consistency_of_many_runs_shows_means_bounds_and_density(tmp_path, rng):
    nees, nis = rng.chisquare(3, (40, 60)), rng.chisquare(8, (40, 60))
    picture = _pixels(consistency(tmp_path / "chi.png", T, nees, 3, nis, 8))
    assert _shows(picture, BLUE)
    assert _shows(picture, VERMILION)


def test_the_band_of_consistency_is_that_of_the_noise_and_missing_where_it_is_unknown(tmp_path, rng):
    # Student's t with 1.8 degrees of freedom bounds the NIS of a channel by 2.8.
    nis = 2.8 * rng.beta(0.5, 0.9, (1, 600))
    times = np.arange(600.0)

    def drawn(dof):
        return _pixels(consistency(tmp_path / "c.png", times, None, 2, nis, 1, student_t_dof=dof))

    pictures = {dof: drawn(dof) for dof in (1.8, np.nan)}
    assert _shows(pictures[1.8], VERMILION)
    assert not _shows(pictures[np.nan], VERMILION)


def test_correlated_rows_count_as_so_many_fewer(rng):
    white = rng.normal(size=20_000)
    smooth = np.zeros_like(white)
    for k in range(1, len(white)):
        smooth[k] = 0.8 * smooth[k - 1] + white[k]
    one = np.ones_like(white)
    assert inflation(white, one, 50) == pytest.approx(1.0, abs=0.2)
    lags = np.arange(1, 50)
    assert inflation(smooth, one, 50) == pytest.approx(1 + 2 * np.sum((1 - lags / 50) * 0.8**lags), rel=0.1)


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_consistency_takes_one_run_with_gaps_and_different_dof(tmp_path, rng, scale):
    dof = rng.integers(1, 9, (1, 60)).astype(float)
    nis = np.where(rng.random((1, 60)) < 0.2, np.nan, scale * rng.chisquare(dof))
    _pixels(consistency(tmp_path / "chi.png", T, None, 3, nis, dof))
    _pixels(consistency(tmp_path / "chi.png", T, nis, 2, None, 1))


def test_consistency_takes_runs_without_a_value(tmp_path):
    _pixels(consistency(tmp_path / "chi.png", T, None, 3, np.full((1, 60), np.nan), 8))
    _pixels(consistency(tmp_path / "chi.png", T, None, 3, np.zeros((1, 60)), np.zeros((1, 60))))


def test_consistency_takes_runs_most_of_whose_rows_say_nothing(tmp_path, rng):
    dof = np.where(np.arange(60) % 3, 0.0, 8.0)[None]
    _pixels(consistency(tmp_path / "chi.png", T, None, 3, np.where(dof > 0, rng.chisquare(8, (1, 60)), 0.0), dof))


def test_a_bin_of_nis_far_higher_than_the_density_is_cut_off(rng, figures):
    dof, trajectory = np.full(500, 8), np.zeros(500, int)
    nis_chart(Innovations(np.zeros(500), dof, trajectory), Innovations(rng.chisquare(8, 500), dof, trajectory))
    # The density of χ² with 8 degrees of freedom, x³ exp(−x/2) / 96, is highest at 6.
    peak = 6**3 * np.exp(-3) / 96
    # The bin of zeros is cut off at 2.5 times the peak; room for the legend is 60 % more.
    assert figures[0].axes[0].get_ylim() == pytest.approx((0.0, 1.6 * 2.5 * peak), rel=1e-3)


def test_the_band_of_white_noise_is_that_of_the_pairs_of_rows_after_the_fit(rng, figures):
    # Two trajectories of 51 rows have 100 pairs of neighbours.
    sides = [Innovations(rng.chisquare(8, n), np.full(n, 8), np.arange(n) // 51) for n in (510, 102)]
    autocorrelation_chart(*sides)
    (band,) = figures[0].axes[0].patches
    assert (band.get_y(), band.get_y() + band.get_height()) == pytest.approx((-0.196, 0.196))


def test_the_tuning_trace_shows_every_number(tmp_path):
    i = np.arange(30)
    values = {"motion.sigma_a": np.exp(-i / 9), "sensors.*.sigma": 0 * i + 2.0, "offset": np.sin(i / 3)}
    picture = _pixels(tuning_trace(tmp_path / "tune.png", 100.0 - i, values, {"motion.sigma_a": "m/s^2"}))
    assert all(_shows(picture, colour) for colour in (BLACK, BLUE))


@pytest.mark.parametrize(("largest", "ticks"), [(50.0, [1, 2, 5, 10, 20, 50]), (200.0, [1, 10, 100])])
def test_a_tuning_trace_has_ticks_at_one_two_and_five_unless_it_spans_decades(tmp_path, figures, largest, ticks):
    tuning_trace(tmp_path / "tune.png", T, {"motion.sigma_a": np.geomspace(1.0, largest, len(T))})
    axes = figures[0].axes[1]
    low, high = axes.get_ylim()
    assert [tick for tick in axes.get_yticks() if low <= tick <= high] == pytest.approx(ticks)


def test_the_tuning_trace_takes_one_iteration_and_no_numbers(tmp_path):
    _pixels(tuning_trace(tmp_path / "one.png", np.array([3.0]), {"motion.sigma_a": np.array([0.1])}))
    tuning_trace(tmp_path / "none.png", np.array([3.0, np.nan]), {})


def test_bearings_over_time_shows_estimate_and_truth(tmp_path, rng):
    true = np.stack([3.0 + 0.5 * np.sin(T), 0.2 * np.cos(T)], axis=1)
    wrapped = np.angle(np.exp(1j * (true + rng.normal(size=true.shape) * 0.05)))
    picture = _pixels(bearings_over_time(tmp_path / "b.png", T, wrapped, np.full((60, 2), 0.05), T, true))
    assert _shows(picture, BLUE)
    assert _shows(picture, BLACK)


def test_azimuth_and_elevation_have_a_panel_each_below_one_another(tmp_path, figures):
    bearings_over_time(tmp_path / "b.png", T, np.stack([0.1 * T, -0.05 * T], axis=1))
    panels = figures[0].axes
    assert [axes.get_ylabel() for axes in panels] == ["azimuth (°)", "elevation (°)"]
    assert [axes.get_subplotspec().get_geometry() for axes in panels] == [(2, 1, 0, 0), (2, 1, 1, 1)]
    for axes, factor in zip(panels, (0.1, -0.05), strict=True):
        np.testing.assert_allclose(axes.lines[0].get_xydata(), np.stack([T, np.degrees(factor * T)], axis=1))


def test_directions_in_the_plane_of_an_array_are_one_angle(tmp_path, figures):
    in_plane = np.stack([np.where(T < 3, 0.5, -0.5) * np.pi, 0.1 * T], axis=1)
    bearings_over_time(tmp_path / "b.png", T, in_plane)
    bearings_over_time(tmp_path / "b.png", T, in_plane[:, ::-1])
    assert [[axes.get_ylabel() for axes in figure.axes] for figure in figures] == [
        ["in-plane angle (°)"], ["azimuth (°)", "elevation (°)"]
    ]  # fmt: skip


@pytest.mark.parametrize(("repeats", "paths"), [(1, 0), (1, 1), (3, 0)])
def test_a_sweep_over_one_number_has_a_legend_of_spread_and_steps(tmp_path, figures, repeats, paths):
    grid = np.array([0.5, 1.0, 2.0])
    swept = Sweep([_parameter("sigma_a")], [grid], np.array([2.0, 1.0, 3.0]) + 0.1 * np.arange(repeats)[:, None], 1)
    sweep_plot(tmp_path / "s.png", swept, "nll", [np.array([[0.7], [1.1]])] * paths)
    legend = figures[0].axes[0].get_legend()
    assert (legend is not None) == (repeats > 1 or paths > 0)
    if paths:
        assert "optimiser steps" in [text.get_text() for text in legend.get_texts()]


def test_the_axis_of_a_sweep_over_one_number_has_equal_room_beyond_both_ends(tmp_path, figures):
    swept = Sweep([_parameter("sigma_a")], [np.array([0.01, 0.1, 1.0])], np.array([[2.0, 1.0, 3.0]]), 1)
    sweep_plot(tmp_path / "s.png", swept, "nll")
    low, high = figures[0].axes[0].get_xlim()
    # The axis is logarithmic: equal room at both ends is an equal factor.
    assert 0.01 / low == pytest.approx(high / 1.0)
    assert 1.0 < high < 2.0


def test_the_axes_of_a_sweep_over_two_numbers_end_where_the_grid_does(tmp_path, figures):
    grids = [np.array([0.01, 0.1, 1.0]), np.array([2.0, 8.0])]
    swept = Sweep([_parameter("sigma_a"), _parameter("sigma_b")], grids, np.arange(6.0).reshape(1, 3, 2), 1)
    sweep_plot(tmp_path / "s.png", swept, "nll")
    axes = figures[0].axes[0]
    assert axes.get_xlim() == pytest.approx((0.01, 1.0))
    assert axes.get_ylim() == pytest.approx((2.0, 8.0))


def test_bearings_over_time_takes_a_full_turn_and_missing_rows(tmp_path):
    turning = np.stack([np.angle(np.exp(1.2j * T)), np.full(60, np.nan)], axis=1)
    _pixels(bearings_over_time(tmp_path / "b.png", T, turning))


def test_a_figure_that_cannot_be_written_leaves_nothing_behind(tmp_path):
    with pytest.raises(UnusableInput, match="cannot write"):
        error_cdf(tmp_path / "nowhere" / "cdf.png", np.ones((3, 2)))
    assert list(tmp_path.iterdir()) == []


def test_lines_are_broken_in_gaps_only():
    times, values = broken_at_gaps(np.array([0.0, 0.1, 0.2, 5.0, 5.1]), np.arange(5.0))
    np.testing.assert_array_equal(times, [0.0, 0.1, 0.2, 2.6, 5.0, 5.1])
    np.testing.assert_array_equal(values, [0.0, 1.0, 2.0, np.nan, 3.0, 4.0])
    slow = np.arange(5.0) * 3
    assert len(broken_at_gaps(slow)[0]) == 5


@pytest.mark.parametrize(("size", "unit"), [(3.0, ("m", 1.0)), (0.3, ("cm", 100.0)), (0.003, ("mm", 1000.0))])
def test_lengths_are_shown_in_a_unit_of_their_size(size, unit):
    assert length_unit(size) == unit


def test_the_bands_of_three_sigma_and_of_consistency_are_light(tmp_path, rng):
    light = [255 - 0.35 * (255 - int(SKY[k : k + 2], 16)) for k in (1, 3, 5)]
    errors, nis = np.zeros((60, 2)), rng.chisquare(8, (3, 60))
    for path in (
        error_over_time(tmp_path / "error.png", T, errors, np.ones((60, 2))),
        consistency(tmp_path / "chi.png", T, None, 2, nis, 8),
    ):
        assert (np.abs(_pixels(path) - light).max(axis=2) < 6).sum() > 3_000
