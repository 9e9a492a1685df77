"""The assembled trackers of ranges and an IMU, on simulated walks from folder to tracks."""

import dataclasses
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from trackwright.sim.corruptions import round_robin
from trackwright.sim.imu import ImuDraw
from trackwright.sim.ranging import RangeDraw, chamber
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.uwb_imu.body_rows import inertial_trajectories
from trackwright.trackers.uwb_imu.inertial import InertialStart, inertial_tracker

TAGS, POINTS = 6, 480


def _blind(recording):
    return dataclasses.replace(recording, inputs={**recording.inputs, "imu": np.zeros_like(recording.inputs["imu"])})


def _errors(estimates, recordings, last_s=6.0):
    """Of all recordings, after the start has settled."""
    errors = []
    for k, recording in enumerate(recordings):
        rows = recording.times > recording.times[-1] - last_s
        position = np.stack([np.asarray(x)[k, : len(recording)] for x in estimates.mean.position], axis=-1)
        errors.append((position - recording.truth["position"][0])[rows])
    return np.concatenate(errors)


@pytest.mark.slow
def test_the_imu_reduces_the_error_of_ranges_alone_by_at_least_a_fifth():
    draw = RangeDraw(chamber(), corruptions={"turn": round_robin()}, rate_hz=40.0, n_points=POINTS)
    world = ImuDraw(draw, gap_s=(3.0, 5.0)).drawn(TAGS, seed=1).folder("walks")
    recordings = [trajectory.recording for trajectory in inertial_trajectories(world, False)]
    tracker = inertial_tracker(sigma_r=0.05, positive_skew=1.1, dof=10.0, bias=0.0)
    with_imu, without = (
        np.sqrt((_errors(tracker.run(stack([*every])), recordings) ** 2).sum(axis=-1).mean())
        for every in (recordings, map(_blind, recordings))
    )
    assert with_imu < 0.06
    assert with_imu < 0.8 * without


def test_the_start_has_a_large_variance_of_the_yaw_alone():
    felt = np.array([5.0, -1.0, 8.0])
    inputs = {"nearby": np.array([1.0, 2.0, 1.5, 1.0]), "rest": np.array([*felt, 0, 0, 0, 0.0])}
    row = Row(np.float64(0), True, {}, inputs, None, None)
    belief = InertialStart(False).belief(inputs["nearby"][:3], row)
    upper = dict(zip(zip(*np.triu_indices(15), strict=True), belief.cov, strict=True))
    P = np.array([[upper[min(i, j), max(i, j)] for j in range(6, 9)] for i in range(6, 9)], float)
    up = felt / np.linalg.norm(felt)
    np.testing.assert_allclose(P, 0.15**2 * np.eye(3) + np.outer(up, up), atol=1e-9)


@pytest.mark.parametrize("planar", [False, True])
def test_a_body_at_rest_starts_with_the_measured_gyro_bias_known_ten_times_better(planar):
    nearby, biases = np.array([1.0, 2.0, 1.5, 1.0]), []
    for at_rest in (0.0, 1.0):
        inputs = {"nearby": nearby, "rest": np.array([0.0, 0.0, 9.81, 0.01, -0.02, 0.04, at_rest])}
        belief = InertialStart(planar).belief(nearby[:3], Row(0.0, True, {}, inputs, None, None))
        n = 8 if planar else 15
        diagonal = [p for p, (i, j) in zip(belief.cov, zip(*np.triu_indices(n), strict=True), strict=True) if i == j]
        first, count = (7, 1) if planar else (12, 3)
        biases.append((np.ravel(belief.mean.gyro_bias), np.sqrt(np.array(diagonal[first : first + count], float))))
    (unknown, loose), (measured, tight) = biases
    np.testing.assert_array_equal(unknown, 0.0)
    np.testing.assert_allclose(measured, [0.04] if planar else [0.01, -0.02, 0.04], rtol=1e-12)
    np.testing.assert_allclose(loose, 0.03, rtol=1e-12)
    np.testing.assert_allclose(tight, 0.003, rtol=1e-12)


def test_tags_on_one_body_share_their_ranges_and_their_imu_and_others_do_not():
    t = [0.0, 0.1, 0.2]
    ranges = pl.DataFrame({"t_s": t, "tag": ["1", "2", "1"], "anchor": ["A", "B", "C"], "range_m": [1.0, 2.0, 3.0]})
    columns = ["accel_x_mps2", "accel_y_mps2", "accel_z_mps2", "gyro_x_radps", "gyro_y_radps", "gyro_z_radps"]
    imu = pl.DataFrame({"t_s": [0.05, 0.1], "tag": ["1", "1"]} | {c: [0.5, 0.5] for c in columns})
    anchors = {"A": np.zeros(3), "B": np.array([4.0, 0, 0]), "C": np.array([0, 4.0, 0])}
    tags = {"1": Tag(offset=np.array([0.1, 0, 0])), "2": Tag(offset=np.array([0, 0.2, 0]))}
    folder = RecordingFolder("body", Path("body"), Rig("body", anchors, tags=tags), {"ranges": ranges, "imu": imu})
    first, second = (trajectory.recording for trajectory in inertial_trajectories(folder, False))
    np.testing.assert_array_equal(first.times, [0, 0.05, 0.1, 0.2])
    np.testing.assert_allclose(first.inputs["levers"], [[0, 0, 0], [0, 0, 0], [-0.1, 0.2, 0], [0, 0, 0]])
    np.testing.assert_allclose(second.inputs["arm"], np.tile([0, 0.2, 0], (4, 1)))
    np.testing.assert_array_equal(second.inputs["imu"], [[0, 0], [1, 1], [1, 1], [1, 1]])
    apart = dataclasses.replace(folder, rig=Rig("apart", anchors))
    first, second = (trajectory.recording for trajectory in inertial_trajectories(apart, False))
    np.testing.assert_array_equal(first.inputs["imu"], [[0, 0], [1, 1], [1, 1], [1, 1]])
    # A tag without an IMU of its own is tracked by its ranges.
    np.testing.assert_array_equal(second.inputs["imu"], [[0, 0]])
    assert TRACKERS["uwb-imu"].missing(folder) is None
    for table, lacking in (("imu", {"ranges": ranges}), ("ranges", {"imu": imu})):
        assert table in TRACKERS["uwb-imu"].missing(dataclasses.replace(folder, tables=lacking))
