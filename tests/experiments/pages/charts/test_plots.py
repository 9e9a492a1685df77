"""Every plot is a PNG that shows something, for full, odd and nearly empty input."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import scipy.stats
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.image import imread

from tests.experiments.pages.charts.small_runs import chart_data
from tests.experiments.pages.reports.small_tracks import small_bearings, small_tracks
from trackwright.experiments.pages.charts import style
from trackwright.experiments.pages.charts.distributions import draw_autocorrelation, draw_nis, law_of
from trackwright.experiments.pages.charts.figures import plot_tracks
from trackwright.experiments.pages.charts.recording import (
    _inflation,
    bearing_over_time,
    coverage,
    error_cdf,
    error_over_time,
    floor_plan,
    nees_over_time,
    nis_over_time,
)
from trackwright.experiments.pages.charts.style import (
    VERMILION,
    Chart,
    broken_at_gaps,
)
from trackwright.experiments.pages.charts.tuning import (
    OptimiserTrace,
    error_charts,
    objective_chart,
    parameter_chart,
    rmse_chart,
    sweep_plot,
)
from trackwright.experiments.pages.reports.before_after import ErrorTrack
from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.evaluation.rows import scored_rows
from trackwright.trackers.recordings.folder import RecordingFolder
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


def _scored(tracks, truth=None, **rig):
    """The tracks with their errors, of a recording with that truth and installation."""
    tables = {} if truth is None else {"truth": truth.select("t_s", "tag", "x_m", "y_m", "z_m")}
    folder = RecordingFolder("hall", None, Rig("hall", **rig), tables)
    return ScoredTracks(scored_rows(tracks, {"hall": truth} if tables else {}), [folder], []).recordings[0]


def _drawn(path, chart, *given, size=(6.0, 3.0), **named):
    """The file of a chart on axes of its own."""
    return Chart("one", "", lambda axes: chart(*given, ax=axes, **named), *size).write(path)


def _on_axes(path, draw, *given, size=(6.0, 3.0), **named):
    return Chart("one", "", lambda axes: draw(axes, *given, **named), *size).write(path)


def _plan(path, tracks, truth=None, **rig):
    return _drawn(path, floor_plan, _scored(tracks, truth, **rig), size=(8.5, None))


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


def test_wild_estimates_are_counted_and_do_not_decide_the_scale_of_the__plan(tmp_path, figures):
    row = pl.int_range(pl.len())
    tracks = pl.concat([_tracks(1).with_columns(t_s=pl.col("t_s") + 6 * k) for k in range(10)])
    # Beyond the x axis alone, the y axis alone, and both.
    wild = tracks.with_columns(
        x_m=pl.when(row.is_in([50, 70])).then(1e4).otherwise("x_m"),
        y_m=pl.when(row.is_in([60, 70])).then(-1e4).otherwise("y_m"),
    )
    _plan(tmp_path / "plan.png", wild)
    (axes,) = figures[0].axes
    assert axes.get_title(loc="left").splitlines() == [
        "dots: estimates with their reported 95 % ellipses", "3 of 600 estimates lie outside the axes"
    ]  # fmt: skip
    _plan(tmp_path / "plan.png", tracks)
    assert "outside" not in figures[1].axes[0].get_title(loc="left")
    for limits in ("get_xlim", "get_ylim"):
        tame, spoiled = (getattr(figure.axes[0], limits)() for figure in figures[::-1])
        np.testing.assert_allclose(spoiled, tame, atol=0.1)


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
    _pixels(_plan(tmp_path / "plan.png", tracks, _tracks(1)))


def test_errors_over_time_have_a_chart_for_each_axis_with_errors(tmp_path, figures):
    for z, count in ((1.0, 3), (None, 2)):
        tracks = _tracks(2).with_columns(z_m=pl.lit(z, pl.Float64), std_z_m=pl.lit(0.1))
        scored = ScoredTracks(
            scored_rows(tracks.with_columns(pl.col("x_m") + 0.1), {"hall": _tracks(2)}),
            [RecordingFolder("hall", None, Rig("hall"), {"truth": _tracks(2)})], [],
        )  # fmt: skip
        figures.clear()
        names = plot_tracks(tmp_path, scored)
        over_time = [name for name in names if name.startswith("error-over-time")]
        assert over_time == [f"error-over-time-{a}.png" for a in "xyz"[:count]]
        drawn = [figures[names.index(name)].axes[0] for name in over_time]
        assert [axes.get_ylabel() for axes in drawn] == [f"error in {a} (cm)" for a in "xyz"[:count]]
        assert {axes.get_xlabel() for axes in drawn} == {"time (s)"}


@pytest.mark.parametrize(("rows", "block"), [(60, 1), (1000, 4), (1001, 5)])
def test_errors_before_and_after_are_root_mean_squares_of_blocks_of_a_long_track(rng, rows, block):
    times, before, after = 0.1 * np.arange(rows), *rng.uniform(1, 2, (2, rows))
    (chart,) = error_charts([ErrorTrack("hall, tag 1", times, before, after)], "cm")
    drawn = chart_data(chart.address)["data"]
    starts = range(0, rows, block)
    for trace, values in zip(drawn, (before, after), strict=True):
        np.testing.assert_allclose(trace["x"], [times[k : k + block].mean() for k in starts], rtol=1e-4)
        np.testing.assert_allclose(
            trace["y"], [np.sqrt(np.mean(values[k : k + block] ** 2)) for k in starts], rtol=1e-4
        )
    assert chart.title == "Error of hall, tag 1 over time"


def test_the_errors_of_all_trajectories_lie_inside_their_chart(figures):
    times = np.arange(2.0)
    tracks = [ErrorTrack(f"tag {k}", times, np.full(2, old), np.full(2, new)) for k, (old, new) in
              enumerate([(12.0, 10.0), (20.0, 31.0), (40.0, 5.0)])]  # fmt: skip
    assert rmse_chart(tracks, "cm").address
    (axes,) = figures[0].axes
    drawn = np.concatenate([line.get_xdata() for line in axes.lines])
    low, high = axes.get_xlim()
    assert (low, drawn.min(), drawn.max()) == (0.0, 5.0, 40.0)
    assert 40.0 < high < 50.0


def test_the_coverage_of_one_run_has_a_line_for_each_shape_and_of_several_for_each_run(tmp_path, figures):
    (scored,) = small_tracks().recordings
    (bearings,) = small_bearings(in_plane=True)[0].recordings
    for given, named, names in (
        (scored, {}, ["horizontal"]),
        (bearings, {}, ["in-plane angle"]),
        ({"uwb": scored, "other": scored}, {}, ["uwb", "other", "all rows"]),
        ({"uwb": scored}, {}, ["uwb"]),
    ):
        _drawn(tmp_path / "c.png", coverage, given, **named)
        labels = figures[-1].axes[0].get_legend_handles_labels()[1]
        assert [label.partition(":")[0] for label in labels if label.endswith("inside 95 %")] == names


def test_the_density_of_nis_is_that_of_the_noise_and_missing_where_it_is_unknown(tmp_path, rng):
    # Student's t with 1.8 degrees of freedom bounds the NIS of a channel by 2.8.
    nis = 2.8 * rng.beta(0.5, 0.9, 600)
    for dof, shown in ((1.8, True), (np.nan, False)):
        seen = Innovations(nis, np.ones(600), np.zeros(600, int), dof)
        assert _shows(_pixels(_on_axes(tmp_path / "c.png", draw_nis, seen)), VERMILION) == shown
    assert [law_of(dof) for dof in (None, 1.8, np.nan)] == ["χ²", "Student's t", ""]


def test_the_band_of_white_noise_is_that_of_the_pairs_of_rows_after_the_fit(tmp_path, rng, figures):
    # Two trajectories of 51 rows have 100 pairs of neighbours.
    sides = [Innovations(rng.chisquare(8, n), np.full(n, 8), np.arange(n) // 51) for n in (510, 102)]
    _on_axes(tmp_path / "lags.png", draw_autocorrelation, *sides)
    (band,) = figures[0].axes[0].patches
    assert (band.get_y(), band.get_y() + band.get_height()) == pytest.approx((-0.196, 0.196))


def test_the_tuning_trace_takes_one_iteration_and_one_without_a_value(tmp_path):
    for objective in ([3.0], [3.0, np.nan]):
        trace = OptimiserTrace(np.array(objective), np.full((len(objective), 1), 0.1))
        _pixels(objective_chart([trace], "nll").write(tmp_path / "tuning.png"))
        assert parameter_chart([trace], 0, "sigma", "m").write(tmp_path / "sigma.png").is_file()


@pytest.mark.parametrize("in_plane", [True, False])
def test_directions_have_a_chart_for_each_angle_and_in_the_plane_of_an_array_one(tmp_path, figures, in_plane):
    tracks, estimate, true = small_bearings(in_plane)
    names = plot_tracks(tmp_path, tracks)
    angles = ["in-plane angle"] if in_plane else ["azimuth", "elevation"]
    files = [f"bearings-yard-tag_A-station_S-{angle.replace(' ', '_')}" for angle in angles]
    assert names == [f"{name}.png" for name in (*files, "coverage")]
    panels = [figure.axes[0] for figure in figures[:-1]]
    assert [axes.get_ylabel() for axes in panels] == [f"{angle} (°)" for angle in angles]
    for k, axes in enumerate(panels):
        drawn = {line.get_label(): line.get_ydata() for line in axes.lines}
        for own, values in (("estimate", estimate[:, k]), ("truth", true[:, k])):
            off = drawn[own] - values
            # A line is broken where the angle turns on.
            assert np.isnan(off).sum() <= 1
            assert np.nanmax(np.abs(off - 360 * np.round(off / 360))) < 1e-6
    with pytest.raises(UnusableInput, match="no estimate of tag 'B'; tags: A"):
        bearing_over_time(tracks.recordings[0], tag="B")


def test_the_axes_of_a_sweep_over_two_numbers_end_where_the_grid_does(tmp_path, figures):
    grids = [np.array([0.01, 0.1, 1.0]), np.array([2.0, 8.0])]
    swept = Sweep([_parameter("sigma_a"), _parameter("sigma_b")], grids, np.arange(6.0).reshape(1, 3, 2), 1)
    sweep_plot(tmp_path / "s.png", swept, "nll")
    axes = figures[0].axes[0]
    assert axes.get_xlim() == pytest.approx((0.01, 1.0))
    assert axes.get_ylim() == pytest.approx((2.0, 8.0))


def test_a_figure_that_cannot_be_written_leaves_nothing_behind(tmp_path):
    with pytest.raises(UnusableInput, match="cannot write"):
        _drawn(tmp_path / "nowhere" / "cdf.png", error_cdf, _scored(_tracks(1), _tracks(1)))
    assert list(tmp_path.iterdir()) == []


def test_lines_are_broken_in_gaps_only():
    times, values = broken_at_gaps(np.array([0.0, 0.1, 0.2, 5.0, 5.1]), np.arange(5.0))
    np.testing.assert_array_equal(times, [0.0, 0.1, 0.2, 2.6, 5.0, 5.1])
    np.testing.assert_array_equal(values, [0.0, 1.0, 2.0, np.nan, 3.0, 4.0])
    slow = np.arange(5.0) * 3
    assert len(broken_at_gaps(slow)[0]) == 5


def _with(tracks, **columns):
    """The tracks with NIS and errors that are known: scored against the tracks without them."""
    return _scored(tracks.with_columns(std_z_m=pl.lit(0.0)).with_columns(**columns), tracks)


def test_correlated_rows_count_as_so_many_fewer(rng):
    white = rng.normal(size=20_000)
    smooth = np.zeros_like(white)
    for k in range(1, len(white)):
        smooth[k] = 0.8 * smooth[k - 1] + white[k]
    assert _inflation(white, 50) == pytest.approx(1.0, abs=0.2)
    lags = np.arange(1, 50)
    assert _inflation(smooth, 50) == pytest.approx(1 + 2 * np.sum((1 - lags / 50) * 0.8**lags), rel=0.1)


def test_means_of_nees_over_time_are_those_of_the_rows_in_windows_of_time():
    axes = nees_over_time(_with(_tracks(1, sigma=2.0), x_m=pl.col("x_m") + pl.col("t_s")), ax=Figure().subplots())
    _, line = axes.lines
    # The inverse of [[4, 1], [1, 1]] is [[1, -1], [-1, 4]] / 3: the NEES of an error t in x is t² / 3, of two degrees.
    np.testing.assert_allclose(line.get_ydata(), (T**2 / 6).reshape(3, 20).mean(axis=1))
    np.testing.assert_allclose(line.get_xdata(), T.reshape(3, 20).mean(axis=1))
    assert axes.texts[-1].get_text().startswith(f"mean {np.mean(T**2) / 6:.2f}, ")


@pytest.mark.parametrize(
    ("nis", "dof"),
    [
        (pl.lit(None, pl.Float64), 2.0),
        (pl.lit(0.0), 0.0),
        (pl.lit(2.0), 2.0),
        (pl.when(pl.int_range(pl.len()) % 2 == 0).then(200.0), 2.0),
    ],
    ids=["none", "rows that say nothing", "all the same", "gaps"],
)
def test_consistency_takes_odd_rows(nis, dof):
    axes = nis_over_time(_with(_tracks(2), nis=nis, nis_dof=pl.lit(dof)), ax=Figure().subplots())
    assert axes.get_ylabel() == "NIS / dof"


def test_the_band_of_nis_over_time_is_missing_where_its_distribution_is_unknown(rng):
    scored = _with(_tracks(1), nis=pl.Series(rng.chisquare(2, 60)), nis_dof=pl.lit(2.0))
    for known, bands in ((None, 1), (np.nan, 0)):
        axes = nis_over_time(replace(scored, student_t_dof=known), ax=Figure().subplots())
        assert len(axes.collections) == bands


def test_an_error_over_time_has_its_band_its_bound_and_the_number_of_errors_beyond_the_axes(monkeypatch):
    wild = pl.when(pl.int_range(pl.len()) % 1000 == 500).then(50.0).otherwise(0.1)
    long = pl.concat([_tracks(1).with_columns(t_s=pl.col("t_s") + 6 * k) for k in range(30)])
    scored = _with(long, x_m=pl.col("x_m") + wild)
    monkeypatch.setitem(scored.__dict__, "bounds", (T, np.full((60, 3), 0.1)))
    axes = error_over_time(scored, axis="x", ax=Figure().subplots())
    drawn = {line.get_label(): line.get_ydata() for line in axes.lines}
    np.testing.assert_allclose(drawn["± 3 × Cramér–Rao bound of this model"], 30.0)
    np.testing.assert_allclose(np.median(drawn["error"]), 10.0)
    assert "2 outside the axes" in [text.get_text() for text in axes.texts]
    low, high = axes.get_ylim()
    assert (low, high) == pytest.approx((-46.0, 46.0))  # 4 times the errors, and 15 % room


@pytest.mark.parametrize("rows", [1, 2])
def test_charts_take_next_to_no_rows(rows):
    scored = _scored(_tracks(1)[:rows].with_columns(x_m=pl.col("x_m") + 1), _tracks(1))
    for chart in (error_over_time, nees_over_time, error_cdf, coverage):
        assert chart(scored, ax=Figure().subplots()).has_data()
    with pytest.raises(UnusableInput, match="error_cdf: no estimate has a truth"):
        error_cdf(_scored(_tracks(1)))


def test_the_error_cdf_has_the_percentiles_of_the_errors(rng):
    error = rng.normal(size=60)
    (line, *_) = [one for one in error_cdf(_with(_tracks(1), x_m=pl.col("x_m") + pl.Series(error)),
                                           ax=Figure().subplots()).lines if len(one.get_xdata()) > 3]  # fmt: skip
    np.testing.assert_allclose(np.interp([0, 50, 95, 100], line.get_ydata(), line.get_xdata()),
                               np.percentile(np.abs(error), [0, 50, 95, 100]), rtol=1e-9)  # fmt: skip


def test_the_coverage_is_the_share_of_rows_within_the_quantile_of_each_level():
    axes = coverage(_with(_tracks(1, sigma=2.0), x_m=pl.col("x_m") + pl.col("t_s")), ax=Figure().subplots())
    line = next(one for one in axes.lines if str(one.get_label()).startswith("horizontal"))
    expected = [100 * np.mean(scipy.stats.chi2.ppf(level / 100, 2) >= T**2 / 3) for level in (50, 90, 95)]
    np.testing.assert_allclose(np.interp([50, 90, 95], line.get_xdata(), line.get_ydata()), expected)
