"""The `simulate …` commands: the recordings that they write, the tracker that fits each, and refused options."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.in_process import assert_refused, trackwright
from trackwright.trackers.catalogue import fitting
from trackwright.trackers.line.path import path_of
from trackwright.trackers.recordings.folder import read_recording

WORLDS = {
    "line": (("--rate-hz", 2), {"fixes", "truth"}, "line-grid"),
    "ranges": (("--rows", 30), {"ranges", "truth"}, "uwb"),
    "tdoa": (("--rows", 30, "--schedule", "turns"), {"tdoa", "truth"}, "tdoa"),
    "fusion": (("--rows", 30, "--stations", 1), {"ranges", "bearings", "truth"}, "fusion"),
    "body": (("--rows", 30, "--tags", 1, "--odometry"), {"ranges", "odometry", "truth"}, "uwb"),
    "tool": (("--rows", 40), {"ranges", "imu", "truth"}, "uwb"),
    # Its fixes have heights, which a tracker on a line would lose.
    "agv": (("--rows", 50, "--latency", 0.3, "--mirror", 0.1, "--wild", 0.01), {"fixes", "truth"}, "fix-kf"),
}


@pytest.fixture(scope="module")
def worlds(tmp_path_factory):
    """Two tags of each world."""
    folder = tmp_path_factory.mktemp("worlds")
    for command, (extra, _, _) in WORLDS.items():
        said = trackwright("simulate", command, "--n", 2, "--seed", 4, *extra, "--out", folder / command)
        assert said.code == 0, said
        assert said.out.startswith(f"wrote {folder / command}: 2 tags, ")
    return folder


@pytest.mark.parametrize("command", WORLDS)
def test_a_world_is_a_recording_whose_tables_choose_their_tracker(worlds, command):
    _, tables, tracker = WORLDS[command]
    folder = read_recording(worlds / command)
    assert set(folder.tables) == tables
    assert folder.tables["truth"]["tag"].unique().sort().to_list() == ["0", "1"]
    assert fitting(folder) == tracker


def test_a_tag_depends_on_the_seed_and_its_own_number_alone(worlds, tmp_path):
    assert trackwright("simulate", "ranges", "--n", 1, "--seed", 4, "--rows", 30, "--out", tmp_path / "one").code == 0
    one, two = (pl.read_parquet(path / "ranges.parquet") for path in (tmp_path / "one", worlds / "ranges"))
    assert one.equals(two.filter(pl.col("tag") == "0"))


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [
        ("station", "--seed", 2**70),
        ("station", "--sigma-p", -1.0),
        ("station", "--gauss-markov", "inf"),
        ("station", "--drop-outs", "nan"),
        ("station", "--outliers", 1.0),
        ("station", "--lost-station", 4),
        ("line", "--speed", 0.0),
        ("tool", "--rows", 1),
        ("agv", "--n", 0),
        ("agv", "--speed", 1.5),
    ],
)
def test_a_value_out_of_range_is_refused_with_its_option(tmp_path, command, option, value):
    refused = trackwright("simulate", command, f"{option}={value}", "--out", tmp_path / "out")
    assert_refused(refused, f"{option} {value}: ", "expected ")
    assert not (tmp_path / "out").exists()


def test_a_gap_that_ends_before_it_starts_is_refused(tmp_path):
    refused = trackwright("simulate", "tool", "--gap", 3, 1, "--out", tmp_path / "out")
    assert_refused(refused, "--gap 3.0 1.0: expected two times in seconds")


@pytest.mark.slow
def test_a_tag_on_a_closed_path_is_tracked_round_it_and_has_no_height(worlds, tmp_path):
    folder = read_recording(worlds / "agv")
    knots = folder.rig.path_knots
    # Ends that nearly meet close the path, too.
    gap, part = np.vstack([knots[:-1:60], knots[-1] + 0.01]), knots[:300]
    closed = [path_of(replace(folder, rig=replace(folder.rig, path_knots=k))).closed for k in (knots, gap, part)]
    assert closed == [True, True, False]
    said = trackwright("track", worlds / "agv", "--tracker", "line-grid", "--out", tmp_path / "out")
    assert said.code == 0, said
    assert "height" not in said.err
    tracks = pl.read_parquet(tmp_path / "out" / "tracks.parquet")
    assert tracks["z_m"].null_count() == len(tracks)
    places = tracks.select("x_m", "y_m").to_numpy()
    assert path_of(folder).nearest(places)[1].max() < 1e-4


@pytest.mark.slow
def test_particles_are_tuned_by_their_score(worlds, tmp_path):
    options = ("--tracker", "line-pf", "--tune", "sensors.*.sigma_p", "--steps", 6, "--starts", 1)
    start = tmp_path / "start.toml"
    start.write_text('[tunables."sensors.fixes.sigma_p"]\nvalue = 3.0\n')
    said = trackwright("tune", worlds / "line", *options, "--start", start, "--out", tmp_path / "out")
    assert said.code == 0, said
    content = tomllib.loads((tmp_path / "out" / "tuned.toml").read_text())
    assert content["after"] < content["before"]
    assert content["tunables"]["sensors.fixes.sigma_p"]["value"] < 3.0
