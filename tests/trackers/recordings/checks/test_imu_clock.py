"""The clock of an IMU is compared with that of ranges without truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import polars as pl
import pytest

from tests.trackers.recordings.checks.made import with_columns
from trackwright.sim.imu import simulate_uwb_imu
from trackwright.sim.paths import hand_motion
from trackwright.sim.ranging import WALK_VOLUME, chamber
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.recordings.checks.all_checks import check
from trackwright.trackers.recordings.checks.imu_clock import check_imu_clock, delay_of, windows
from trackwright.trackers.recordings.folder import RecordingFolder

T = pl.col("t_s")
WORDS = "motion in the ranges"


@cache
def _world() -> RecordingFolder:
    path = partial(hand_motion, volume=WALK_VOLUME, speed=1.0)
    return simulate_uwb_imu(chamber(), path, seed=5, n_points=1600).folder("walk")


def _later(by: float | pl.Expr, truth: bool = False) -> RecordingFolder:
    tables = {name: rows for name, rows in _world().tables.items() if truth or name != "truth"}
    return replace(_world(), tables=tables | {"imu": tables["imu"].with_columns(T + by)})


def _messages(recording: RecordingFolder) -> list[str]:
    return [one.message for one in check_imu_clock(recording)]


@pytest.mark.parametrize("late", [0.1, 0.3, -0.5, -2.0])
def test_the_delay_of_an_imu_is_found_by_the_ranges(late):
    found = [one for one in check(_later(late)) if WORDS in one.message]
    assert len(found) == (abs(late) > 0.2)
    for one in found:
        assert (one.level, one.where) == ("warning", "imu")
        assert ("late" if late > 0 else "early") in one.message
    assert delay_of([up for up, _ in windows(_later(late), "0")]) == pytest.approx(late if found else 0.0, abs=0.1)


def test_a_true_attitude_tells_the_delay_better():
    lines = [one.message for one in check(_later(0.5, truth=True)) if "their clocks differ" in one.message]
    assert len(lines) == 1
    assert "against the truth's attitude" in lines[0]


@pytest.mark.parametrize("truth", [True, False])
def test_anchors_with_z_down_are_told_by_the_motion_of_an_imu(truth):
    folder = _later(0.0, truth)
    anchors = {key: place * [1.0, -1.0, -1.0] for key, place in folder.rig.anchors.items()}
    (found,) = (
        one for one in check(replace(folder, rig=replace(folder.rig, anchors=anchors))) if "down" in one.message
    )
    assert (found.level, found.where) == ("error", "rig.toml")
    assert not any("down" in one.message for one in check(folder))


@pytest.mark.parametrize("seed", [0, 7, 8])
def test_a_slow_walk_below_and_above_anchors_tells_no_side(seed):
    def sines(_, t):
        x = 6 + 4.2 * np.sin(0.23 * t + 0.65 * seed) + 0.6 * np.sin(0.71 * t + 1.3 * seed)
        y = 4 + 2.3 * np.sin(0.31 * t + 1 + 0.65 * seed) + 0.4 * np.cos(0.9 * t)
        return np.stack([x, y, 1.1 + 0.05 * np.sin(0.5 * t + 0.65 * seed) + 0.03 * np.sin(6 * t)], axis=-1)[None]

    rig = chamber(np.array([[0, 0, 2.6], [12, 0, 2.2], [12, 8, 0.4], [0, 8, 2.4], [6, 0, 0.5], [6, 8, 2.9]]))
    walk = simulate_uwb_imu(rig, sines, seed=seed, rate_hz=60.0, n_points=7200).folder("walk")
    noise = np.random.default_rng(seed).normal(0.05, 0.08, len(walk.tables["ranges"]))
    assert not any(
        "down" in line for line in _messages(with_columns("ranges", range_m=pl.col("range_m") + noise)(walk))
    )


def test_an_imu_of_another_motion_tells_no_delay():
    folder = _later(0.0)
    turned_back = folder.tables["imu"].with_columns(T.reverse()).sort("t_s")
    assert _messages(replace(folder, tables=dict(folder.tables) | {"imu": turned_back})) == []


def test_a_clock_that_jumps_has_no_delay():
    middle = float(_world().tables["imu"]["t_s"].mean())
    jumping = _later(pl.when(middle < T).then(1.0).otherwise(-1.0))
    assert delay_of([up for up, _ in windows(jumping, "0")]) is None


def test_the_delay_is_found_in_coordinates_of_a_map():
    folder = _later(-0.5)
    anchors = {key: np.add(place, [4e5, 5e6, 300.0]) for key, place in folder.rig.anchors.items()}
    (line,) = _messages(replace(folder, rig=replace(folder.rig, anchors=anchors)))
    assert "0.5 s early" in line


def test_ranges_of_all_tags_of_a_body_count():
    folder = _later(0.5)
    tags = {"0": Tag(offset=np.zeros(3)), "twin": Tag(offset=np.zeros(3))}
    every_other = pl.int_range(pl.len()) // 4 % 2 == 0
    ranges = folder.tables["ranges"].with_columns(tag=pl.when(every_other).then(pl.lit("0")).otherwise(pl.lit("twin")))
    shared = replace(folder, rig=replace(folder.rig, tags=tags), tables=dict(folder.tables) | {"ranges": ranges})
    expected = [len(up.times) for up, _ in windows(folder, "0")]
    assert [len(up.times) for up, _ in windows(shared, "0")] == expected


def test_ranges_of_another_body_count_nothing():
    folder = _later(0.5)
    tags = {name: Tag(offset=np.zeros(3)) for name in ("0", "other")}
    ranges = folder.tables["ranges"]
    other = ranges.with_columns(T + 0.01, tag=pl.lit("other"), range_m=pl.col("range_m") + 2.0)
    tables = dict(folder.tables) | {"ranges": pl.concat([ranges, other]).sort("t_s")}
    rig = replace(folder.rig, tags=tags, bodies={"one": ("0",), "two": ("other",)})
    (alone, _), *_ = windows(folder, "0")
    (beside, _), *_ = windows(replace(folder, rig=rig, tables=tables), "0")
    np.testing.assert_array_equal(beside.errors, alone.errors)


def test_a_row_of_another_clock_costs_no_memory():
    folder = _later(0.5)
    imu = folder.tables["imu"]
    far = pl.concat([imu, imu.tail(1).with_columns(T + 1e14)])
    assert len(_messages(replace(folder, tables=dict(folder.tables) | {"imu": far}))) == 1


SILENT = {
    "few rows": lambda imu: imu.head(5),
    "too short": lambda imu: imu.filter(T < 20.0),
    "without gravity": lambda imu: imu.with_columns(pl.col("accel_z_mps2") - 9.81),
    "a gap in every window": lambda imu: imu.filter(T % 1.0 < 0.7),
}


@pytest.mark.parametrize("name", SILENT)
def test_an_imu_that_cannot_tell_is_not_reported(name):
    folder = _later(0.5)
    assert _messages(replace(folder, tables=dict(folder.tables) | {"imu": SILENT[name](folder.tables["imu"])})) == []
