"""TUM, KITTI and EuRoC files: written by evo, read by us, and the other way round; what is wrong is named by its line."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.trackers.exchange.against_evo import evo_modules
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange.pose_errors import compare_trajectories
from trackwright.trackers.exchange.trajectories import (
    PoseTrajectory,
    read_trajectory,
    write_trajectory,
)

EUROC = """#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_x
1403636580838555648,4.688319,-1.786938,0.783338,0.534108,-0.153029,-0.827383,-0.082152,-0.027876
1403636580843555328,4.688177,-1.786770,0.787350,0.534640,-0.152990,-0.826976,-0.082863,-0.029272
"""


def _poses(n=20, seed=4):
    rng = np.random.default_rng(seed)
    quaternions = np.roll(Rotation.random(n, rng).as_quat(), 1, axis=1)
    return PoseTrajectory(np.sort(rng.uniform(1.7e9, 1.7e9 + 9, n)), rng.normal(0, 3, (n, 3)), quaternions, "random")


def _same_attitude(a, b):
    return np.abs(np.einsum("ni,ni->n", a, b)) == pytest.approx(np.ones(len(a)), abs=1e-9)


@pytest.mark.parametrize("kind", ["tum", "kitti"])
def test_evo_reads_what_we_write(tmp_path, kind):
    _, _, files = evo_modules()
    poses, path = _poses(), tmp_path / f"mine.{kind}"
    write_trajectory(poses, path)
    reader = {"tum": "read_tum_trajectory_file", "kitti": "read_kitti_poses_file"}
    found = getattr(files, reader[kind])(str(path))
    assert np.allclose(found.positions_xyz, poses.positions, atol=1e-12)
    assert _same_attitude(found.orientations_quat_wxyz, poses.quaternions)
    if kind != "kitti":
        assert np.allclose(found.timestamps, poses.times, rtol=0, atol=1e-6)


def test_we_read_what_evo_writes(tmp_path):
    _, _, files = evo_modules()
    poses = _poses()
    write_trajectory(poses, tmp_path / "own.tum")
    theirs = files.read_tum_trajectory_file(str(tmp_path / "own.tum"))
    files.write_tum_trajectory_file(str(tmp_path / "evo.txt"), theirs)
    files.write_kitti_poses_file(str(tmp_path / "poses.txt"), theirs)
    for name, times in (("evo.txt", poses.times), ("poses.txt", np.arange(len(poses)))):
        found = read_trajectory(tmp_path / name)
        assert np.allclose(found.times, times, rtol=0, atol=1e-6)
        assert np.allclose(found.positions, poses.positions, atol=1e-9)
        assert _same_attitude(found.quaternions, poses.quaternions)


def test_a_euroc_ground_truth_is_read_in_seconds(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text(EUROC)
    found = read_trajectory(path)
    assert found.times == pytest.approx([1403636580.8385556, 1403636580.8435553], abs=1e-6)
    assert found.positions[1] == pytest.approx([4.688177, -1.786770, 0.787350])
    assert found.quaternions[0] == pytest.approx([0.534108, -0.153029, -0.827383, -0.082152], abs=1e-4)


def test_rows_out_of_order_are_sorted_with_a_notice_and_kitti_rows_are_counted_with_one(tmp_path):
    (tmp_path / "a.tum").write_text("# a comment\n2 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    found = read_trajectory(tmp_path / "a.tum")
    assert found.times.tolist() == [1.0, 2.0]
    assert "1, by 1 s at most; sorted" in found.notices[0]
    assert "without attitude" in found.notices[1]
    (tmp_path / "a.kitti").write_text("1 0 0 5 0 1 0 6 0 0 1 7\n1 0 0 5 0 1 0 6 0 0 1 8\n")
    assert "have no times" in read_trajectory(tmp_path / "a.kitti").notices[0]


@pytest.mark.parametrize("align", ["se2", "se3", "sim3", "scale"])
@pytest.mark.parametrize("shaking", [0.0, 1e-3])
def test_a_tag_at_rest_is_aligned_by_none_or_origin_alone(align, shaking):
    rng, times = np.random.default_rng(3), np.arange(200) * 0.1
    truth = PoseTrajectory(times, [3.0, 2.0, 1.0] + shaking * rng.normal(size=(200, 3)), None, "truth")
    own = PoseTrajectory(times, truth.positions + 0.05 * rng.normal(size=(200, 3)), None, "own")
    with pytest.raises(UnusableInput, match="do not move with the truth.*use --align none, or origin"):
        compare_trajectories(own, truth, align)
    assert compare_trajectories(own, truth, "origin").pairs == 200
