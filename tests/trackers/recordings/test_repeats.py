"""Values that a source repeats are used once; readings that a coarse grid or a tag at rest repeats are all used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from scipy.integrate import quad
from scipy.stats import norm

import trackwright as tw
from trackwright.trackers.recordings.checks.readings import Readings
from trackwright.trackers.recordings.reading_grids import chance_of_repeat, counted_once, source_repeats

IDS = ["tag", "anchor"]
NAMES = ["ranges"]


def _ranges(held, seed=5, step=0.01):
    """Simulated ranges in steps, m, a share `held` of which repeats the value before; and whether each row is new."""
    folder = tw.simulate.ranges(n=4, seed=seed).folder()
    table = folder.tables["ranges"].with_columns(range_m=(pl.col("range_m") / step).round() * step)
    new = np.random.default_rng(seed).random(len(table)) >= held
    latest = pl.when("new").then("range_m").forward_fill().over(IDS)
    # Before the first that is new of its tag and anchor a range is itself.
    table = table.with_columns(new=pl.Series(new)).with_columns(range_m=pl.coalesce(latest, "range_m")).drop("new")
    return replace(folder, tables=folder.tables | {"ranges": table}), new


def _readings(values, step):
    values = np.round(np.asarray(values) / step) * step
    return Readings(("range_m",), np.zeros(len(values), int), values[:, None])


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
    every = folder.averaged(0)
    assert counted_once(every, NAMES) == (every, [])
    assert counted_once(folder, ["fixes"]) == (folder, [])


def test_new_readings_are_all_used():
    folder, _ = _ranges(0.0)
    assert counted_once(folder, NAMES) == (folder, [])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_values_that_are_held_on_the_way_to_an_anchor_or_away_from_it_are_told(sign):
    way = np.cumsum(np.random.default_rng(3).integers(3, 9, 200))
    assert source_repeats(_readings(20.0 + sign * 0.01 * np.repeat(way, 2), 0.01))


def test_estimates_are_those_without_the_rows_that_repeat():
    folder, _ = _ranges(0.5)
    named = tw.build("uwb", folder)
    assert any("rows repeat" in line for batch in named.batches(folder) for line in batch.notices)
    found = named.run(folder).table
    table = counted_once(folder, NAMES)[0].tables["ranges"].drop_nulls("range_m")
    without = replace(folder, tables=folder.tables | {"ranges": table})
    both = found.join(named.run(without).table, on=["tag", "t_s"], suffix="_without").filter(status="ok")
    assert len(both) > 500
    for name in ("x_m", "y_m", "std_x_m"):
        assert np.abs(both[name] - both[f"{name}_without"]).max() < 2e-3


def test_estimates_of_repeated_readings_are_no_surer_than_their_errors():
    folder, _ = _ranges(0.6)
    once, every = (tw.evaluate(tw.build("uwb", f).run(f), f).overall for f in (folder, folder.averaged(0)))
    assert once["coverage_95"] > every["coverage_95"] + 0.05


def test_trackers_that_count_rows_read_every_row():
    folder, _ = _ranges(0.5)
    (batch,) = tw.build("multilateration", folder).batches(folder)
    assert batch.notices == ()
    assert all(
        (trajectory.recording.readings["ranges"].seen.sum(axis=1) > 0).any() for trajectory in batch.trajectories
    )


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
