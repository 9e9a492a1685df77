"""The `simulate …` commands: the recordings that they write, the tracker that fits each, and refused options."""

from __future__ import annotations

import polars as pl
import pytest

from tests.in_process import trackwright
from trackwright.trackers.catalogue import fitting
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
