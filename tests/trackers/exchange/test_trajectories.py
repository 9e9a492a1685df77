"""Pose errors against evo's own on real recordings and against known errors; TUM files; exported tracks."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from tests.in_process import assert_refused, trackwright
from tests.trackers.exchange.against_evo import evo_errors, evo_modules
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.rows import AXES
from trackwright.trackers.exchange.trajectories import (
    associate,
    compare_tracks,
    compare_trajectories,
    read_trajectory,
    write_trajectory,
)
from trackwright.trackers.recordings.columns import QUATERNION
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording

SEEN = "iasl-drone-1", "starloc-fast-s1", "tiers-1tag-01", "rcv-drone-3"
LONG = (pytest.param(name, marks=pytest.mark.slow) for name in SEEN)
RECORDINGS = ("tiers-2tag-03", *LONG)
STEPS = ("1m", "10f")
CASES = (("none", 0.01, 0.0), ("se3", 0.01, 0.0), ("sim3", 0.02, -0.3), ("scale", 0.01, 0.0), ("origin", 0.02, -0.3))


def _table(times, places, attitude=None):
    """A table of poses."""
    columns = {"t_s": times} | dict(zip(AXES, np.transpose(places), strict=True))
    if attitude is not None:
        columns |= dict(zip(QUATERNION, attitude.as_quat(scalar_first=True).T, strict=True))
    return pl.DataFrame(columns)


def _of_recording(folder):
    """An estimate and the truth of the first tag: the maker's fixes, or the truth with drift, noise and a turned frame."""
    recording = read_recording(folder)
    truth = recording.tables["truth"].filter(tag=recording.tables["truth"]["tag"][0])
    if "fixes" in recording.tables:
        return recording.tables["fixes"].filter(tag=truth["tag"][0])[::2], truth.drop(QUATERNION, strict=False)
    rng, rows = np.random.default_rng(5), truth[::6]
    drift = np.cumsum(rng.normal(0, 0.003, (len(rows), 3)), axis=0)
    turn = Rotation.from_euler("zyx", (40.0, 5.0, -3.0), degrees=True)
    truth = truth if "qw" in truth.columns else truth.with_columns(qw=1.0, qx=1e-9, qy=0.0, qz=0.0)
    given = Rotation.from_quat(truth.select(QUATERNION).to_numpy()[::6], scalar_first=True)
    attitude = turn * given * Rotation.from_rotvec(rng.normal(0, 0.03, (len(rows), 3)))
    times = np.sort(rows["t_s"].to_numpy() + rng.uniform(-0.004, 0.004, len(rows)))
    return _table(times, 1.07 * turn.apply(rows.select(AXES).to_numpy() + drift) + (3.0, -2.0, 0.4), attitude), truth


@pytest.mark.parametrize("name", RECORDINGS)
def test_pose_errors_equal_those_of_evo_on_real_recordings(recordings, tmp_path, name):
    for table, file in zip(_of_recording(recordings / name), ("own.tum", "true.tum"), strict=True):
        write_trajectory(table, tmp_path / file)
    own, true = (read_trajectory(tmp_path / file)[0] for file in ("own.tum", "true.tum"))
    attitudes, compared = "qw" in own.columns, 0
    for align, tolerance, offset in CASES:
        files = tmp_path / "own.tum", tmp_path / "true.tum"
        expected, poses = evo_errors(*files, align, tolerance, offset, STEPS)
        found = compare_trajectories(own, true, align, offset, tolerance, STEPS)
        assert found.pairs == poses
        ours = {"ape": found.ape_m}
        if attitudes:
            ours |= {"ape rad": found.ape_rad} | {f"rpe {step} rad": found.rpe_rad[step] for step in STEPS}
        # Without attitudes evo compares the displacements of a turned track in its own frame, we in that of the truth.
        if attitudes or align not in ("se3", "sim3"):
            ours |= {f"rpe {step}": found.rpe_m[step] for step in STEPS}
        for error, values in ours.items():
            # evo's angles are arc cosines, which lose half of the digits near zero.
            exact = 1e-7 if error.endswith("rad") else 1e-9
            for statistic, value in expected[error].items():
                assert values[statistic] == pytest.approx(value, abs=exact, rel=exact), (align, error, statistic)
                compared += 1
    assert compared >= 60


TIMES = np.arange(400) * 0.05
PLACES = [3 * np.cos(0.7 * TIMES), 2 * np.sin(0.9 * TIMES), 0.3 * np.sin(0.4 * TIMES) + 1]
SPIRAL = _table(TIMES, np.stack(PLACES, axis=1))


@pytest.mark.parametrize(("align", "scale"), [("se2", 1.0), ("se3", 1.0), ("sim3", 1.3)])
def test_a_turned_and_shifted_trajectory_is_aligned_to_no_error(align, scale):
    euler, up = ((0.8, 0.0, 0.0), 0.0) if align == "se2" else ((0.8, 0.3, -0.2), 2.0)
    moved = scale * Rotation.from_euler("zyx", euler).apply(SPIRAL.select(AXES).to_numpy()) + (4.0, -1.0, up)
    found = compare_trajectories(_table(TIMES, moved), SPIRAL, align)
    assert found.ape_m["max"] < 1e-9
    assert found.alignment.scale == pytest.approx(1 / scale)
    assert found.rpe_m["1s"]["max"] < 1e-9


def test_each_estimate_takes_the_nearest_truth_and_without_heights_errors_are_in_the_plane():
    assert [rows.tolist() for rows in associate(np.array([0.0, 0.004]), np.array([0.0, 1.0]))] == [[0, 1], [0, 0]]
    flat = SPIRAL.with_columns(pl.col("x_m") + 0.3, pl.col("y_m") + 0.4, z_m=None)
    found = compare_trajectories(flat, SPIRAL)
    assert found.planar
    assert found.ape_m["rmse"] == pytest.approx(0.5)
    # No pose within 0.01 s: within half a step, rounded up.
    between = compare_trajectories(SPIRAL.with_columns(pl.col("t_s") + 0.02), SPIRAL)
    assert (between.pairs, between.time_tolerance_s) == (400, 0.026)


LINE = _table(TIMES[:5], np.outer(np.arange(5), [1.0, 0, 0]))
STILL = "do not move with the truth.*use --align none, or origin"


@pytest.mark.parametrize(
    ("own", "options", "words"),
    [
        (SPIRAL.with_columns(pl.col("t_s") + 99.0), {}, "no pose lies near in time.*with -99 both begin together"),
        (SPIRAL.with_columns(pl.col("t_s") * 1000 + 7e4), {}, "looks like another unit of time; convert it to seconds"),
        (LINE, {"align": "se3"}, "on a line"),
        (SPIRAL, {"align": "twist"}, "expected one of"),
        (SPIRAL.drop("z_m"), {"align": "se3"}, "has no height"),
        (SPIRAL.clear(), {}, "own: no pose"),
        (SPIRAL.with_columns(qw=0.0, qx=0.0, qy=0.0, qz=0.0), {}, "own: pose 1 has no quaternion of length 1"),
        (SPIRAL, {"rpe": ("3",)}, "such as 1m"),
        (SPIRAL, {"tolerance": -1.0}, "zero or more"),
        *((SPIRAL, {"align": align, "rest": True}, STILL) for align in ("se2", "se3", "sim3", "scale")),
    ],
)
def test_what_cannot_be_compared_is_refused(own, options, words):
    truth, rng = SPIRAL, np.random.default_rng(3)
    if options.pop("rest", False):
        # A tag at rest whose truth shakes by a millimetre.
        places = [3.0, 2.0, 1.0] + 1e-3 * rng.normal(size=(400, 3))
        own, truth = (_table(TIMES, places + noise * rng.normal(size=(400, 3))) for noise in (0.05, 0.0))
        assert compare_trajectories(own, truth, "origin").pairs == 400
    with pytest.raises(UnusableInput, match=words):
        compare_trajectories(own, truth, **options, name="own")


def test_evo_reads_what_we_write_and_we_what_evo_writes(tmp_path):
    _, _, files = evo_modules()
    rng = np.random.default_rng(4)
    attitude, times = Rotation.random(20, rng), np.sort(rng.uniform(1.7e9, 1.7e9 + 9, 20))
    poses = _table(times, rng.normal(0, 3, (20, 3)), attitude)
    theirs = files.read_tum_trajectory_file(str(write_trajectory(poses, tmp_path / "mine.tum")))
    np.testing.assert_array_equal(theirs.positions_xyz, poses.select(AXES))
    np.testing.assert_array_equal(theirs.timestamps, times)
    files.write_tum_trajectory_file(str(tmp_path / "evo.txt"), theirs)
    back, _ = read_trajectory(tmp_path / "evo.txt")
    np.testing.assert_allclose(back.select("t_s", *AXES), poses.select("t_s", *AXES), rtol=0, atol=1e-6)
    again = Rotation.from_quat(back.select(QUATERNION).to_numpy(), scalar_first=True)
    assert (again * attitude.inv()).magnitude().max() < 1e-7


def test_rows_out_of_order_are_sorted_with_a_notice(tmp_path):
    (tmp_path / "a.tum").write_text("# a comment\n2 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    found, notices = read_trajectory(tmp_path / "a.tum")
    assert found["t_s"].to_list() == [1.0, 2.0]
    lines = (f"{t} {t} 0 0 0 0 0 1\n" for t in (*range(20), *np.arange(0.25, 19)))
    (tmp_path / "b.tum").write_text("".join(lines))
    with pytest.raises(UnusableInput, match=r"pose 21: 0\.250 s after 19\.000 s: the clock went back"):
        read_trajectory(tmp_path / "b.tum")
    assert "1; sorted" in notices[1]
    assert "without attitude" in notices[0]


def test_columns_without_use_are_named_and_a_row_without_a_time_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("t_s,x_m,y_m,note\n0,1,2,walk\n1,1,2,\n")
    found, notices = read_trajectory(tmp_path / "a.csv")
    assert (found.columns, notices) == (["t_s", "x_m", "y_m"], ["columns not used: note"])
    (tmp_path / "a.csv").write_text("t_s,x_m,y_m\n0,1,2\n,1,2\n")
    with pytest.raises(UnusableInput, match=r"row 2 \(line 3\), column t_s: empty"):
        read_trajectory(tmp_path / "a.csv")


@pytest.mark.parametrize("align", ["none", "se2", "origin"])
def test_a_track_without_a_truth_is_counted_beside_one_that_has_it(align):
    each = pl.DataFrame({"tag": ["1", "2"]})
    tracks = SPIRAL.with_columns(recording=pl.lit("room"), std_x_m=0.1).join(each, how="cross")
    truths = {"truth": tracks.filter(tag="1").drop("recording", "std_x_m")}
    _, compared, evaluation = compare_tracks(tracks, [RecordingFolder("room", None, Rig("room"), truths)], align)
    assert [one.tag for one in compared] == ["1"]
    assert (evaluation.overall["n"], evaluation.overall["n_no_truth"]) == (400, 400)


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """A folder with tracks of two tags, one of which begins without an estimate, as `track` writes them."""
    folder = tmp_path_factory.mktemp("tracked")
    rows = [
        {"recording": "hall 3", "tag": tag, "t_s": 0.1 * k, "x_m": None if k == 0 and tag == "7" else k * 0.2,
         "y_m": 1.0, "z_m": 0.5, "status": "waiting" if k == 0 and tag == "7" else "ok"}
        for tag in ("7", "B") for k in range(5)
    ]  # fmt: skip
    pl.DataFrame(rows).write_parquet(folder / "tracks.parquet")
    return folder


def test_one_track_is_exported_to_a_file(tracked, tmp_path):
    words = "export", tracked, "--format", "tum", "--out", tmp_path / "b.tum"
    assert_refused(trackwright(*words), "expected the positions of one track; choose it by --tag")
    assert trackwright(*words, "--tag", "7").code == 0
    assert len((tmp_path / "b.tum").read_text().splitlines()) == 4


def test_the_csv_twin_has_every_column_and_row(tracked, tmp_path):
    words = "export", tracked, "--format", "csv", "--out", tmp_path / "tracks.csv"
    (tmp_path / "tracks.csv").write_text("precious")
    assert_refused(trackwright(*words), "exists; expected a new file; --force replaces it")
    assert (tmp_path / "tracks.csv").read_text() == "precious"
    assert trackwright(*words, "--force").code == 0
    table = pl.read_parquet(tracked / "tracks.parquet")
    assert pl.read_csv(tmp_path / "tracks.csv", schema_overrides=table.schema).equals(table)
