"""Checks of a recording: anomalies are warnings, wrong units are errors, a good recording has only notes."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.broken import ANOMALOUS
from tests.faulty import write_good
from tests.trackers.recordings.checks.made import Make, only, with_anchors, with_columns, with_rows
from trackwright.sim import worlds
from trackwright.trackers.recordings.checks import CheckResult, format_results
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording

RECORDINGS = Path(
    os.environ.get("TRACKWRIGHT_RECORDINGS", Path(__file__).resolve().parents[5] / "shared" / "recordings")
)


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> RecordingFolder:
    folder = tmp_path_factory.mktemp("check") / "good"
    write_good(folder)
    return read_recording(folder)


def _messages(results: list[CheckResult], *levels: str) -> list[str]:
    return [f"{finding.where}: {finding.message}" for finding in results if not levels or finding.level in levels]


def _has(results: list[CheckResult], level: str, *words: str) -> bool:
    return any(all(word in message for word in words) for message in _messages(results, level))


def test_a_good_recording_has_neither_errors_nor_warnings(good: RecordingFolder):
    assert _messages(check(good), "error", "warning") == []


def test_rates_are_reported_by_sensor_and_tag(good: RecordingFolder):
    messages = _messages(check(good), "info")
    assert "ranges: anchor A1, tag T1: 50 rows, 10 Hz" in messages
    assert "bearings: station S2, tag T2: 50 rows, 10 Hz" in messages
    assert "imu: tag T1: 50 rows, 10 Hz" in messages


def test_many_streams_get_one_summary_line(good: RecordingFolder):
    def crowd(table: pl.DataFrame) -> pl.DataFrame:
        tags = (table.filter(pl.col("tag") == "T1").with_columns(tag=pl.lit(f"tag {k}")) for k in range(300))
        return pl.concat(tags).sort("t_s", maintain_order=True)

    tables = good.tables | {name: crowd(good.tables[name]) for name in ("ranges", "truth")}
    results = check(replace(good, rig=replace(good.rig, tags={}), tables=tables))
    assert "ranges: 300 tags, 4 anchors: 60000 rows, 10 Hz each" in _messages(results, "info")
    assert len(results) < 40
    once = with_rows("ranges", pl.col("t_s") == 0.0)(replace(good, rig=replace(good.rig, tags={}), tables=tables))
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


def test_tables_made_in_memory_are_checked_for_anomalies_too(good: RecordingFolder):
    results = check(with_rows("ranges", ~pl.col("t_s").is_between(1.0, 3.0))(good))
    assert _has(results, "warning", "ranges", "gaps longer than 1 s: 8")
    assert _has(results, "info", "anchor A1, tag T1", "long gaps: 1, the longest 2.2 s before t_s 3.1")


XYZ = pl.col("x_m", "y_m", "z_m")
SUSPICIOUS: dict[str, tuple[str, tuple[str, ...], Make]] = {
    "azimuth in degrees": (
        "error", ("bearings", "azimuth_rad", "degrees"), with_columns("bearings", pl.col("azimuth_rad").degrees())
    ),
    "phases in degrees": ("error", ("phases", "degrees"), with_columns("phases", pl.col("^phase_.*$").degrees())),
    "ranges in millimetres": ("error", ("ranges", "millimetres"), with_columns("ranges", pl.col("range_m") * 1000)),
    "ranges in centimetres": ("error", ("ranges", "centimetres"), with_columns("ranges", pl.col("range_m") * 100)),
    "fixes in millimetres": ("error", ("fixes", "millimetres"), with_columns("fixes", XYZ * 1000)),
    "fixes without a height": (
        "warning",
        ("fixes: neither z_m nor height_m in rig.toml: 1 tag ('T2'); track refuses them", "under [tags.T2]"),
        with_columns("fixes", z_m=pl.lit(None, pl.Float64)),
    ),
    "truth in millimetres": ("error", ("truth", "millimetres"), with_columns("truth", XYZ * 1000)),
    "acceleration in g": ("error", ("imu", "multiples of g"), with_columns("imu", pl.col("^accel.*$") / 9.81)),
    "acceleration in thousandths of g": (
        "error", ("imu", "typical acceleration is 1,000: looks like thousandths of g or cm/s²"),
        with_columns("imu", pl.col("^accel.*$") / 9.81e-3),
    ),
    "acceleration in counts": ("error", ("imu", "16,400 m/s²", "another unit"), with_columns("imu", pl.col("^accel.*$") / 9.81 * 16384)),
    "acceleration without gravity": ("error", ("imu", "with gravity"), with_columns("imu", pl.col("accel_z_mps2") - 9.81)),
    "gravity beside quaternion columns": (
        "warning", ("imu", "quaternion columns"),
        with_columns("imu", qw=pl.lit(1.0), qx=pl.lit(0.0), qy=pl.lit(0.0), qz=pl.lit(0.0)),
    ),
    "turn rates in degrees": ("error", ("imu", "degrees per second"), with_columns("imu", pl.col("^gyro.*$") * 0 + 150)),
    "a table without a value": (
        "error", ("ranges", "all values are missing"), with_columns("ranges", range_m=pl.lit(None, pl.Float64))
    ),
    "an anchor without measurements": (
        "warning", ("anchors never observed: 1 of 4 (A3)",), with_rows("ranges", pl.col("anchor") != "A3")
    ),
    "truth of another time": (
        "error", ("truth", "no measurement lies inside"), with_columns("truth", pl.col("t_s") + 40)
    ),
    "truth of a part": ("warning", ("truth", "covers 20 %"), with_rows("truth", pl.col("t_s") < 0.95)),
    "a hole in the truth": (
        "warning", ("truth", "holes longer than 1 s with motion: 2, the longest 2.2 s after t_s 0.9"),
        with_rows("truth", ~pl.col("t_s").is_between(0.95, 3.05)),
    ),
    "no measurements": ("error", ("no measurements",), only("truth")),
    "one station": (
        "info", ("bearings", "no position without a known height"), with_rows("bearings", pl.col("station") == "S1")
    ),
    "anchors in millimetres": (
        "error", ("rig.toml", "anchors", "millimetres"),
        with_anchors(lambda anchors: {key: 1000 * np.array(place) for key, place in anchors.items()}),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SUSPICIOUS)
def test_a_suspicious_recording_is_reported(good: RecordingFolder, name):
    level, words, make = SUSPICIOUS[name]
    results = check(make(good))
    assert _has(results, level, *words), format_results(results)


@pytest.mark.parametrize(
    ("scale", "shift", "level", "word"),
    [
        (1, 1.7e9, "warning", "seconds since 1970"),
        (1e3, 1.7e12, "error", "milliseconds since 1970"),
        (1e6, 1.7e15, "error", "microseconds since 1970"),
        (1e9, 1.7e18, "error", "nanoseconds since 1970"),
        (1e3, 0, "warning", "looks like milliseconds"),
        (1, 500, "warning", "expected a start near 0"),
    ],
)
def test_a_strange_time_base_is_found(good: RecordingFolder, scale, shift, level, word):
    tables = {name: table.with_columns(pl.col("t_s") * scale + shift) for name, table in good.tables.items()}
    assert _has(check(replace(good, tables=tables)), level, "t_s", word)


def test_tables_of_a_tag_on_two_clocks_are_an_error(good: RecordingFolder):
    later = with_columns("bearings", t_s=pl.col("t_s") + 1.7e9)(good)
    for found in (check(later), quick_check(later)):
        (error,) = _messages(found, "error")
        assert error.startswith("bearings: tag T1: 2023-11-14 22:13:20 UTC to ")
        assert error.endswith(
            ", and ranges 0 to 4.9 s; one of them counts from 1970, the other from its own zero; "
            "expected one clock for all tables"
        )
    (zone, *_) = _messages(quick_check(with_columns("imu", t_s=pl.col("t_s") + 7200.0)(good)), "error")
    assert "2 hours apart, as two time zones" in zone
    after = with_columns("bearings", t_s=pl.col("t_s") + 60.0)(good)
    assert _messages(quick_check(after), "error") == []


def test_a_table_without_any_value_is_called_so_and_nothing_else():
    folder = worlds.tdoa(n=1, rows=30).folder()
    nothing = with_columns("tdoa", range_difference_m=pl.lit(None, pl.Float64))(folder)
    assert _messages(check(nothing), "error") == ["tdoa: all values are missing"]
    # What a tracker, a fit or a survey lacks, each says itself.
    assert quick_check(nothing) == []


def test_a_still_truth_has_no_holes(good: RecordingFolder):
    still = with_columns("truth", x_m=pl.lit(1.0), y_m=pl.lit(1.0), z_m=pl.lit(1.0))(good)
    ends = check(with_rows("truth", pl.col("t_s").is_in([0.0, 4.9]))(still))
    assert not any("holes" in message for message in _messages(ends))
    assert "truth: covers 100 % of the measurements in time" in _messages(ends, "info")


@pytest.mark.parametrize(
    ("positions", "word"),
    [
        ([[0, 0, 2], [6, 0, 2], [6, 5, 2], [0, 5, 2.1]], "height is weakly determined"),
        ([[0, 0, 2], [2, 0, 2], [4, 0, 2], [6, 0, 2.1]], "collinear"),
        ([[0, 0, 0], [0, 4, 0], [0, 4, 3], [0, 0, 3]], "vertical plane"),
        ([[0, 0, 0.3], [0, 0, 0.3], [6, 5, 0.4], [0, 5, 2.9]], "A1 and A2 have the same position"),
    ],
)
def test_weak_geometry_is_reported(good: RecordingFolder, positions, word):
    made = with_anchors(lambda anchors: dict(zip(anchors, np.array(positions, float), strict=True)))(good)
    assert _has(check(made), "warning", "rig.toml", word)


@pytest.mark.parametrize("numbers", [("ranges", "bearings"), ("ranges",), ("bearings",)])
def test_the_sensors_of_all_tables_count_for_a_position(good: RecordingFolder, numbers):
    one = with_rows("bearings", pl.col("station") == "S1")(with_rows("ranges", pl.col("anchor") == "A1")(good))
    results = check(only(*numbers, "truth")(replace(one, rig=replace(one.rig, tags={}))))
    weak = [line for line in _messages(results, "warning") if "never observed" not in line]
    assert bool(weak) == (numbers == ("ranges",)), weak
    assert _has(results, "info", "ranges: ", "with the other tables positions are determined") == (len(numbers) > 1)


def test_without_truth_dilution_is_evaluated_at_the_centre_of_the_rig(good: RecordingFolder):
    blind = only(*(name for name in good.tables if name != "truth"))(good)
    assert any("at the centre of the rig and the height of the tags" in message for message in _messages(check(blind)))


def test_results_are_formatted_as_aligned_lines_with_the_most_severe_first():
    text = format_results(
        [
            CheckResult("info", "t_s", "from 0 to 9 s"),
            CheckResult("error", "bearings", "degrees"),
            CheckResult("warning", "imu", "gaps"),
        ]
    )
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


@pytest.mark.parametrize(
    ("change", "truth", "words"),
    [
        (lambda p: p, True, None),
        (lambda p: 1000.0 * p, False, "offset_m of tag 0-2 is 559 m long: looks like millimetres"),
        (lambda p: 3.0 * p, True, "offset_m of tags 0 and 0-2 are 1.68 m apart, their true positions typically 0.56 m"),
        (lambda p: 0.0 * p, True, "offset_m of tags 0 and 0-2 are 0.00 m apart, their true positions typically 0.56 m"),
        (lambda p: -p if p[1] < 0 else p, True, "offset_m of tags 0-2 and 0-3 are 1.00 m apart"),
        (lambda p: p * [1, -1, 1], True, "offset_m of tags 0, 0-2, 0-3 are mirrored against their true positions"),
        (lambda p: 3.0 * p, False, None),
    ],
)
def test_wrong_places_of_tags_on_a_body_are_named(change, truth, words):
    folder = worlds.body(n=1, rows=50).folder()
    tags = {name: replace(tag, offset=change(np.asarray(tag.offset))) for name, tag in folder.rig.tags.items()}
    folder = replace(folder if truth else only("ranges")(folder), rig=replace(folder.rig, tags=tags))
    for found in (check(folder), quick_check(folder)):
        errors = _messages(found, "error")
        assert len(errors) == (words is not None), errors
        assert all(words in line for line in errors), errors


@pytest.mark.parametrize(
    ("column", "factor", "words"), [("speed_mps", 1e3, "millimetres"), ("yaw_rate_radps", 57.3, "degrees")]
)
def test_odometry_in_other_units_is_named(column, factor, words):
    folder = worlds.body(n=1, tags=1, odometry=True, rows=50).folder()
    assert [result for result in check(folder) if result.level == "error"] == []
    results = check(with_columns("odometry", pl.col(column) * factor)(folder))
    (found,) = [result for result in results if result.level == "error"]
    assert found.where == "odometry"
    assert words in found.message


V, W = pl.col("speed_mps"), pl.col("yaw_rate_radps")
LATE = "s late against the truth's motion: their clocks differ"


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({}, []),
        ({"speed_mps": 3.6 * V}, ["times that of the truth: looks like km/h, expected metres per second"]),
        ({"speed_mps": -V}, ["speed_mps has the wrong sign, expected positive forward; flip it"]),
        ({"yaw_rate_radps": -W}, ["yaw_rate_radps has the wrong sign, expected positive to the left; flip it"]),
        ({"yaw_rate_radps": W.degrees() / 4}, ["expected radians per second"]),
        ({"t_s": pl.col("t_s") + 1.5}, [LATE]),
        (
            {"t_s": pl.col("t_s") + 1.5, "speed_mps": -3.6 * V, "yaw_rate_radps": W.degrees() / 10},
            [LATE, "expected positive forward; flip it; and is typically 3.", "yaw_rate_radps is typically 6."],
        ),
    ],
)
def test_odometry_that_contradicts_the_truth_is_named(columns, words):
    folder = with_columns("odometry", **columns)(worlds.body(n=1, tags=1, odometry=True, rows=200).folder())
    for found in (check(folder), quick_check(folder)):
        errors = _messages(found, "error")
        assert len(errors) == len(words), errors
        assert all(word in line for word, line in zip(words, errors, strict=True)), errors


def test_odometry_is_sound_where_tags_are_off_the_axle_and_forward_is_not_known():
    folder = worlds.body(n=1, odometry=True, rows=200).folder()
    of_one = with_rows("truth", pl.col("tag") == "0-2")(folder)
    for made in (folder, of_one):
        flat = replace(made, tables=made.tables | {"truth": made.tables["truth"].drop("qw", "qx", "qy", "qz")})
        assert quick_check(made) + quick_check(flat) + quick_check(with_columns("odometry", speed_mps=-V)(flat)) == []
