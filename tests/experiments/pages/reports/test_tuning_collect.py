"""The data of a tuning report, against the fit and the tracks they describe."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.experiments.pages.reports.tuning_report_data import walk
from trackwright.experiments.pages.reports.tuning import tuning_page
from trackwright.experiments.pages.reports.tuning_data import _about, _parameters, collect
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks import batches
from trackwright.tuning.data import FitData, fit_data
from trackwright.tuning.fitting import FitOptions, fit
from trackwright.tuning.identifiability import IdentifiabilityIssue
from trackwright.tuning.intervals import intervals_of
from trackwright.tuning.named_objectives import parse_objective

PATTERNS = ("motion.sigma_a", "sensors.fixes.sigma_horizontal")
NLL = "nll"


@pytest.fixture(scope="module")
def run():
    (group,) = spec_of("fix-kf").batches([walk(name, k, rows=64) for k, name in enumerate("abcd")], "fix-kf", False)
    training, held_out = group.trajectories[:2], group.trajectories[2:]
    rows = [batch for _, batch in batches(training)]
    result = fit(group.tracker, rows, parse_objective(NLL, "position", 3), PATTERNS, FitOptions(steps=6, starts=2))
    issues = [IdentifiabilityIssue((PATTERNS[0],), "an issue")]
    data = FitData(group.tracker, parse_objective(NLL), NLL, group.planar, 3, training, held_out, "recordings")
    collected = collect(result, data, NLL, intervals_of(result), issues)
    return result, replace(collected, command="trackwright tune a b", tracker="fix-kf")


def test_parameters_are_those_of_the_fit_and_one_with_an_issue_is_not_determined(run):
    result, data = run
    for number, name in zip(data.parameters, PATTERNS, strict=True):
        assert number.name == name
        assert number.before == float(result.starts[0][0].values[name])
        assert number.after == float(result.values[name])
        assert number.determined is (name != PATTERNS[0])
    assert data.parameters[1].low < data.parameters[1].after < data.parameters[1].high
    assert data.issues == ("an issue",)


def test_the_metrics_of_the_objective_are_those_of_the_fit(run):
    result, data = run
    before, after = data.metric(NLL).training
    # single precision, rows added in another order
    assert (before, after) == pytest.approx((result.start_value, result.value), rel=1e-4)
    assert {s.key for s in data.metrics} == {"nll", "rmse", "rmse-3d", "state-nll"}


def test_the_errors_row_by_row_have_the_rmse_of_the_table(run):
    _, data = run
    assert [e.name for e in data.errors] == ["c, tag t0", "d, tag t0"]
    for side, which in enumerate(("before", "after")):
        pooled = np.concatenate([getattr(e, which) for e in data.errors])
        known = pooled[np.isfinite(pooled)]
        # both take the truth where a late fix was; the batch's times are sums of float32 steps
        assert np.sqrt(np.mean(known**2)) == pytest.approx(data.metric("rmse").held_out[side], rel=1e-4)


def test_recordings_tuned_on_and_held_out_are_kept_apart(run):
    _, data = run
    assert data.training == ("a", "b")
    assert data.held_out == ("c", "d")
    assert data.evaluated_on == "held-out recordings"
    assert [len(np.unique(side.trajectory)) for side in data.innovations] == [2, 2]


def test_every_start_ends_in_the_trace_and_the_winner_is_first(run):
    result, data = run
    assert len(data.traces) == len(result.starts)
    np.testing.assert_array_equal(data.traces[0].objective, [s.value for s in result.trace])


def test_the_surface_is_least_at_the_optimum(run):
    result, data = run
    found = data.surface
    assert found.axes == (0, 1)
    middle = tuple(n // 2 for n in found.values.shape)
    # the optimum is a point of the grid, between which a cubic was laid; single precision
    assert found.values[middle] == pytest.approx(result.value, rel=1e-4)
    assert found.values.min() == pytest.approx(result.value, abs=0.01)
    for grid, number in zip(found.grids, data.parameters, strict=True):
        assert grid[len(grid) // 2] == pytest.approx(number.after, rel=1e-5)


def test_the_data_make_a_page(run):
    text = tuning_page(run[1])
    for word in (
        "an issue",
        "<span>trackwright</span> <span>tune</span>",
        "held-out recordings",
        "to select the best point",
    ):
        assert word in text


def test_without_any_interval_it_is_unknown_what_is_determined(run):
    result, _ = run
    assert [n.determined for n in _parameters(result, {}, [])] == [None, None]
    assert [n.determined for n in _parameters(result, {}, [IdentifiabilityIssue((PATTERNS[0],), "an issue")])] == [
        False,
        None,
    ]


def test_an_objective_has_its_own_unit_or_that_of_the_truth():
    titles = [_about(name, "m") for name in ("nll", "rmse-3d")]
    assert [title.rpartition(" (")[2] for title in titles] == ["nats)", "m)"]


@pytest.mark.slow
def test_of_directions_errors_are_in_degrees_and_metrics_in_radians():
    folder = tw.simulate.station(n=1, rows=40, seed=2).folder()
    data = fit_data(tw.build("beam", folder).only_batch([folder]), NLL)
    sigma = next(name for name in tw.tunables(data.tracker) if name.endswith("sigma_p"))
    result = fit(data.tracker, data.rows(), data.objective, (sigma,), FitOptions(steps=1, starts=1))
    collected = collect(result, data, NLL, intervals_of(result))
    (rmse,) = [one for one in collected.metrics if one.key.startswith("rmse")]
    assert (rmse.unit, collected.error_unit) == ("rad", "°")
    pooled = np.concatenate([track.after for track in collected.errors])
    assert np.sqrt(np.nanmean(pooled**2)) == pytest.approx(np.degrees(rmse.training[1]), rel=0.01)


@pytest.mark.slow
def test_errors_are_one_for_each_time_as_track_has_them_and_begin_at_zero():
    # Four ranges at each time, of which the first rows have much larger errors; the clock counts from 1970.
    whole = tw.simulate.ranges(n=1, seed=3, rows=40).folder()
    tables = {k: t.with_columns(t_s=pl.col("t_s") + 1_777_900_000.0) for k, t in whole.tables.items()}
    folder = RecordingFolder("unix", None, whole.rig, tables)
    named = tw.build("uwb", folder)
    data = fit_data(named.only_batch([folder]), NLL)
    sigma = "sensors.ranges.sigma_r"
    result = fit(data.tracker, data.rows(), data.objective, (sigma,), FitOptions(steps=1, starts=1))
    collected = collect(result, data, NLL, intervals_of(result))
    assert collected.parameters[0].spread.startswith("68 % of the readings within ± 0.")
    assert "68 % of the readings within" in tuning_page(collected)
    (track,) = collected.errors
    shown = tw.evaluate(named.run(folder), folder)
    known = track.before[np.isfinite(track.before)]
    assert len(known) == shown["n"]
    found = [np.sqrt(np.mean(known**2)), np.quantile(known, 0.95)]
    assert found == pytest.approx([shown["rmse_m"], shown["p95_m"]], rel=1e-5)
    assert (track.times[0], track.times[-1]) == pytest.approx((0.0, 3.9), abs=1e-6)
