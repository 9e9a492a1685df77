"""Rows that are recorded twice."""

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.recordings.reading_grids import counted_once


@pytest.mark.parametrize("world, tracker", [("fixes", "fix-kf"), ("fixes", "moving-average"), ("ranges", "uwb")])
def test_rows_that_are_recorded_twice_count_once_in_a_tracker(world, tracker):
    folder = getattr(tw.simulate, world)(n=1, rows=60, seed=3).folder()
    table = folder.tables[world]
    twice = tw.RecordingFolder(
        folder.name, None, folder.rig, {**folder.tables, world: pl.concat([table, table[:20]]).sort("t_s")}
    )
    assert tracker in TRACKERS
    once, both = (tw.build(tracker, each).run(each).table for each in (folder, twice))
    assert once.height == both.height
    for name in ("x_m", "y_m", "std_x_m"):
        np.testing.assert_array_equal(once[name], both[name])


def test_duplicate_rows_are_counted_in_a_notice():
    folder = tw.simulate.fixes(n=1, rows=60, seed=3).folder()
    table = folder.tables["fixes"]
    twice = tw.RecordingFolder(folder.name, None, folder.rig, {"fixes": pl.concat([table, table[:20]]).sort("t_s")})
    once, lines = counted_once(twice, ["fixes"])
    assert once.tables["fixes"].height == table.height
    assert lines == [f"{folder.name}: fixes: duplicate rows: 20; counted once"]
