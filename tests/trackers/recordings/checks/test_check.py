"""Checks of a recording: a good one has only notes, an anomaly is a notice, and figures are those that were made."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.broken import ANOMALOUS
from tests.trackers.recordings.checks.made import good, hall, only, with_anchors, with_columns, with_rows
from trackwright.trackers.exchange.importing import placed
from trackwright.trackers.recordings.checks import CheckResult, format_results
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.checks.readings import Readings, quantisation_step, repeated_share, robust_fit
from trackwright.trackers.recordings.folder import read_recording

RECORDINGS = Path(
    os.environ.get("TRACKWRIGHT_RECORDINGS", Path(__file__).resolve().parents[5] / "shared" / "recordings")
)
T = pl.col("t_s")


def _messages(results: list[CheckResult], *levels: str) -> list[str]:
    return [f"{finding.where}: {finding.message}" for finding in results if not levels or finding.level in levels]


def test_a_good_recording_has_neither_errors_nor_warnings_and_a_line_for_each_table():
    results = check(good())
    assert _messages(results, "error", "warning") == []
    assert {"ranges: 400 rows, 2 tags, 4 anchors, 10 Hz", "imu: 100 rows, 2 tags, 10 Hz"} <= {*_messages(results)}
    # One sensor may be switched on after another.
    assert _messages(quick_check(with_columns("bearings", t_s=T + 60.0)(good())), "error") == []


@pytest.mark.parametrize("name", ANOMALOUS)
def test_an_anomaly_is_a_notice_and_reported(tmp_path: Path, name):
    word = ANOMALOUS[name](tmp_path / "recording")
    folder = read_recording(tmp_path / "recording")
    assert any(word in notice and notice.isprintable() for notice in folder.notices)
    results = check(folder)
    assert any(word in message for message in _messages(results, "warning", "error"))
    assert all("\n" not in message for message in _messages(results))


@pytest.mark.parametrize("numbers", [("ranges", "bearings"), ("ranges",), ("bearings",)])
def test_the_sensors_of_all_tables_count_for_a_position(numbers):
    one = with_rows("bearings", pl.col("station") == "S1")(with_rows("ranges", pl.col("anchor") == "A1")(good()))
    results = check(only(*numbers, "truth")(replace(one, rig=replace(one.rig, tags={}))))
    weak = [line for line in _messages(results, "warning") if "never observed" not in line]
    assert bool(weak) == (numbers == ("ranges",)), weak


def test_results_are_formatted_as_aligned_lines_with_the_most_severe_first():
    lines = (("info", "t_s", "from 0 to 9 s"), ("error", "bearings", "degrees"), ("warning", "imu", "gaps"))
    assert format_results([CheckResult(*line) for line in lines]).splitlines() == [
        "error    bearings  degrees",
        "warning  imu       gaps",
        "info     t_s       from 0 to 9 s",
        "errors: 1, warnings: 1, notes: 1",
    ]


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="requires the real recordings; set TRACKWRIGHT_RECORDINGS")
@pytest.mark.parametrize("nth", [3, pytest.param(1, marks=pytest.mark.slow)], ids=["every third", "all"])
def test_no_mistake_is_named_in_a_real_recording_with_and_without_its_truth(nth):
    files = sorted(RECORDINGS.glob("*/rig.toml"))
    assert len(files) >= 28
    for recording in (read_recording(file.parent) for file in files[::nth]):
        blind = only(*({*recording.tables} - {"truth"}))(recording)
        assert (
            _messages(check(recording), "error") + _messages(quick_check(recording)) + _messages(quick_check(blind))
            == []
        ), recording.name


@pytest.mark.parametrize("turn", [(0.8, 0.6), (1.0, 0.0)])
def test_a_truth_in_another_frame_and_late_is_named_with_the_numbers_that_bring_it_over(turn):
    x, y, (c, s) = pl.col("x_m"), pl.col("y_m"), turn
    moved = with_columns("truth", x_m=c * x - s * y + 50.0, y_m=s * x + c * y, t_s=T + 0.35)
    folder = moved(only("ranges", "truth")(hall()))
    (error,) = quick_check(folder)
    numbers = [float(x) for x in error.message.rpartition(" ")[2].split(",")]
    assert numbers[4] == pytest.approx(-0.35, abs=0.02)
    truth = placed(folder.tables["truth"], numbers)
    assert quick_check(replace(folder, tables={**folder.tables, "truth": truth})) == []


def test_a_truth_somewhat_late_is_a_warning_with_the_option_that_shifts_it_and_late_fixes_are_none():
    for table, late in (("ranges", 0.35), ("ranges", -0.25), ("bearings", 0.35)):
        (warning,) = quick_check(with_columns("truth", t_s=T + late)(only(table, "truth")(hall())))
        assert (warning.level, warning.where) == ("warning", table)
        assert float(warning.message.rpartition(",")[2]) == pytest.approx(-late, abs=0.03)
    truth = hall().tables["truth"]
    for late, levels in ((0.4, []), (-0.4, ["warning"])):  # fixes come late by the delay of their filter
        fixes = truth.with_columns(t_s=T + late)
        assert [one.level for one in quick_check(replace(hall(), tables={"fixes": fixes, "truth": truth}))] == levels


def test_a_wrong_place_of_an_anchor_is_corrected_to_the_side_on_which_rig_toml_has_it():
    (error,) = quick_check(with_anchors(lambda _: {"A4": np.array([12.0, 3.0, 2.7])})(hall()))
    place = [float(x) for x in error.message.partition("at (")[2].partition(")")[0].split(",")]
    np.testing.assert_allclose(place, hall().rig.anchors["A4"], atol=0.4)


def test_bias_spread_and_outliers_of_an_anchor_are_those_made():
    late = pl.when(pl.col("anchor") == "A3").then(pl.col("range_m") + 0.4).otherwise("range_m")
    lines = _messages(check(only("ranges", "truth")(with_columns("ranges", range_m=late)(hall()))), "info")
    (line,) = (line for line in lines if "anchor A3 against truth" in line)
    assert line.startswith("ranges: anchor A3 against truth: range bias +0.4")
    assert ", spread 0.08 m, outliers 0.00%" in line


def _of(values, streams=1, column="range_m"):
    """Readings of so many streams."""
    return Readings((column,), np.repeat(np.arange(streams), len(values) // streams), values[:, None])


@pytest.mark.parametrize(("step", "column"), [(0.01, "range_m"), (np.deg2rad(2.0), "azimuth_rad"), (0.0078, "x_m")])
def test_a_quantisation_step_is_found(step, column):
    rng = np.random.default_rng(2)
    values = step * np.round((3 + 0.5 * np.sin(0.01 * np.arange(2000)) + 2 * step * rng.normal(size=2000)) / step)
    values = np.mod(values + np.pi, 2 * np.pi) - np.pi if column.endswith("_rad") else values
    values[::100] += 0.5 * step  # one in a hundred is a mean of two
    assert quantisation_step(_of(values, 1, column), 0) == pytest.approx(step, rel=1e-3)
    for continuous in (rng.normal(size=5000), rng.uniform(size=300), np.ones(100)):
        assert quantisation_step(_of(continuous), 0) is None


def test_repeats_are_counted_along_streams():
    assert repeated_share(_of(np.repeat(np.arange(50.0), 2))) == pytest.approx(50 / 99)
    assert repeated_share(_of(np.array([1.0, 2.0, 2.0, 1.0]), 2)) == 0.0


def test_a_robust_fit_ignores_a_fifth_of_wild_errors():
    rng, true = np.random.default_rng(0), np.array([1.0, -2.0])
    x = rng.uniform(-3, 3, 400)
    y = true[0] * x + true[1] + rng.normal(0, 0.05, 400) + 30.0 * (rng.random(400) < 0.2)
    found, size = robust_fit(lambda p: (p[0] * x + p[1] - y)[:, None], np.zeros(2))
    assert found == pytest.approx(true, abs=0.03)
    assert size < 0.06


def test_the_anchors_in_use_are_no_line_in_any_orientation_of_the_rig():
    # A room of 6 × 5 × 2.6 m, turned at random: neither a plane nor a line.
    turn, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    turned = with_anchors(lambda anchors: {key: turn @ place for key, place in anchors.items()})
    assert not any(
        "coplanar" in line or "collinear" in line for line in _messages(check(only("ranges")(turned(good()))))
    )
