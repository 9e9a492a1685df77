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
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.checks.readings import robust_fit
from trackwright.trackers.recordings.checks.rules import CheckResult
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
    assert {"ranges: 400 rows, 10 Hz", "imu: 100 rows, 10 Hz"} <= {*_messages(results)}
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


def test_a_wrong_place_of_an_anchor_is_corrected_to_the_side_on_which_rig_toml_has_it():
    (error,) = quick_check(with_anchors(lambda _: {"A4": np.array([12.0, 3.0, 2.7])})(hall()))
    place = [float(x) for x in error.message.partition("at (")[2].partition(")")[0].split(",")]
    np.testing.assert_allclose(place, hall().rig.anchors["A4"], atol=0.4)


def test_a_robust_fit_ignores_a_fifth_of_wild_errors():
    rng, true = np.random.default_rng(0), np.array([1.0, -2.0])
    x = rng.uniform(-3, 3, 400)
    y = true[0] * x + true[1] + rng.normal(0, 0.05, 400) + 30.0 * (rng.random(400) < 0.2)
    found, size = robust_fit(lambda p: (p[0] * x + p[1] - y)[:, None], np.zeros(2))
    assert found == pytest.approx(true, abs=0.03)
    assert size < 0.06
