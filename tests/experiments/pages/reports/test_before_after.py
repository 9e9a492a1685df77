"""Recordings and tracks before and after tuning, as its report shows them, against the estimates and their evaluation."""

import re

import numpy as np
import polars as pl
import pytest
from scipy import stats

import trackwright as tw
from tests.experiments.pages.reports.tuning_report_data import report_data, walk
from trackwright.experiments.pages.charts.tuning import plan_chart
from trackwright.experiments.pages.reports.before_after import MOST_PLANS, compare, judge, track_changes, tracked
from trackwright.experiments.pages.reports.tuning import tuning_page
from trackwright.sim import worlds
from trackwright.trackers.evaluation.rows import covariances

LEVELS = "sensors.fixes.sigma_*"
SIGMAS = tuple(0.1 * (1 + tag) for tag in range(7))
"""Errors of tags, m, the larger the higher their number."""

ONE = SIGMAS[:1]


def _run(folders, held_out=()):
    """The tracks of both sets of noise levels, and what the page shows of them."""
    named = tw.build("fix-kf", folders, free_height=True)
    trackers = [named.with_values({LEVELS: sigma}) for sigma in (0.02, 0.3)]
    sides = [tracked(tracker, folders) for tracker in trackers]
    return trackers, track_changes(*sides, folders, held_out)


def _metrics(tracker, folders):
    """The metrics of every track by recording and tag."""
    return {(t["recording"], t["tag"]): t for t in tw.evaluate(tracker.run(folders), folders).tracks}


@pytest.fixture(scope="module")
def three():
    folders = [walk("a", 1, sigmas=ONE), walk("b", 2, sigmas=ONE, hole=30.0), walk("c", 3, sigmas=SIGMAS[:2])]
    return folders, *_run(folders, {"b"})


def _named(found):
    return [(*change.errors.name.split(", tag "), change.held_out) for change in found.shown]


def _traces(change):
    chart = plan_chart(change).plotly()
    assert chart["layout"]["yaxis"]["scaleanchor"] == "x"
    return {trace["name"]: trace for trace in chart["data"]}


def _drawn(trace):
    return np.array([trace["x"], trace["y"]], float).T


def _rows(tracker, folders, change):
    """The estimates of the track that a plan shows."""
    recording, tag = change.errors.name.split(", tag ")
    rows = tracker.run(folders).table
    return rows.filter(pl.col("recording") == recording, pl.col("tag") == tag).sort("t_s")


def test_paths_and_errors_are_those_of_the_estimates_and_held_out_ones_come_first(three):
    folders, trackers, found = three
    assert _named(found) == [("b", "t0", True), ("a", "t0", False), ("c", "t0", False), ("c", "t1", False)]
    assert (found.total, {t.why for t in found.shown}) == (4, {""})
    for name, tracker in zip(("before", "after"), trackers, strict=True):
        own = _metrics(tracker, folders)
        for change in found.shown:
            side = getattr(change, name)
            assert side.rmse[change.track] == pytest.approx(
                own[tuple(change.errors.name.split(", tag "))]["rmse_m"], rel=1e-5
            )
            path = _drawn(_traces(change)[name])
            expected = _rows(tracker, folders, change).select("x_m", "y_m").to_numpy()
            np.testing.assert_allclose(path[np.isfinite(path[:, 0])], expected, rtol=1e-4, atol=1e-5)
    assert re.fullmatch(r"RMSE \d+\.\d → \d+\.\d cm; held out\.", plan_chart(found.shown[0]).caption)


def test_the_truth_is_that_of_its_table_and_holes_stay_open(three):
    folders, _, found = three
    held_out, other = map(_traces, found.shown[:2])
    truth = folders[0].tables["truth"].select("x_m", "y_m").to_numpy()
    np.testing.assert_allclose(_drawn(other["truth"]), truth, rtol=1e-4, atol=1e-5)
    for name in ("truth", "before", "after"):
        assert np.flatnonzero(np.isnan(_drawn(held_out[name])[:, 0])).tolist() == [30]


def test_ellipses_before_and_after_are_of_the_same_times_and_hold_95_percent(three):
    folders, trackers, found = three
    traces, times = _traces(found.shown[1]), []
    for name, tracker in zip(("before", "after"), trackers, strict=True):
        rows = _rows(tracker, folders, found.shown[1])
        outlines = _drawn(traces[f"95 % ellipses {name}"]).reshape(12, -1, 2)[:, :-1]
        places = rows.select("x_m", "y_m").to_numpy()
        # An outline begins and ends at the same point; its middle is the mean of the others.
        at = [int(np.argmin(np.linalg.norm(places - line[:-1].mean(axis=0), axis=1))) for line in outlines]
        times.append(rows["t_s"].gather(at).to_list())
        for k, line in zip(at, outlines, strict=True):
            off, row = (line - places[k]).T, rows.row(k, named=True)
            cov = [[row["std_x_m"] ** 2, row["cov_xy_m2"]], [row["cov_xy_m2"], row["std_y_m"] ** 2]]
            # numbers of the chart have five digits
            np.testing.assert_allclose(
                (off * np.linalg.solve(cov, off)).sum(axis=0), stats.chi2.ppf(0.95, 2), rtol=0.02
            )
    assert times[0] == times[1]


def test_of_many_tags_the_worst_the_median_and_the_best_are_shown():
    folders = [walk("hall", 4, sigmas=SIGMAS[:7])]
    trackers, found = _run(folders)
    ranked = sorted(_metrics(trackers[1], folders).values(), key=lambda t: -t["rmse_m"])
    assert [tag for _, tag, _ in _named(found)] == [ranked[k]["tag"] for k in (0, 3, 6)]
    assert found.total == 7
    assert [t.why.partition(" of 7, RMSE ")[0] for t in found.shown] == ["worst", "median", "best"]
    _, few = _run([walk("hall", 4, sigmas=SIGMAS[:3])])
    assert [(t.track, t.why) for t in few.shown] == [(0, ""), (1, ""), (2, "")]


@pytest.mark.slow
def test_of_many_recordings_those_that_moved_most_are_shown_in_their_order_and_held_out_ones_first():
    folders = [walk(f"r{k}", k, sigmas=SIGMAS[: 1 + (k == 2)]) for k in range(MOST_PLANS + 2)]
    trackers, found = _run(folders, {"r5"})
    old, new = (tracker.run(folders).table for tracker in trackers)
    square = (old["x_m"] - new["x_m"]) ** 2 + (old["y_m"] - new["y_m"]) ** 2
    moved = old.select("recording", "tag").with_columns(square.alias("s")).group_by("recording", "tag").mean()
    first = pl.col("recording") == "r5"
    kept = moved.sort(first, "s", descending=True)[:MOST_PLANS].sort(~first, "recording", "tag")
    assert [(name, tag) for name, tag, _ in _named(found)] == list(kept.select("recording", "tag").iter_rows())
    assert (len(found.shown), found.total) == (MOST_PLANS, MOST_PLANS + 3)
    page = tuning_page(report_data(plans=found))
    assert f"{MOST_PLANS} of {MOST_PLANS + 3} tracks are shown" in page
    assert page.index("Floor plan of r5, tag t0") < page.index("Floor plan of r2, tag t1")


def test_without_truth_there_are_paths_and_no_errors():
    _, found = _run([walk("blind", 5, sigmas=SIGMAS[:5], truth=False)])
    assert len(found.shown) == 3
    assert not np.isfinite([t.rmse for t in found.shown]).any()
    assert {"before", "after"} < set(_traces(found.shown[0])) - {"truth"}
    assert "truth" not in _traces(found.shown[0])


def test_of_directions_there_are_errors_in_degrees_and_no_plans():
    folders = [worlds.station(n=1, seed=1, rows=20).folder()]
    named = tw.build("beam", folders)
    side = tracked(named, folders)
    shown, total, errors = track_changes(side, side, folders, ())
    assert (shown, total) == ((), 0)
    own = {(t["tag"], t["station"]): t["rmse_direction_rad"] for t in tw.evaluate(named.run(folders), folders).tracks}
    assert len(errors) == len(own)
    for track, rmse in zip(errors, own.values(), strict=True):
        assert np.sqrt(np.nanmean(track.after**2)) == pytest.approx(np.degrees(rmse), rel=1e-5)


def test_errors_are_of_held_out_recordings_one_for_each_time_and_begin_at_zero(three):
    folders, trackers, found = three
    (track,) = found.errors
    assert (track.name, track.times[0]) == ("b, tag t0", 0.0)
    for side, tracker in zip((track.before, track.after), trackers, strict=True):
        own = _metrics(tracker, folders)["b", "t0"]
        assert np.isfinite(side).sum() == own["n"]
        assert np.sqrt(np.nanmean(side**2)) == pytest.approx(own["rmse_m"], rel=1e-5)


@pytest.fixture(scope="module")
def walks():
    folders = [walk("short", 1, 100), walk("long", 2, 400)]
    named = tw.build("fix-kf", folders, free_height=True)
    return folders, (named.with_values({LEVELS: 0.05}), named.with_values({LEVELS: 0.25}))


def _both(trackers, folders):
    return [tracked(tracker, folders) for tracker in trackers]


@pytest.mark.parametrize(("dimensions", "suffix"), [(2, ""), (3, "_3d")])
def test_the_figures_are_those_of_evaluate_and_recordings_have_the_same_say(walks, dimensions, suffix):
    folders, trackers = walks
    found = compare(_both(trackers, folders), folders, dimensions, "held-out recordings")
    sides = [{r["recording"]: r for r in tw.evaluate(t.run(folders), folders).recordings} for t in trackers]
    assert [row[0] for row in found.section.rows] == ["long", "short", "mean of 2"]
    for name, *cells, density, difference in found.section.rows[:2]:
        before, after = (side[name] for side in sides)
        change = found.verdict.recordings[name]
        assert density == f"{change.first:.2f} → {change.second:.2f}"
        assert difference == f"{change.value:+.2f} ± {change.high - change.value:.2f}"
        error, share, nees, lost, nis = (cell.split(" → ") for cell in cells)
        assert error == [f"{100 * m[f'rmse{suffix}_m']:.1f}" for m in (before, after)]
        assert share == [f"{100 * m[f'coverage_95{suffix}']:.0f}" for m in (before, after)]
        assert nees == [f"{m[f'nees{suffix}_ratio']:.2f}" for m in (before, after)]
        assert lost == [
            f"{m[f'nees{suffix}_ratio'] - 1 - np.log(m[f'nees{suffix}_ratio']):.2f}" for m in (before, after)
        ]
        assert nis == [f"{m['nis_ratio']:.2f}" for m in (before, after)]
    mean = np.mean([sides[1][name][f"rmse{suffix}_m"] for name in ("short", "long")])
    assert found.section.rows[2][1].split(" → ")[1] == f"{100 * mean:.1f}"
    assert found.section.parts[0].startswith("Reported ")
    assert found.verdict.word == "better"
    back = compare(_both(trackers[::-1], folders), folders, dimensions, "held-out recordings").verdict
    assert (back.word, sorted(text.split()[0] for text in back.got_worse)) == ("worse", ["long", "short"])
    assert back.change.value == pytest.approx(-found.verdict.change.value)
    text = found.text()
    assert text.startswith("Held-out recordings, before → after")
    assert all(cell in text for row in found.section.rows for cell in row)


def test_a_recording_without_truth_has_no_errors(walks):
    folders, trackers = walks
    own = [folders[0], walk("blind", 3, 100, truth=False)]
    found = compare(_both(trackers, own), own, 2, "recordings tuned on")
    blind = next(row for row in found.section.rows if row[0] == "blind")
    assert blind[1:5] == ["– → –"] * 4
    assert "–" not in blind[5]


@pytest.mark.parametrize("dimensions", [2, 3])
def test_the_log_density_is_that_of_scipy(walks, dimensions):
    folders, trackers = walks
    sides = _both(trackers, folders[:1])
    verdict = judge(sides, dimensions)
    for side, found in zip(sides, (verdict.change.first, verdict.change.second), strict=True):
        known, expected = side.filter(pl.col("why").is_null()), []
        for row, cov in zip(known.iter_rows(named=True), covariances(known)[:, :dimensions, :dimensions], strict=True):
            error = [row[f"error_{a}_m"] for a in "xyz"][:dimensions]
            expected.append(stats.multivariate_normal(np.zeros(dimensions), cov).logpdf(error))
        assert found == pytest.approx(np.mean(expected), rel=1e-6)
