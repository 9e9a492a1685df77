"""Rows that are recorded twice."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.recordings.reading_grids import counted_once


def _folders(table):
    folder = tw.simulate.ranges(n=1, rows=60, seed=3).folder()
    truth = folder.tables["truth"]
    noise = np.random.default_rng(1).normal(0.0, 0.1, truth.height)
    fixes = truth.select("t_s", "tag", "x_m", "y_m", "z_m").with_columns(pl.col("x_m") + pl.Series(noise))
    folder = replace(folder, tables={"ranges": folder.tables["ranges"], "fixes": fixes})
    rows = folder.tables[table]
    doubled = pl.concat([rows, rows[:20]]).sort("t_s", maintain_order=True)
    return folder, replace(folder, tables={**folder.tables, table: doubled})


@pytest.mark.parametrize(("table", "tracker"), [("fixes", "fix-kf"), ("fixes", "moving-average"), ("ranges", "uwb")])
def test_rows_that_are_recorded_twice_count_once_in_a_tracker(table, tracker):
    once, twice = (tw.build(tracker, folder).run(folder).to_polars() for folder in _folders(table))
    for name in ("x_m", "y_m", "std_x_m"):
        np.testing.assert_array_equal(once[name], twice[name])


def test_duplicate_rows_are_counted_in_a_notice():
    once, twice = _folders("fixes")
    counted, lines = counted_once(twice, ["fixes"])
    assert counted.tables["fixes"].height == once.tables["fixes"].height
    assert lines == [f"{once.name}: fixes: duplicate rows: 20; counted once"]
