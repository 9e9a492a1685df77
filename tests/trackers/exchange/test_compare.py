"""Pose errors against evo's own on real recordings, and on trajectories whose errors are known."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from tests.trackers.exchange.against_evo import evo_errors
from trackwright.trackers.core.data.consistency import nees
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.rows import covariances
from trackwright.trackers.exchange.pose_errors import associate, compare_trajectories
from trackwright.trackers.exchange.trajectories import (
    PoseTrajectory,
    Similarity,
    read_trajectory,
    trajectory_of_table,
    write_trajectory,
)
from trackwright.trackers.recordings.folder import read_recording

RECORDINGS = ("tiers-1tag-01", "tiers-2tag-03", "iasl-drone-1", "starloc-fast-s1", "rcv-drone-3")
STEPS = ("1m", "10f")
CASES = (("none", 0.01, 0.0, False), ("se3", 0.01, 0.0, False), ("sim3", 0.02, -0.3, False), ("scale", 0.01, 0.0, True),
         ("origin", 0.02, -0.3, False))  # fmt: skip


def _of_recording(folder, kind):
    """An estimate and the truth of the first tag: the maker's fixes, or the truth with drift, noise and a turned frame."""
    recording = read_recording(folder)
    table = recording.tables["truth"]
    tag = table["tag"][0]
    truth = trajectory_of_table(table.filter(pl.col("tag") == tag), "truth")
    if kind == "fixes":
        fixes = recording.tables["fixes"].filter(pl.col("tag") == tag)[::2]
        return trajectory_of_table(fixes, "fixes"), PoseTrajectory(truth.times, truth.positions, None, "truth")
    rng = np.random.default_rng(5)
    rows = np.arange(0, len(truth), 6)
    drift = np.cumsum(rng.normal(0, 0.003, (len(rows), 3)), axis=0)
    turn = Rotation.from_euler("zyx", (40.0, 5.0, -3.0), degrees=True)
    places = 1.07 * turn.apply(truth.positions[rows] + drift) + (3.0, -2.0, 0.4)
    given = truth.quaternions if truth.quaternions is not None else np.tile([1.0, 0, 0, 0], (len(truth), 1))
    attitude = (
        turn
        * Rotation.from_quat(np.roll(given[rows], -1, axis=1))
        * Rotation.from_rotvec(rng.normal(0, 0.03, (len(rows), 3)))
    )
    times = truth.times[rows] + rng.uniform(-0.004, 0.004, len(rows))
    own = PoseTrajectory(np.sort(times), places, np.roll(attitude.as_quat(), 1, axis=1), "own")
    return own, PoseTrajectory(truth.times, truth.positions, given + 0.0, "truth")


@pytest.mark.parametrize("name", RECORDINGS)
def test_pose_errors_equal_those_of_evo_on_real_recordings(recordings, tmp_path, name):
    kind = "fixes" if name.startswith(("tiers", "iasl")) else "drift"
    for trajectory, file in zip(_of_recording(recordings / name, kind), ("own.tum", "true.tum"), strict=True):
        write_trajectory(trajectory, tmp_path / file)
    own, true = read_trajectory(tmp_path / "own.tum"), read_trajectory(tmp_path / "true.tum")
    attitudes = own.quaternions is not None
    compared = 0
    for align, tolerance, offset, all_pairs in CASES:
        expected, poses = evo_errors(
            tmp_path / "own.tum", tmp_path / "true.tum", align, tolerance, offset, STEPS, all_pairs
        )
        found = compare_trajectories(own, true, align, offset, tolerance, STEPS, all_pairs)
        assert found.pairs == poses
        ours = {"ape": found.ape_m}
        if attitudes:
            ours |= {"ape rad": found.ape_rad} | {f"rpe {step} rad": found.rpe_rad[step] for step in STEPS}
        # Without attitudes evo compares the displacements of a turned track in its own frame, we in that of the truth.
        if attitudes or align not in ("se3", "sim3"):
            ours |= {f"rpe {step}": found.rpe_m[step] for step in STEPS}
        for error, values in ours.items():
            for statistic, value in expected[error].items():
                assert values[statistic] == pytest.approx(value, abs=1e-6, rel=1e-6), (align, error, statistic)
                compared += 1
    assert compared >= 60


def _spiral(n=400, dt=0.05):
    times = np.arange(n) * dt
    places = np.stack([3 * np.cos(0.7 * times), 2 * np.sin(0.9 * times), 0.3 * np.sin(0.4 * times) + 1], axis=1)
    return PoseTrajectory(times, places, None, "truth")


@pytest.mark.parametrize(("align", "scale"), [("se2", 1.0), ("se3", 1.0), ("sim3", 1.3)])
def test_a_turned_and_shifted_trajectory_is_aligned_to_no_error(align, scale):
    truth = _spiral()
    euler = (0.8, 0.0, 0.0) if align == "se2" else (0.8, 0.3, -0.2)
    shift = np.array([4.0, -1.0, 0.0 if align == "se2" else 2.0])
    moved = scale * Rotation.from_euler("zyx", euler).apply(truth.positions) + shift
    found = compare_trajectories(PoseTrajectory(truth.times, moved, None, "own"), truth, align)
    assert found.ape_m["max"] < 1e-9
    assert found.similarity.scale == pytest.approx(1 / scale)
    assert found.rpe_m["1s"]["max"] < 1e-9
    assert found.speed_mps["max"] < 1e-9


def test_speed_errors_are_those_of_a_trajectory_that_is_played_too_fast():
    truth = PoseTrajectory(np.arange(100) * 0.1, np.outer(np.arange(100) * 0.1, [1.0, 0.0, 0.0]), None, "truth")
    own = PoseTrajectory(truth.times, 1.2 * truth.positions, None, "own")
    assert compare_trajectories(own, truth).speed_mps["bias"] == pytest.approx(0.2)


@pytest.mark.parametrize("offset", [0.37, -2.5, 1000.0])
@pytest.mark.parametrize("align", ["none", "se3"])
def test_a_time_offset_is_found_again(offset, align):
    truth, rng = _spiral(), np.random.default_rng(1)
    places = truth.positions + rng.normal(0, 0.02, truth.positions.shape)
    if align == "se3":
        places = Rotation.from_euler("zyx", (0.8, 0.3, -0.2)).apply(places) + 1.0
    own = PoseTrajectory(truth.times - offset, places, None, "own")
    assert compare_trajectories(own, truth, align, "auto", 0.03).time_offset == pytest.approx(offset, abs=0.005)


@pytest.mark.parametrize(
    ("own", "options", "words"),
    [
        (PoseTrajectory(np.arange(5) + 99.0, np.eye(5, 3), None, "own"), {}, "no pose lies within 0.01 s"),
        (
            PoseTrajectory(np.arange(5) * 0.05, np.outer(np.arange(5), [1.0, 0, 0]), None, "own"),
            {"align": "se3"},
            "line",
        ),
        (_spiral(), {"align": "twist"}, "expected one of"),
        (_spiral(), {"rpe": ("3",)}, "such as 1m"),
        (_spiral(), {"tolerance": -1.0}, "zero or more"),
        (PoseTrajectory(np.arange(99) * 0.1, np.ones((99, 3)), None, "own"), {"time_offset": "auto"}, "no time offset"),
    ],
)
def test_what_cannot_be_compared_is_refused(own, options, words):
    with pytest.raises(UnusableInput, match=words):
        compare_trajectories(own, _spiral(), **options)


def test_of_trajectories_of_one_length_each_estimate_takes_the_nearest_truth():
    estimate, truth = (PoseTrajectory(np.array(t), np.zeros((2, 3)), None, "") for t in ([0.0, 0.004], [0.0, 1.0]))
    assert [rows.tolist() for rows in associate(estimate, truth)] == [[0, 1], [0, 0]]


def test_trajectories_without_height_are_compared_in_the_plane():
    truth = _spiral()
    flat = PoseTrajectory(truth.times, truth.positions * [1, 1, np.nan] + [0.3, 0.4, 0], None, "own")
    found = compare_trajectories(flat, truth)
    assert found.planar
    assert found.ape_m["rmse"] == pytest.approx(0.5)


def test_a_turn_about_the_vertical_turns_every_covariance():
    """Against the map of three dimensions, and by the NEES of draws from the covariance itself."""
    rng, rows = np.random.default_rng(5), 4000
    root = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [0.15, -0.1, 0.25]])
    error, cov = rng.normal(size=(rows, 3)) @ root.T, root @ root.T
    names = {(0, 1): "cov_xy_m2", (0, 2): "cov_xz_m2", (1, 2): "cov_yz_m2"}
    table = pl.DataFrame(
        {f"{a}_m": error[:, k] for k, a in enumerate("xyz")}
        | {f"std_{a}_m": np.full(rows, np.sqrt(cov[k, k])) for k, a in enumerate("xyz")}
        | {name: np.full(rows, cov[ij]) for ij, name in names.items()}
    )
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    flat = Similarity(turn, np.zeros(3), flat=True).table(table)
    for name in (*names.values(), "std_x_m", "std_y_m", "std_z_m"):
        np.testing.assert_allclose(flat[name], Similarity(turn, np.zeros(3)).table(table)[name], atol=1e-12)
    moved = np.stack([flat[f"{a}_m"] for a in "xyz"], axis=1)
    assert nees(moved, covariances(flat)).mean() / 3 == pytest.approx(1.0, abs=0.05)
    # A height without a variance leaves the others as they are.
    unknown = table.with_columns(
        pl.lit(None, pl.Float64).alias(n) for n in ("z_m", "std_z_m", "cov_xz_m2", "cov_yz_m2")
    )
    assert Similarity(turn, np.zeros(3), flat=True).table(unknown)["cov_xy_m2"].equals(flat["cov_xy_m2"])
