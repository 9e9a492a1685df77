"""Steps and repetitions of readings, found from made-up readings of which both are known."""

import dataclasses
import math

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.tuning.worlds import line_tracker, walks
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.recordings.reading_grids import reading_grids

SIGMA, STEP = "sensors.fixes.sigma_horizontal", 0.3


def _gauge(values, seen=None):
    """A recording of a gauge with these values at 10 Hz."""
    values = np.asarray(values, float)
    (made,) = walks([len(values)], 1)
    seen = np.ones(len(values), bool) if seen is None else seen
    return Recording(made.times, {"gauge": Readings(values[:, None], seen[:, None])}, made.inputs)


def test_the_step_of_rounded_readings_is_found_in_single_precision():
    rng = np.random.default_rng(1)
    values = 0.0349 * np.round(rng.normal(0, 8, 2000)) + 0.7
    (grid,) = reading_grids(line_tracker(), [stack([_gauge(values)], dtype=np.float32)])
    assert grid.step == pytest.approx(0.0349, rel=1e-4)
    assert grid.floor == pytest.approx(0.0349 / math.sqrt(12), rel=1e-4)


def test_readings_without_a_grid_have_no_step():
    rng = np.random.default_rng(2)
    (grid,) = reading_grids(line_tracker(), [stack([_gauge(np.repeat(rng.normal(size=400), 5))])])
    assert math.isnan(grid.step)
    assert grid.repeated == pytest.approx(0.8, abs=0.01)
    unread = _gauge(np.zeros(20), np.zeros(20, bool))
    assert reading_grids(line_tracker(), [stack([unread])]) == []


def test_repetitions_are_counted_within_a_trajectory_and_over_missing_rows():
    values, seen = np.repeat(np.arange(50.0), 4), np.ones(200, bool)
    seen[1::4] = False
    # of three values seen in each run of four, two repeat
    (grid,) = reading_grids(line_tracker(), [stack([_gauge(values, seen)] * 3)])
    assert grid.repeated == pytest.approx(100 / 149)
    assert (grid.sensor, grid.unit) == ("gauge", "m")


def test_repetitions_are_those_of_each_station():
    n = 400
    rng = np.random.default_rng(3)
    # two stations in turn, each value four times
    azimuth = np.repeat(rng.normal(size=(n // 8, 2)), 4, axis=0).reshape(-1)
    elevation = 0 * azimuth
    stations = {
        k: Station(np.array([x, 0.0, 2.0]), np.array([1.0, 0.0, 0.0, 0.0])) for k, x in (("a", 0.0), ("b", 5.0))
    }
    bearings = np.stack([azimuth, elevation], axis=1)
    recording = tw.bearing_recording(0.05 * np.arange(n), bearings, ["a", "b"] * (n // 2), stations)
    grids = reading_grids(tw.bearing_tracker(2), [stack([recording])])
    assert grids[0].repeated == pytest.approx(0.75, abs=0.01)


@pytest.fixture(scope="module")
def fine_and_coarse():
    """Recordings of fixes, those of the second rounded to steps of 0.3 m."""
    fine, coarse = (tw.simulate.line(n=2, seed=seed).folder() for seed in (1, 2))
    rounded = [(pl.col(f"{axis}_m") / STEP).round() * STEP for axis in "xy"]
    fixes = coarse.tables["fixes"].with_columns(rounded)
    return [fine, dataclasses.replace(coarse, tables={**coarse.tables, "fixes": fixes})]


def _with_std(folder, std):
    columns = {f"{axis}_std_m": pl.lit(std) for axis in "xyz"}
    return dataclasses.replace(
        folder, tables={**folder.tables, "fixes": folder.tables["fixes"].with_columns(**columns)}
    )


def test_the_variance_of_a_step_is_added_once_in_that_recording_alone(fine_and_coarse):
    small = tw.build("fix-kf", fine_and_coarse).with_values({SIGMA: 0.01})
    summed = small.with_values({SIGMA: math.sqrt(0.01**2 + STEP**2 / 12)})
    table = small.run(fine_and_coarse).to_polars()
    for folder, expected in zip(fine_and_coarse, (small, summed), strict=True):
        alone = expected.run(_with_std(folder, 0.0))
        own = table.filter(pl.col("recording") == folder.name)
        for name in ("x_m", "std_x_m", "nis"):
            # The step is found to a part in a million.
            np.testing.assert_allclose(own[name], alone.to_polars()[name], rtol=1e-4, atol=1e-5)
    (fitted,) = small.only_batch(fine_and_coarse[1]).trajectories[:1]
    np.testing.assert_allclose(fitted.recording.readings["fixes"].reported[:, 0], STEP**2 / 12, rtol=1e-5)


def test_averages_have_the_step_of_the_readings_averaged(fine_and_coarse):
    averaged = fine_and_coarse[1].averaged(0.5)
    (one, *_) = tw.build("fix-kf", averaged).only_batch(averaged).trajectories
    np.testing.assert_allclose(one.recording.readings["fixes"].reported[:, 0], STEP**2 / 12, rtol=1e-5)


def test_no_step_is_added_where_standard_deviations_are_reported(fine_and_coarse):
    reported = _with_std(fine_and_coarse[1], 0.2)
    (one, *_) = tw.build("fix-kf", reported).only_batch(reported).trajectories
    np.testing.assert_allclose(one.recording.readings["fixes"].reported[:, 0], 0.04, rtol=1e-6)
