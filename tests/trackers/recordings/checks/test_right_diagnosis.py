"""Clocks that wrap, jump or lost their digits, and mistakes that an easier hypothesis must not hide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.trackers.recordings.checks.made import only, with_columns
from tests.trackers.recordings.checks.test_hall_mistakes import _hall, _lines
from trackwright.trackers.recordings.checks.all_checks import quick_check
from trackwright.trackers.recordings.tables import unwrapped_times

R, T, X, Y = pl.col("range_m"), pl.col("t_s"), pl.col("x_m"), pl.col("y_m")
WILD = pl.Series(np.random.default_rng(1).uniform(0, 250, 1800))
ROW = pl.int_range(pl.len())
CASES = {
    "an anchor wild in most readings": (
        "ranges", "warning", "of anchor A2 are typically", {"range_m": pl.when((pl.col("anchor") == "A2") & (ROW % 5 > 0)).then(WILD).otherwise(R)},
    ),
    "the frame before the height": (
        "truth", "error", "truth turned by -127.0", {"x_m": -0.6 * X - 0.8 * Y + 10.0, "y_m": 0.8 * X - 0.6 * Y, "z_m": pl.col("z_m") + 1.5},
    ),
    "azimuths from 0 to 2π": ("bearings", "warning", "from 0 to 2π", {"azimuth_rad": pl.col("azimuth_rad") % (2 * np.pi)}),
    "azimuths alone, of another sign": (
        "bearings", "error", "flip its sign", {"azimuth_rad": -pl.col("azimuth_rad"), "elevation_rad": pl.lit(None, pl.Float64)},
    ),
    "many wild readings": ("ranges", "warning", "outliers of range_m", {"range_m": pl.when(WILD > 150).then(WILD - 200).otherwise(R)}),
    "one time for all rows": ("ranges", "error", "lost their digits", {"t_s": pl.lit(5.0)}),
    "a clock that jumps by years": ("ranges", "warning", "the clock jumps by 52.", {"t_s": T + pl.when(T > 30).then(1.66e9).otherwise(0.0)}),
    "times of 0": ("ranges", "warning", "times of 0 in", {"t_s": pl.when(ROW % 90 == 0).then(0.0).otherwise(T + 1.66e9)}),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_right_cause_is_named_and_no_other_error(name):
    table, level, words, columns = CASES[name]
    made = with_columns(table, **columns)(only(*dict.fromkeys((table, "ranges", "truth")))(_hall()))
    made = replace(made, tables={**made.tables, table: made.tables[table].sort("t_s", maintain_order=True)})
    assert any(words in line for line in _lines(made, level)), _lines(made, "error", "warning")
    errors = [one.message for one in quick_check(made) if one.level == "error"]
    if "clock" not in name and "times" not in name and "time" not in name:
        assert [words in line for line in errors] == [True] * (level == "error"), errors


@pytest.mark.parametrize("period", [2**32 * 1e-6, 2**32 * 1e-3])
def test_a_counter_of_32_bits_that_wraps_is_unwrapped_and_named(period):
    t = 0.1 * np.arange(200) + period - 7.0
    found, (notice,) = unwrapped_times(t % period)
    np.testing.assert_allclose(found, t, rtol=1e-9)
    assert "2³² " in notice
    assert unwrapped_times(t)[1] == []
