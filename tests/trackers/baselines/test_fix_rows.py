"""Trackers of fixes from the folder to the table: trajectories, what is lacking, and the time that an estimate speaks of."""

import numpy as np
import polars as pl
import pytest

from trackwright.sim.agv import ANCHOR_HEIGHT, VehicleDraw
from trackwright.sim.corruptions import correlated_noise, delayed
from trackwright.trackers.baselines.rows import mirror_trajectories
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.mhk.rows import spatial_trajectories
from trackwright.trackers.mhk.tracker import STILL
from trackwright.trackers.parts.fixes import FIXES, fix_trajectories, lacks_fixes
from trackwright.trackers.recordings.folder import RecordingFolder

LATENCY = 0.4


@pytest.fixture(scope="module")
def world():
    errors = {"late": delayed(LATENCY), "noise": correlated_noise(STILL)}
    return VehicleDraw(errors, speed=1.0, rows=300).drawn(2).folder("agv")


def _with(folder, rig=None, **tables):
    return RecordingFolder(folder.name, folder.path, rig or folder.rig, folder.tables | tables)


def _known_height(folder):
    tags = dict.fromkeys(folder.rig.tags, Tag(height=1.2))
    return _with(folder, Rig(folder.name, anchors=folder.rig.anchors, tags=tags))


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


def test_fixes_without_any_height_are_refused_and_with_a_known_one_are_not(world):
    flat = world.tables["fixes"].with_columns(z_m=pl.lit(None, pl.Float64))
    assert "height_m" in lacks_fixes(_with(world, fixes=flat))
    assert lacks_fixes(_with(_known_height(world), fixes=flat)) is None
