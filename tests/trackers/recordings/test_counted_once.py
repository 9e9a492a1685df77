"""Rows recorded twice and values that a source repeats are used once; the rounding of readings is in their variance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from scipy.integrate import quad
from scipy.stats import norm

import trackwright as tw
from trackwright.trackers.recordings.named_tracker import chance_of_repeat, counted_once

IDS, NAMES = ["tag", "anchor"], ["ranges"]
STEP = 0.3


def _ranges(held, seed=5, step=0.01):
    """Simulated ranges in steps, m, a share `held` of which repeats the value before; and whether each row is new."""
    folder = tw.simulate.ranges(n=4, seed=seed).folder()
    table = folder.tables["ranges"].with_columns(range_m=(pl.col("range_m") / step).round() * step)
    new = np.random.default_rng(seed).random(len(table)) >= held
    latest = pl.when("new").then("range_m").forward_fill().over(IDS)
    # Before the first that is new of its tag and anchor a range is itself.
    table = table.with_columns(new=pl.Series(new)).with_columns(range_m=pl.coalesce(latest, "range_m")).drop("new")
    return replace(folder, tables=folder.tables | {"ranges": table}), new


@pytest.mark.parametrize("held", [0.35, 0.6])
def test_rows_that_repeat_a_value_lose_it_and_stay(held):
    folder, new = _ranges(held)
    once, (line,) = counted_once(folder, NAMES)
    values = folder.tables["ranges"].with_columns(before=pl.col("range_m").shift().over(IDS))
    repeats = (values["range_m"] == values["before"]).fill_null(False).to_numpy()
    assert np.mean(~new[repeats]) > 0.9  # most of them are no new readings
    table = once.tables["ranges"]
    assert (table["range_m"].is_null().to_numpy() == repeats).all()
    assert table.drop("range_m").equals(folder.tables["ranges"].drop("range_m"))
    assert f"ranges: {repeats.sum()} of {len(repeats)} rows repeat" in line
    every, (fresh, _) = folder.averaged(0), _ranges(0.0)
    for kept, names in ((every, NAMES), (folder, ["fixes"]), (fresh, NAMES)):
        assert counted_once(kept, names) == (kept, [])


@pytest.mark.slow
def test_estimates_are_those_without_the_rows_that_repeat_and_no_surer_than_their_errors():
    folder, _ = _ranges(0.5)
    named = tw.build("uwb", folder)
    assert any("rows repeat" in line for batch in named.batches(folder) for line in batch.notices)
    table = counted_once(folder, NAMES)[0].tables["ranges"].drop_nulls("range_m")
    without = replace(folder, tables=folder.tables | {"ranges": table})
    found = named.run(folder)
    both = found.table.join(named.run(without).table, on=["tag", "t_s"], suffix="_without").filter(status="ok")
    assert len(both) > 500
    for name in ("x_m", "y_m", "std_x_m"):
        assert np.abs(both[name] - both[f"{name}_without"]).max() < 2e-3
    folder, _ = _ranges(0.6)
    once, often = (tw.evaluate(named.run(f), f).overall for f in (folder, folder.averaged(0)))
    assert once["coverage_95"] > often["coverage_95"] + 0.05


@pytest.mark.parametrize(("sigma", "most"), [(0.5, np.inf), (1.0, 2.5), (3.0, 1.2), (10.0, 1.1)])
def test_the_chance_of_a_repeat_bounds_the_exact_one(sigma, most):
    # A change of d steps between two values at any place between two steps leaves their rounded values equal with
    # probability 1 − |d|.
    exact = quad(lambda d: (1 - abs(d)) * norm.pdf(d, scale=sigma), -1, 1, points=[0.0])[0]
    rng = np.random.default_rng(6)
    phase = rng.random(400_000)
    steps = np.floor(phase + sigma * rng.normal(size=len(phase)))
    bound = chance_of_repeat(0.02 * steps, 0.02)
    assert 0.97 * exact < bound < most * exact


@pytest.mark.parametrize(("table", "tracker"), [("fixes", "fix-kf"), ("fixes", "moving-average"), ("ranges", "uwb")])
def test_rows_that_are_recorded_twice_count_once_in_a_tracker(table, tracker):
    once = (tw.simulate.agv if table == "fixes" else tw.simulate.ranges)(n=1, rows=60, seed=3).folder()
    rows = once.tables[table]
    doubled = pl.concat([rows, rows[:20]]).sort("t_s", maintain_order=True)
    twice = replace(once, tables={**once.tables, table: doubled})
    counted, lines = counted_once(twice, [table])
    assert counted.tables[table].height == rows.height
    assert lines == [f"{once.name}: {table}: duplicate rows: 20; counted once"]
    one, other = (tw.build(tracker, folder).run(folder).to_polars() for folder in (once, twice))
    for name in ("x_m", "y_m", "std_x_m"):
        np.testing.assert_array_equal(one[name], other[name])


@pytest.fixture(scope="module")
def fine_and_coarse():
    """Recordings of fixes, those of the second rounded to steps of 0.3 m."""
    fine, coarse = (tw.simulate.line(n=2, seed=seed).folder() for seed in (1, 2))
    rounded = [(pl.col(f"{axis}_m") / STEP).round() * STEP for axis in "xy"]
    fixes = coarse.tables["fixes"].with_columns(rounded)
    return [fine, replace(coarse, tables={**coarse.tables, "fixes": fixes})]


def _with_std(folder, std):
    fixes = folder.tables["fixes"].with_columns(**{f"{axis}_std_m": pl.lit(std) for axis in "xyz"})
    return replace(folder, tables={**folder.tables, "fixes": fixes})


@pytest.mark.parametrize(
    ("change", "variance"),
    [
        (lambda folder: folder, STEP**2 / 12),
        (lambda folder: folder.averaged(0.5), STEP**2 / 12),
        (lambda folder: _with_std(folder, 0.2), 0.04),
    ],
    ids=["as they are", "averaged", "with standard deviations"],
)
def test_readings_have_the_variance_of_their_step_unless_one_is_reported(fine_and_coarse, change, variance):
    folder = change(fine_and_coarse[1])
    (one, *_) = tw.build("fix-kf", folder).only_batch(folder).trajectories
    np.testing.assert_allclose(one.recording.readings["fixes"].reported[:, 0], variance, rtol=1e-5)
