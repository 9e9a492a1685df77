"""The gain of the IMU on real recordings: the same tracker with and without its samples."""

import dataclasses

import numpy as np
import polars as pl
import pytest

from tests.trackers.recordings.checks.made import with_columns
from trackwright.sim import worlds
from trackwright.sim.corruptions import round_robin
from trackwright.sim.imu import ImuDraw
from trackwright.sim.ranging import RangeDraw, chamber
from trackwright.trackers.catalogue import build, fitting
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.trackers.uwb_imu.body_rows import inertial_trajectories
from trackwright.trackers.uwb_imu.inertial import inertial_tracker

pytestmark = pytest.mark.slow


def _rmse(tracker, recordings):
    """Over the last row of every tenth of a second with a truth, all tags together."""
    estimates, errors = tracker.run(stack(recordings)), []
    for k, one in enumerate(recordings):
        position = [np.asarray(x)[k, : len(one)] for x in estimates.mean.position]
        position = np.stack(position if len(position) == 3 else [*position, one.inputs["height"]], axis=1)
        truth, known = one.truth["position"]
        last = np.append(np.diff(np.floor(one.times * 10)) > 0, True)
        errors.append((position - truth)[known & last & estimates.usable[k, : len(one)]])
    return np.sqrt((np.concatenate(errors) ** 2).sum(axis=1).mean())


def _with_and_without(folder, planar):
    one = read_recording(folder)
    recordings = [trajectory.recording for trajectory in inertial_trajectories(one, False)]
    blind = [dataclasses.replace(r, inputs=r.inputs | {"imu": 0 * r.inputs["imu"]}) for r in recordings]
    tracker = inertial_tracker(len(one.rig.anchors), planar)
    return _rmse(tracker, recordings), _rmse(tracker, blind)


def test_a_tilting_tag_that_its_known_height_has_taken_for_level_is_named():
    walk = (
        ImuDraw(RangeDraw(chamber(), corruptions={"turn": round_robin()}, rate_hz=40.0, n_points=400))
        .drawn()
        .folder("walk")
    )
    walk = dataclasses.replace(walk, rig=dataclasses.replace(walk.rig, tags={"0": Tag(height=1.2)}))
    (line,) = build("uwb-imu", walk).run(walk).notices
    assert "tag 0 typically tilts by" in line
    assert "leave out height_m" in line
    assert build("uwb-imu", walk, free_height=True).run(walk).notices == ()
    level = with_columns("imu", pl.col("^accel_[xy].*$", "^gyro_[xy].*$") * 0.0)(walk)
    assert build("uwb-imu", level).run(level).notices == ()


def test_a_sensor_without_gravity_and_gyro_reduces_the_error_of_a_planar_tag_by_a_tenth(recordings):
    for name, limit in (("ngbui-line-1-1", 0.08), ("ngbui-line-2-1", 0.28)):
        with_imu, without = _with_and_without(recordings / name, planar=True)
        assert with_imu < 0.9 * without
        assert with_imu < limit


def test_in_three_dimensions_the_error_with_the_imu_is_at_most_nine_tenths_of_that_without(recordings):
    with_imu, without = _with_and_without(recordings / "starloc-fast-s1", planar=False)
    assert with_imu < 0.9 * without
    assert with_imu < 0.26


def test_ranges_and_an_imu_are_tracked_without_the_imu_where_the_ranges_suffice():
    folder = worlds.tool(n=1, seed=1, rows=60).folder()
    three = folder.tables["ranges"].filter(pl.col("anchor").is_in(sorted(folder.rig.anchors)[:3]))
    for ranges, expected in ((folder.tables["ranges"], "uwb"), (three, "uwb-imu")):
        tables = dict(folder.tables) | {"ranges": ranges}
        assert fitting(RecordingFolder(folder.name, None, folder.rig, tables)) == expected
