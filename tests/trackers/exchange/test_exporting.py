"""`export` of tracks into files of other programs."""

from __future__ import annotations

import math
import sys

import numpy as np
import polars as pl
import pytest

from tests.in_process import assert_refused, trackwright
from trackwright.trackers.exchange.exported_tracks import tracks_of


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """A folder with tracks of two tags, one of which begins without an estimate, as `track` writes them."""
    folder = tmp_path_factory.mktemp("tracked")
    rows = [
        {"recording": "hall 3", "tag": tag, "t_s": 0.1 * k, "x_m": None if k == 0 and tag == "7" else k * 0.2,
         "y_m": 1.0, "z_m": 0.5, "std_x_m": 0.1, "std_y_m": 0.2, "std_z_m": 0.3, "cov_xy_m2": 0.01,
         "status": "waiting" if k == 0 and tag == "7" else "ok"}
        for tag in ("7", "B") for k in range(5)
    ]  # fmt: skip
    pl.DataFrame(rows).write_parquet(folder / "tracks.parquet")
    return folder


def test_several_tracks_are_exported_to_a_file_each(tracked, tmp_path):
    assert trackwright("export", tracked, "--format", "tum", "--out", tmp_path / "tum").code == 0
    assert sorted(path.name for path in (tmp_path / "tum").iterdir()) == ["hall_3-7.tum", "hall_3-B.tum"]
    assert len((tmp_path / "tum" / "hall_3-7.tum").read_text().splitlines()) == 4
    said = trackwright("export", tracked, "--format", "kitti", "--tag", "B", "--out", tmp_path / "b.kitti")
    assert said.code == 0
    assert (tmp_path / "b.times.txt").read_text().splitlines()[1] == "0.1"


def test_a_heading_is_exported_as_the_attitude_of_a_level_body(tracked):
    table = pl.read_parquet(tracked / "tracks.parquet").filter(tag="B")
    heading = np.linspace(-3.0, 3.0, table.height)
    (track,) = tracks_of(table.with_columns(heading_rad=heading))
    w, x, y, z = track.poses.quaternions.T
    assert not np.any([x, y])
    np.testing.assert_allclose(np.arctan2(2 * w * z, 1 - 2 * z * z), heading[-len(w) :], atol=1e-12)


def test_the_csv_twin_has_every_column_and_row(tracked, tmp_path):
    words = "export", tracked, "--format", "csv", "--out", tmp_path / "tracks.csv"
    (tmp_path / "tracks.csv").write_text("precious")
    assert_refused(trackwright(*words), "exists; expected a new file; --force replaces it")
    assert (tmp_path / "tracks.csv").read_text() == "precious"
    assert trackwright(*words, "--force").code == 0
    table = pl.read_parquet(tracked / "tracks.parquet")
    assert pl.read_csv(tmp_path / "tracks.csv", schema_overrides=table.schema).equals(table)


def test_a_ros_2_bag_holds_poses_with_covariances(tracked, tmp_path):
    pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")
    from rosbags.highlevel import AnyReader

    assert trackwright("export", tracked, "--format", "ros2", "--out", tmp_path / "bag").code == 0
    with AnyReader([tmp_path / "bag"]) as reader:
        assert sorted(c.topic for c in reader.connections) == ["/hall_3/B", "/hall_3/tag_7"]
        (own,) = (c for c in reader.connections if c.topic == "/hall_3/B")
        messages = [(t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages([own])]
    assert [t for t, _ in messages] == [0, 100_000_000, 200_000_000, 300_000_000, 400_000_000]
    _, last = messages[-1]
    assert last.pose.pose.position.x == pytest.approx(0.8)
    covariance = last.pose.covariance.reshape(6, 6)
    assert np.allclose(covariance[:3, :3], [[0.01, 0.01, 0], [0.01, 0.04, 0], [0, 0, 0.09]])
    assert last.header.stamp.nanosec == 400_000_000


def test_a_rerun_recording_is_written_and_read_back(tracked, tmp_path):
    reader = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed or old; the extra rerun has it")
    out = tmp_path / "tracks.rrd"
    assert trackwright("export", tracked, "--format", "rrd", "--out", out).code == 0
    entities = {chunk.entity_path: chunk.to_record_batch() for chunk in reader.RrdReader(out).stream()}
    own = entities["/hall\\ 3/tag\\ B/track/position"]
    assert own.column("Points3D:positions")[4].as_py() == [pytest.approx([0.8, 1.0, 0.5])]
    assert own.column("t_s")[4].value == 400_000_000
    shapes = entities["/hall\\ 3/tag\\ B/track/ellipsoid\\ 95\\ \\%"]
    (half_axes,) = shapes.column("Ellipsoids3D:half_sizes")[0].as_py()
    determinant = (0.01 * 0.04 - 0.01**2) * 0.09
    assert np.prod(half_axes) == pytest.approx(math.sqrt(determinant * 7.814728**3), rel=1e-5)


@pytest.mark.parametrize(("format", "package", "extra"), [("ros2", "rosbags", "ros"), ("rrd", "rerun", "rerun")])
def test_a_missing_package_is_named_with_its_extra(tracked, tmp_path, monkeypatch, format, package, extra):
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    said = trackwright("export", tracked, "--format", format, "--out", tmp_path / "out")
    assert_refused(said, f"trackwright[{extra}]")
