"""Faults that random cases found, each in its smallest form."""

from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest
from rich.table import Table

from tests.faulty import good_tables, write_good
from tests.in_process import assert_refused, trackwright
from trackwright.experiments.text.tables import width_of
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.tuning.checkpoint import from_arrays
from trackwright.tuning.optimisation import Adam


@pytest.mark.parametrize("table", ["bearings", "fixes", "ranges"])
def test_a_table_that_stands_there_twice_has_an_autocorrelation_time(tmp_path, table):
    write_good(tmp_path / "good")
    once = trackwright("check", tmp_path / "good")
    good = good_tables()[table]
    pl.concat([good, good]).write_csv(tmp_path / "good" / f"{table}.csv")
    twice = trackwright("check", tmp_path / "good")
    assert twice.code == once.code

    def correlated(text: str) -> list[str]:
        return [line for line in text.splitlines() if line.startswith(f"info     {table}") and "correlated" in line]

    assert correlated(twice.out) == correlated(once.out)


def test_medians_of_columns_without_a_value_are_unknown_without_a_warning():
    x = np.array([[1.0, np.nan, 5.0], [3.0, np.nan, np.nan]])
    np.testing.assert_array_equal(known_median(x), [2.0, np.nan, 5.0])
    assert np.isnan(known_median(x[:0])).all()


def test_a_change_that_leaves_errors_unknown_explains_no_coordinates_of_light_minutes(tmp_path):
    write_good(tmp_path / "good")
    fixes = good_tables()["fixes"]
    fixes.with_columns(z_m=1e14 + 1e12 * pl.col("x_m")).write_csv(tmp_path / "good" / "fixes.csv")
    said = trackwright("check", tmp_path / "good")
    assert "nan m" not in said.out
    assert "RuntimeWarning" not in said.err


def test_fixes_without_a_height_are_compared_with_a_truth_in_another_frame(tmp_path):
    write_good(tmp_path / "good")
    tables = good_tables()
    tables["fixes"].with_columns(z_m=pl.lit(None, pl.Float64)).write_csv(tmp_path / "good" / "fixes.csv")
    truth = tables["truth"].with_columns(pl.col("x_m") + 7.0)
    truth.write_csv(tmp_path / "good" / "truth.csv")
    said = trackwright("check", tmp_path / "good")
    assert "error    fixes     errors against truth" in said.out
    assert "the truth shifted by (-7.00, 0.00," in said.out
    assert said.err == ""


def test_a_name_in_brackets_is_no_markup_of_a_table():
    table = Table("[/]")
    table.add_row("[/] [bold]x")
    assert width_of(table) >= len("[/] [bold]x")


@pytest.mark.parametrize(
    "content", [[], {}, {"cells": [{}]}, {"cells": 3}, {"cells": [{"world": 1, "point": [], "figures": {}}]}]
)
def test_results_that_no_study_wrote_are_refused(tmp_path, content):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps(content))
    said = trackwright("evaluate", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "out")
    assert_refused(said, "a/results.json: cannot be read", "run the study")


@pytest.mark.parametrize(
    "change", [{"overall": None}, {"overall": {"rmse_m": "x"}}, {"recordings": [3]}, {"recordings": [{}]}]
)
def test_metrics_that_no_command_wrote_are_refused(tmp_path, change):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        content = {"kind": "position", "overall": {"rmse_m": 1.0}, "recordings": [], **change}
        (tmp_path / name / "evaluation.json").write_text(json.dumps(content))
    said = trackwright("evaluate", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "out")
    assert_refused(said, "a/evaluation.json: cannot be read")


def test_a_line_of_another_system_within_a_table_with_semicolons_is_refused(tmp_path):
    (tmp_path / "log.csv").write_bytes(b"t_s;x_m;y_m\n0;1\r2;3\n")
    said = trackwright(
        "import", tmp_path / "log.csv", "--table", "fixes", "--separator", ";", "--tag", "T", "--out", tmp_path / "out"
    )
    assert said.code == 2
    assert "log.csv: line 2 has 2 cells, expected 3 as in line 1, the header" in said.err.splitlines()[-1]


@pytest.mark.parametrize("count", [0, 1, 7, 60])
def test_a_checkpoint_of_another_number_of_arrays_is_no_state_of_a_fit(count):
    with pytest.raises(UnusableInput, match=rf"checkpoint.npz: holds {count} arrays, .*begin anew"):
        from_arrays(Adam(3), [np.zeros((2, 3))] * count)
