"""Checks of a recording: anomalies are warnings, wrong units are errors, a good recording has only notes."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from tests.broken import ANOMALOUS
from tests.trackers.recordings.checks.made import good, only, with_columns, with_rows
from trackwright.sim import worlds
from trackwright.trackers.recordings.checks import CheckResult, format_results
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.folder import read_recording

RECORDINGS = Path(
    os.environ.get("TRACKWRIGHT_RECORDINGS", Path(__file__).resolve().parents[5] / "shared" / "recordings")
)


def _messages(results: list[CheckResult], *levels: str) -> list[str]:
    return [f"{finding.where}: {finding.message}" for finding in results if not levels or finding.level in levels]


def _has(results: list[CheckResult], level: str, *words: str) -> bool:
    return any(all(word in message for word in words) for message in _messages(results, level))


def test_a_good_recording_has_neither_errors_nor_warnings_and_rates_by_sensor_and_tag():
    results = check(good())
    assert _messages(results, "error", "warning") == []
    assert {"ranges: anchor A1, tag T1: 50 rows, 10 Hz", "imu: tag T1: 50 rows, 10 Hz"} <= {*_messages(results, "info")}
    # One sensor may be switched on after another.
    assert _messages(quick_check(with_columns("bearings", t_s=pl.col("t_s") + 60.0)(good())), "error") == []
    blind = only(*(name for name in good().tables if name != "truth"))(good())
    assert any("at the centre of the rig and the height of the tags" in message for message in _messages(check(blind)))


def test_a_still_truth_has_no_holes():
    still = with_columns("truth", x_m=pl.lit(1.0), y_m=pl.lit(1.0), z_m=pl.lit(1.0))(good())
    ends = _messages(check(with_rows("truth", pl.col("t_s").is_in([0.0, 4.9]))(still)))
    assert not any("holes" in message for message in ends)
    assert "truth: covers 100 % of the measurements in time" in ends


def test_many_streams_get_one_summary_line():
    def crowd(table: pl.DataFrame) -> pl.DataFrame:
        tags = (table.filter(pl.col("tag") == "T1").with_columns(tag=pl.lit(f"tag {k}")) for k in range(300))
        return pl.concat(tags).sort("t_s", maintain_order=True)

    tables = good().tables | {name: crowd(good().tables[name]) for name in ("ranges", "truth")}
    results = check(replace(good(), rig=replace(good().rig, tags={}), tables=tables))
    assert "ranges: 300 tags, 4 anchors: 60000 rows, 10 Hz" in _messages(results, "info")
    assert len(results) < 40
    once = with_rows("ranges", pl.col("t_s") == 0.0)(replace(good(), rig=replace(good().rig, tags={}), tables=tables))
    assert "ranges: 300 tags, 4 anchors: 1200 rows" in _messages(check(once), "info")


@pytest.mark.parametrize("name", ANOMALOUS)
def test_an_anomaly_is_a_notice_and_reported(tmp_path: Path, name):
    word = ANOMALOUS[name](tmp_path / "recording")
    folder = read_recording(tmp_path / "recording")
    assert any(word in notice for notice in folder.notices)
    assert all(notice.isprintable() for notice in folder.notices)
    results = check(folder)
    assert any(word in message for message in _messages(results, "warning", "error"))
    assert all("\n" not in message for message in _messages(results))


@pytest.mark.parametrize("numbers", [("ranges", "bearings"), ("ranges",), ("bearings",)])
def test_the_sensors_of_all_tables_count_for_a_position(numbers):
    one = with_rows("bearings", pl.col("station") == "S1")(with_rows("ranges", pl.col("anchor") == "A1")(good()))
    results = check(only(*numbers, "truth")(replace(one, rig=replace(one.rig, tags={}))))
    weak = [line for line in _messages(results, "warning") if "never observed" not in line]
    assert bool(weak) == (numbers == ("ranges",)), weak
    assert _has(results, "info", "ranges: ", "with the other tables positions are determined") == (len(numbers) > 1)


def test_results_are_formatted_as_aligned_lines_with_the_most_severe_first():
    lines = (("info", "t_s", "from 0 to 9 s"), ("error", "bearings", "degrees"), ("warning", "imu", "gaps"))
    text = format_results([CheckResult(*line) for line in lines])
    assert text.splitlines() == [
        "error    bearings  degrees",
        "warning  imu       gaps",
        "info     t_s       from 0 to 9 s",
        "errors: 1, warnings: 1, notes: 1",
    ]
    assert format_results([]) == "errors: 0, warnings: 0, notes: 0"


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="requires the real recordings; set TRACKWRIGHT_RECORDINGS")
@pytest.mark.parametrize("nth", [3, pytest.param(1, marks=pytest.mark.slow)], ids=["every third", "all"])
def test_every_real_recording_reads_and_no_mistake_is_named_in_it(nth):
    files = sorted(RECORDINGS.glob("*/rig.toml"))
    assert len(files) >= 28
    recordings = [read_recording(file.parent) for file in files[::nth]]
    wrong = {one.name: _messages(check(one), "error") + _messages(quick_check(one)) for one in recordings}
    # Its clocks were brought together by positions alone; turn rates fit better with the IMU some 0.03 s later.
    late = {name: lines for name, lines in wrong.items() if name == "starloc-fast-s1"}
    assert all(len(lines) == 1 and "comes 0.03 s early" in lines[0] for lines in late.values())
    assert not any(wrong[name] for name in wrong.keys() - late.keys()), wrong


def test_odometry_is_sound_where_tags_are_off_the_axle_and_forward_is_not_known():
    folder = worlds.body(n=1, odometry=True, rows=200).folder()
    of_one = with_rows("truth", pl.col("tag") == "0-2")(folder)
    for made in (folder, of_one):
        flat = replace(made, tables=made.tables | {"truth": made.tables["truth"].drop("qw", "qx", "qy", "qz")})
        backward = with_columns("odometry", speed_mps=-pl.col("speed_mps"))(flat)
        assert [line for one in (made, flat, backward) for line in quick_check(one)] == []
