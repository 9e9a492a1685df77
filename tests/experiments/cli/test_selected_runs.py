"""Runs on a part of a recording, with values set on the command line, and with the tracker of a noise file."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.in_process import PLAIN, assert_refused, trackwright
from trackwright.sim import worlds
from trackwright.trackers.recordings.folder import read_recording, write_recording


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Two tags among four anchors, 6 s of ranges."""
    path = tmp_path_factory.mktemp("selected") / "room"
    write_recording(worlds.ranges(n=2, seed=5, rows=60).folder(), path)
    return path


def _tracks(folder):
    return pl.read_parquet(folder / "tracks.parquet")


def test_a_part_of_a_recording_is_tracked(room, tmp_path):
    part = ("--tag", "1", "--from", 1, "--to", 4)
    done = trackwright("track", room, *PLAIN, "--tracker", "uwb", *part, "--out", tmp_path)
    assert done.code == 0, done
    tracks = _tracks(tmp_path)
    assert set(tracks["tag"]) == {"1"}
    assert 1 <= tracks["t_s"].min() < 1.2
    assert 3.8 < tracks["t_s"].max() <= 4
    config = json.loads((tmp_path / "manifest.json").read_text())["config"]
    assert config["part"] == {"tags": ["1"], "start": 1.0, "stop": 4.0}


def test_seconds_after_the_start_are_refused_where_times_count_from_1970(room, tmp_path):
    folder, since = read_recording(room), 1777898800.0
    tables = {name: table.with_columns(pl.col("t_s") + since) for name, table in folder.tables.items()}
    write_recording(replace(folder, tables=tables), tmp_path / "unix")
    command = ("track", tmp_path / "unix", *PLAIN, "--tracker", "uwb", "--out", tmp_path / "out")
    expected = "the times count from 1970, and 3 s is long before them; 3 s after the start is 1777898803"
    for option in ("--from", "--to"):
        assert_refused(trackwright(*command, option, 3), expected)
    assert trackwright(*command, "--from", since + 3).code == 0
    assert_refused(trackwright("evaluate", tmp_path / "out", "--from", 3), "1777898806")
    assert _tracks(tmp_path / "out")["t_s"].min() >= since + 3


def test_tables_that_the_chosen_tracker_does_not_read_are_named(room, tmp_path):
    folder = read_recording(room)
    fixes = folder.tables["truth"].select("t_s", "tag", "x_m", "y_m", "z_m")
    write_recording(replace(folder, tables={**folder.tables, "fixes": fixes}), tmp_path / "both")
    said = trackwright("track", tmp_path / "both", *PLAIN, "--out", tmp_path / "out")
    assert "EKF with a drifting bias per anchor; without fixes); choose another with --tracker\n" in said.err
    wheels = folder.tables["truth"].select("t_s", "tag", speed_mps=pl.lit(0.5), yaw_rate_radps=pl.lit(0.0))
    write_recording(replace(folder, tables={**folder.tables, "odometry": wheels}), tmp_path / "wheeled")
    said = trackwright("track", tmp_path / "wheeled", *PLAIN, "--out", tmp_path / "out", "--force")
    assert "without odometry); choose another with --tracker" in said.err


def test_a_value_set_is_that_of_a_noise_file_and_goes_before_it(room, tmp_path):
    (tmp_path / "noise.toml").write_text('tracker = "uwb"\n[tunables."sensors.ranges.sigma_r"]\nvalue = 0.3\n')
    by_file = trackwright("track", room, *PLAIN, "--noise", tmp_path / "noise.toml", "--out", tmp_path / "file")
    assert f"tracker: uwb, by {tmp_path / 'noise.toml'}; choose another with --tracker" in by_file.err
    options = ("--tracker", "uwb", "--set", "sensors.*.sigma_r=0.3")
    assert trackwright("track", room, *PLAIN, *options, "--out", tmp_path / "set").code == 0
    assert _tracks(tmp_path / "file").equals(_tracks(tmp_path / "set"))
    both = ("--noise", tmp_path / "noise.toml", "--set", "sensors.ranges.sigma_r=0.1")
    assert trackwright("track", room, *PLAIN, *both, "--out", tmp_path / "both").code == 0
    assert not _tracks(tmp_path / "both").equals(_tracks(tmp_path / "set"))


def test_the_tracker_of_a_noise_file_is_taken_where_the_tables_would_give_another(room, tmp_path):
    (tmp_path / "noise.toml").write_text('tracker = "multilateration"\n[tunables."sigma_r"]\nvalue = 0.3\n')
    done = trackwright("track", room, *PLAIN, "--noise", tmp_path / "noise.toml", "--out", tmp_path / "out")
    assert done.code == 0, done
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["config"]["tracker"] == "multilateration"


def test_quiet_prints_results_alone(room, tmp_path):
    loud = trackwright("track", room, *PLAIN, "--out", tmp_path / "loud")
    quiet = trackwright("track", room, *PLAIN, "--quiet", "--out", tmp_path / "quiet")
    assert loud.err
    assert quiet.err == ""
    assert quiet.out == loud.out.replace(str(tmp_path / "loud"), str(tmp_path / "quiet"))


def test_estimates_of_a_part_are_evaluated(room, tmp_path):
    assert trackwright("track", room, *PLAIN, "--tracker", "uwb", "--out", tmp_path).code == 0
    whole, part = (
        json.loads(trackwright("evaluate", tmp_path, "--json", *words).out)
        for words in ((), ("--tag", "0", "--from", "2"))
    )
    assert len(part["tracks"]) == 1
    later = _tracks(tmp_path).filter((pl.col("tag") == "0") & (pl.col("t_s") >= 2))
    assert part["overall"]["n_rows"] == later.height < whole["overall"]["n_rows"]
    assert_refused(trackwright("evaluate", tmp_path, "--from", 99), "no estimate is of these tags and times")


def test_a_sweep_in_equal_ratios(room, tmp_path):
    over = "sensors.ranges.sigma_r=0.01:1:3:log"
    done = trackwright("sweep", room, "--tracker", "uwb", "--over", over, "--out", tmp_path)
    assert done.code == 0, done
    values = pl.read_csv(tmp_path / "sweep.csv")["sensors.ranges.sigma_r"].to_numpy()
    np.testing.assert_allclose(values, [0.01, 0.1, 1.0])
