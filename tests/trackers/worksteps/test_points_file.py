"""Fastening points from files: numbers as numbers or as text, with or without a height."""

import numpy as np
import polars as pl
import pytest

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.worksteps.tracks import read_points

POINTS = {"name": ["a", "b"], "x_m": [1.5, -2.0], "y_m": [0.0, 3.25]}


def test_a_table_of_numbers_is_read_with_and_without_heights(tmp_path):
    for columns in (POINTS, {**POINTS, "z_m": [0.5, 1.0]}):
        expected = np.column_stack([columns[axis] for axis in ("x_m", "y_m", "z_m") if axis in columns])
        pl.DataFrame(columns).write_csv(tmp_path / "points.csv")
        pl.DataFrame(columns).write_parquet(tmp_path / "points.parquet")
        for suffix in ("csv", "parquet"):
            points = read_points(tmp_path / f"points.{suffix}")
            assert points.names == ("a", "b")
            np.testing.assert_array_equal(points.positions, expected)


def test_whole_numbers_and_numbers_in_text_columns_are_numbers(tmp_path):
    pl.DataFrame(POINTS | {"x_m": [1, 2], "y_m": [" 0.5", "3 "]}).write_parquet(tmp_path / "points.parquet")
    np.testing.assert_array_equal(read_points(tmp_path / "points.parquet").positions, [[1.0, 0.5], [2.0, 3.0]])


@pytest.mark.parametrize(("cell", "found"), [("12,5", "'12,5'"), ("", "empty"), ("inf", "'inf'")])
def test_a_cell_that_is_no_number_is_named(tmp_path, cell, found):
    pl.DataFrame(POINTS | {"y_m": ["0.0", cell]}).write_csv(tmp_path / "points.csv", quote_style="always")
    with pytest.raises(UnusableInput, match=rf"y_m.*{found}, expected a finite number"):
        read_points(tmp_path / "points.csv")
