"""The frame and the clock of a truth, found by the readings of a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.exchange.truth_frame import Placement, found_placement


def test_the_clock_is_found_where_readings_come_at_the_first_time_of_the_truth():
    folder = tw.simulate.ranges(n=1, rows=400, seed=4, hidden=0.0, bias=0.0).folder()
    early = folder.tables["truth"].with_columns(pl.col("t_s") - 0.3)
    found, _ = found_placement(replace(folder, tables={**folder.tables, "truth": early}))
    assert found.later == pytest.approx(0.3, abs=0.02)


def test_a_height_that_biases_of_ranges_do_not_determine_stays_as_it_is():
    folder = tw.simulate.ranges(n=1, rows=400, seed=4, hidden=0.0, bias=0.0).folder()
    longer = folder.tables["ranges"].with_columns(pl.col("range_m") + 0.04)
    found, words = found_placement(replace(folder, tables={**folder.tables, "ranges": longer}))
    assert found.z == 0.0
    assert "z as it was" in words
    assert "standard errors" in words


def test_a_height_that_is_clearly_other_is_brought_over_unless_only_x_and_y_are_asked_for():
    folder = tw.simulate.ranges(n=1, rows=400, seed=4, hidden=0.0, bias=0.0).folder()
    truth = folder.tables["truth"].with_columns(pl.col("z_m") - 1.5)
    higher = replace(folder, tables={**folder.tables, "truth": truth})
    assert found_placement(higher)[0].z == pytest.approx(1.5, abs=0.1)
    assert found_placement(higher, flat=True)[0].z == 0.0


def test_fixes_without_a_height_place_a_truth_over_the_floor():
    folder = tw.simulate.agv(n=1, rows=200, seed=2).folder()
    truth, fixes = folder.tables["truth"], folder.tables["fixes"].with_columns(z_m=pl.lit(None, pl.Float64))
    placed = Placement(3.0, -4.0, 0.0, 60.0, 0.0).of_table(truth)
    found, words = found_placement(replace(folder, tables={"fixes": fixes, "truth": placed}))
    assert words.partition(";")[0].count(" m") == 2
    back = found.of_table(placed)
    for axis, most in (("x_m", 0.2), ("y_m", 0.2), ("z_m", 1e-6)):
        assert np.abs(back[axis].to_numpy() - truth[axis].to_numpy()).max() < most
