"""Trackers of fixes from the folder to the table: trajectories, what is lacking, and the time that an estimate speaks of."""

import tomllib

import numpy as np
import polars as pl
import pytest

from tests.in_process import PLAIN, assert_refused, trackwright
from trackwright.sim.agv import ANCHOR_HEIGHT, simulate_agv
from trackwright.sim.corruptions import correlated_noise, delayed
from trackwright.trackers.baselines.rows import lacks_coplanar_anchors, mirror_trajectories
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.mhk.rows import spatial_trajectories
from trackwright.trackers.mhk.tracker import STILL
from trackwright.trackers.parts.fixes import FIXES, fix_trajectories, lacks_fixes
from trackwright.trackers.recordings.folder import RecordingFolder, write_recording
from trackwright.trackers.recordings.tracks_table import read_tracks

LATENCY = 0.4


@pytest.fixture(scope="module")
def world():
    errors = {"late": delayed(LATENCY), "noise": correlated_noise(STILL)}
    return simulate_agv(2, rows=300, speed=1.0, errors=errors).folder("agv")


@pytest.fixture(scope="module")
def folder(world, tmp_path_factory):
    path = tmp_path_factory.mktemp("fixes") / "agv"
    write_recording(world, path)
    return path


def _with(folder, rig=None, **tables):
    return RecordingFolder(folder.name, folder.path, rig or folder.rig, folder.tables | tables)


def _known_height(folder):
    return _with(
        folder, Rig(folder.name, anchors=folder.rig.anchors, tags={t: Tag(height=1.2) for t in folder.rig.tags})
    )


def test_a_fix_is_a_row_with_masks_and_reported_variances(world):
    table = world.tables["fixes"].with_columns(
        y_m=pl.when(pl.col("t_s") == 1.0).then(None).otherwise("y_m"), x_std_m=pl.lit(0.2), z_std_m=pl.lit(0.3)
    )
    first, second = fix_trajectories(_with(world, fixes=table), free_height=False)
    readings, times = first.recording.readings[FIXES], first.recording.times
    assert (first.tag, second.tag, len(times)) == ("0", "1", 300)
    np.testing.assert_array_equal(readings.seen[:, 1], times != 1.0)
    assert readings.seen[:, [0, 2]].all()
    np.testing.assert_allclose(readings.reported, np.tile([0.04, 0.0, 0.09], (300, 1)))


def test_a_known_height_hides_z_from_planar_trackers_and_stands_for_it_in_mhk(world):
    known = _known_height(world)
    assert not fix_trajectories(known, free_height=False)[0].recording.readings[FIXES].seen[:, 2].any()
    assert fix_trajectories(known, free_height=True)[0].recording.readings[FIXES].seen[:, 2].all()
    np.testing.assert_array_equal(spatial_trajectories(known, False)[0].recording.readings[FIXES].values[:, 2], 1.2)
    one = _with(world, Rig("one", anchors=world.rig.anchors, tags={"0": Tag(height=1.2)}))
    first, second = (each.recording.readings[FIXES].values[:, 2] for each in spatial_trajectories(one, False))
    np.testing.assert_array_equal(first, 1.2)
    np.testing.assert_array_equal(second, fix_trajectories(one, True)[1].recording.readings[FIXES].values[:, 2])


def test_trackers_of_mirrored_heights_read_the_distance_from_the_anchors_plane(world):
    trajectory, plain = mirror_trajectories(world, False)[0], fix_trajectories(world, True)[0]
    values = trajectory.recording.readings[FIXES].values
    z = plain.recording.readings[FIXES].values[:, 2]
    np.testing.assert_allclose(values[:, 2], np.abs(z - ANCHOR_HEIGHT))
    np.testing.assert_array_equal(values[:, 3], 0.0)
    np.testing.assert_allclose(trajectory.recording.inputs["plane"], ANCHOR_HEIGHT)
    np.testing.assert_array_equal(trajectory.recording.inputs["fix_z"], z)


def test_anchors_that_are_few_or_at_several_heights_have_no_plane(world):
    few = dict(list(world.rig.anchors.items())[:2])
    uneven = world.rig.anchors | {"1": np.array([0.0, 0.0, 0.3])}
    assert lacks_coplanar_anchors(world) is None
    assert "found 2 anchors" in lacks_coplanar_anchors(_with(world, Rig("few", anchors=few)))
    assert "2.20 m of height" in lacks_coplanar_anchors(_with(world, Rig("uneven", anchors=uneven)))


def test_fixes_without_any_height_are_refused_and_with_a_known_one_are_not(world):
    flat = world.tables["fixes"].with_columns(z_m=pl.lit(None, pl.Float64))
    assert "height_m" in lacks_fixes(_with(world, fixes=flat))
    assert lacks_fixes(_with(_known_height(world), fixes=flat)) is None


def test_anchors_without_a_plane_are_refused_in_one_line(world, tmp_path):
    write_recording(_with(world, Rig("few", anchors={}, tags=world.rig.tags)), tmp_path / "few")
    said = trackwright("track", tmp_path / "few", "--tracker", "fix-mirror", "--out", tmp_path / "out")
    assert_refused(said, "fix-mirror", "at least 3 anchors")


def test_a_tag_that_is_never_seen_is_a_track_that_waits(world, tmp_path):
    nothing = pl.lit(None, pl.Float64)
    table = world.tables["fixes"].with_columns(
        **{f"{a}_m": pl.when(pl.col("tag") == "1").then(nothing).otherwise(f"{a}_m") for a in "xyz"}
    )
    write_recording(_with(world, fixes=table), tmp_path / "silent")
    options = ("--tracker", "median", *PLAIN, "--out", tmp_path / "out")
    said = trackwright("track", tmp_path / "silent", *options)
    assert said.code == 0, said.err
    tracks = read_tracks(tmp_path / "out")
    assert set(tracks.filter(tag="1")["status"]) == {"waiting"}
    assert tracks.filter(tag="1")["x_m"].null_count() == 300


@pytest.fixture(scope="module")
def tuned(folder, tmp_path_factory):
    """A latency fitted to truth, and the tracks with it."""
    out = tmp_path_factory.mktemp("tuned")
    fit = ("--tracker", "fix-kf", "--objective", "rmse", "--tune", "*latency*", "--steps", 30)
    said = trackwright("tune", folder, *fit, "--out", out / "fit")
    assert said.code == 0, said.err
    options = ("--tracker", "fix-kf", "--noise", out / "fit" / "tuned.toml", "--out", out / "tracks")
    assert trackwright("track", folder, *options).code == 0
    return out


@pytest.mark.slow
def test_a_latency_is_found_by_the_error_against_truth(tuned):
    found = tomllib.loads((tuned / "fit" / "tuned.toml").read_text())["tunables"]["sensors.fixes.latency"]["value"]
    # A filter that lags in corners of 1 m/s² by what half a row covers.
    assert found == pytest.approx(LATENCY, abs=0.05)


@pytest.mark.slow
def test_estimates_stand_at_the_time_for_which_late_fixes_speak(tuned, world):
    tracks = read_tracks(tuned / "tracks").filter(tag="0").sort("t_s")
    shift = world.tables["fixes"].filter(tag="0")["t_s"][0] - tracks["t_s"][0]
    assert abs(shift - LATENCY) < 0.05
    truth = world.tables["truth"].filter(tag="0")
    off = [tracks[a].to_numpy() - np.interp(tracks["t_s"], truth["t_s"], truth[a]) for a in ("x_m", "y_m")]
    late_off = [tracks[a].to_numpy() - np.interp(tracks["t_s"] + shift, truth["t_s"], truth[a]) for a in ("x_m", "y_m")]
    rmse, unstamped = (float(np.sqrt(np.mean(np.sum(np.square(e), axis=0)[30:]))) for e in (off, late_off))
    # Fixes of 3 cm per axis, and what is left of the latency at 1 m/s.
    assert rmse < 0.08
    assert unstamped > 0.3
