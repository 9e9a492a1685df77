"""Worlds by name: folders, recordings, reproducibility, and refused parameters."""

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from tests.in_process import trackwright
from trackwright.sim import worlds
from trackwright.sim.agv import ANCHOR_HEIGHT
from trackwright.sim.worlds import WORLDS
from trackwright.trackers import catalogue
from trackwright.trackers.recordings.folder import read_recording

SHORT = {
    "station": {"rows": 12, "drop_outs": 0.2},
    "line": {"rate_hz": 1.0},
    "ranges": {"rows": 15, "lost": 0.2},
    "tdoa": {"rows": 15, "lost": 0.2},
    "fusion": {"rows": 15, "lost": 0.2},
    "body": {"rows": 15, "tags": 1, "odometry": True, "lost": 0.2},
    "tool": {"rows": 20, "gap": (0.1, 0.2)},
    "agv": {"rows": 30, "latency": 0.2},
}
"""Numbers that make short recordings, by world."""

COMMANDS = ("station", "line", "ranges")


def _short(name, **numbers):
    return getattr(worlds, name)(seed=3, **SHORT[name], **numbers)


def _assert_equal(one, other):
    assert list(one.tables) == list(other.tables)
    for name, table in one.tables.items():
        assert_frame_equal(table, other.tables[name], check_exact=True)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_folder_is_what_the_command_writes(name, tmp_path):
    options = [word for key, value in SHORT[name].items() for word in (f"--{key.replace('_', '-')}", value)]
    written = trackwright("simulate", name, "--n", 3, "--seed", 3, *options, "--out", tmp_path / "world")
    assert written.code == 0, written
    read, made = read_recording(tmp_path / "world"), _short(name, n=3).folder()
    for table in made.tables:
        assert_frame_equal(read.tables[table].select(made.tables[table].columns), made.tables[table], check_exact=True)
    assert list(read.rig.tags) == list(made.rig.tags) == ["0", "1", "2"]
    assert list(read.rig.anchors) == list(made.rig.anchors)
    assert list(read.rig.stations) == list(made.rig.stations)


@pytest.mark.parametrize("name", WORLDS)
def test_the_same_seed_gives_the_same_bits_and_another_seed_others(name):
    world = _short(name, n=2).folder()
    _assert_equal(world, _short(name, n=2).folder())
    other = getattr(worlds, name)(2, 4, **SHORT[name]).folder()
    measured = next(key for key in world.tables if key != "truth")
    assert not world.tables[measured].equals(other.tables[measured])


@pytest.mark.parametrize("name", WORLDS)
def test_a_subset_of_ids_gives_the_same_trajectories(name):
    every, some = _short(name, n=6).folder(), _short(name, ids=[4, 1]).folder()
    assert list(some.rig.tags) == ["4", "1"]
    for key, table in some.tables.items():
        for tag in ("1", "4"):
            assert table.filter(tag=tag).equals(every.tables[key].filter(tag=tag))


@pytest.mark.parametrize(
    ("name", "tracker"),
    [
        ("line", "fix-kf"),
        pytest.param("ranges", None, marks=pytest.mark.slow),
        pytest.param("station", "direct", marks=pytest.mark.slow),
        pytest.param("tdoa", None, marks=pytest.mark.slow),
        pytest.param("fusion", None, marks=pytest.mark.slow),
    ],
)
def test_the_recordings_run_in_the_tracker_that_reads_them(name, tracker):
    world = _short(name, n=2)
    recordings = world.recordings(tracker)
    assert len(recordings) == 2
    folder = world.folder()
    named = catalogue.build(tracker, folder) if tracker else catalogue.tracker_for(folder)
    for recording in recordings:
        estimates = named.tracker.run(recording)
        position, known = recording.truth["position"]
        found = np.stack([np.asarray(x) for x in estimates.mean.position], axis=-1)
        errors = np.linalg.norm(found - position[:, : found.shape[1]], axis=1)[known & np.asarray(estimates.usable)]
        # Trackers are within a metre of the truth in all four worlds, which are several metres wide or 1 m.
        assert np.median(errors) < 1.0


@pytest.mark.parametrize("antenna", [1, 8])
def test_a_masked_antenna_is_missing_from_its_station_alone(antenna):
    phases = worlds.station(n=1, rows=3, masked_antenna=("2", antenna)).folder().tables["phases"]
    missing = phases.select(pl.col(f"phase_{k}_rad").is_null() for k in range(1, 9)).to_numpy()
    of_station, of_antenna = phases["station"].to_numpy() == "2", np.arange(1, 9) == antenna
    np.testing.assert_array_equal(missing, of_station[:, None] & of_antenna)


def test_heights_of_vehicles_are_mirrored_three_seconds_at_a_stretch():
    fixes = worlds.agv(n=10, rows=2000, mirror=0.3).folder().tables["fixes"]
    above = np.stack([own["z_m"].to_numpy() > ANCHOR_HEIGHT for own in fixes.partition_by("tag")])
    begins = np.diff(above, axis=1, prepend=False) & above
    assert above.mean() == pytest.approx(0.3, abs=0.05)
    assert 0.1 * above.sum() / begins.sum() == pytest.approx(3.0, abs=0.6)
