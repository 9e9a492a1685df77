"""Bags of ROS 1, ROS 2 and MCAP, imported by standard and custom messages, and the presets on their sources."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from tests.bags import ROWS, START, place, write_bag
from tests.in_process import assert_refused_last, trackwright
from trackwright.trackers.recordings.folder import read_recording

RIG = 'format = 1\nname = "hall"\n[anchors]\n17 = [0.0, 0.0, 2.0]\n42 = [5.0, 0.0, 2.0]\n'


pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Bags of each kind, a rig and a mapping of all their topics."""
    folder = tmp_path_factory.mktemp("bags")
    for kind in ("bag", "db3", "mcap"):
        write_bag(folder / ("ros1.bag" if kind == "bag" else f"ros2-{kind}"), kind)
    (folder / "rig.toml").write_text(RIG)
    (folder / "map.toml").write_text(
        """
[[tables]]
table = "ranges"
topic = "/uwb"
columns = { t_s = "header.stamp", tag = "tag", anchor = "ranges[].anchor", range_m = "ranges[].distance_mm in mm" }
[[tables]]
table = "imu"
topic = "/imu"
[[tables]]
table = "truth"
topic = "/vicon/cart"
[[tables]]
table = "fixes"
topic = "/odom"
columns = { x_std_m = "sqrt(pose.covariance[0])", y_std_m = "sqrt(pose.covariance[7])" }
[[tables]]
table = "odometry"
topic = "/odom"
"""
    )
    return folder


@pytest.mark.parametrize("name", ["ros1.bag", "ros2-db3", "ros2-mcap", "ros2-mcap/ros2-mcap.mcap"])
def test_a_bag_becomes_a_recording(bags, tmp_path, name):
    out = tmp_path / "hall"
    how = ("--mapping", bags / "map.toml", "--rig", bags / "rig.toml", "--tag", "cart", "--out", out)
    said = trackwright("import", bags / name, *how)
    assert said.code == 0, said.err
    tables = read_recording(out).tables
    assert {name: len(table) for name, table in tables.items()} == {
        "ranges": 2 * ROWS, "imu": ROWS, "truth": ROWS, "fixes": ROWS, "odometry": ROWS,
    }  # fmt: skip
    ranges = tables["ranges"]
    assert ranges["tag"].unique().to_list() == ["cart"]
    assert ranges["anchor"].to_list()[:2] == ["17", "42"]
    assert ranges["range_m"][1] == pytest.approx(np.linalg.norm(place(0) - (5, 0, 2)))
    times = START + np.arange(ROWS) * 0.1
    for table in (tables["imu"], tables["truth"], tables["fixes"]):
        assert np.allclose(table["t_s"], times, rtol=0, atol=1e-6)
    places = np.stack([place(k) for k in range(ROWS)])
    assert tables["truth"].select("x_m", "y_m", "z_m").to_numpy() == pytest.approx(places)
    assert tables["truth"].select("qw", "qx", "qy", "qz").row(0) == pytest.approx((0.8, 0, 0, 0.6))
    assert tables["imu"].row(0, named=True)["accel_z_mps2"] == pytest.approx(9.81)
    assert tables["imu"].row(0, named=True)["gyro_y_radps"] == pytest.approx(0.2)
    assert tables["fixes"].row(0, named=True)["y_std_m"] == pytest.approx(0.3)
    assert tables["odometry"].row(0, named=True)["speed_mps"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--table", "truth"), ("has no messages", "/vicon/cart (geometry_msgs/msg/PoseStamped, 12)")),
        (("--table", "truth", "--topic", "/vicon/cart"), ("truth needs tag", "--tag ID")),
        (("--table", "ranges", "--topic", "/uwb"), ("uwb_msgs/msg/Ranges", "no standard message", "'range_m=FIELD'")),
        (("--table", "ranges", "--topic", "/uwb", "--columns", "range_m=ranges[].distance"), ("message 1", "no field")),
    ],
)
def test_what_a_bag_does_not_hold_is_refused(bags, tmp_path, arguments, words):
    said = trackwright("import", bags / "ros2-mcap", *arguments, "--out", tmp_path / "x")
    assert said.err.splitlines()[0].startswith(f"{bags / 'ros2-mcap'}: read as ros")
    assert_refused_last(said, *words)
    assert not (tmp_path / "x").exists()


@pytest.fixture
def bag(recordings):
    """The bag of a real walk, beside the recording that was made of it by hand."""
    path = recordings.parent / "recordings-raw" / "isas-walk-1.bag"
    return path if path.is_file() else pytest.skip(f"no bag at {path}")


def test_the_bag_of_isas_walk_1_gives_the_recording_that_was_made_by_hand(bag, recordings, tmp_path):
    out = ("--out", tmp_path / "walk")
    said = trackwright("import", bag, "--mapping", "isas-walk", "--rig", recordings / "isas-walk-1" / "rig.toml", *out)
    assert said.code == 0, said.err
    tables = read_recording(tmp_path / "walk").tables
    for name, file, later in (("ranges", "ranges", 0.0), ("imu", "imu", -0.045), ("fixes", "maker_fixes", 0.0)):
        ids = dict.fromkeys(("tag", "anchor"), pl.String)
        theirs = pl.read_csv(recordings / "isas-walk-1" / f"{file}.csv.gz", schema_overrides=ids)
        mine = tables[name].with_columns(pl.col("t_s") - 1664959673.400324106 + later).select(theirs.columns)
        order = [pl.col("t_s").round(5), *(["anchor"] if name == "ranges" else [])]
        for one, other in zip(mine.sort(order), theirs.sort(order), strict=True):
            if one.dtype == pl.String:
                assert one.equals(other)
            else:
                np.testing.assert_allclose(one, other, atol=1.1e-5)
    # The truth is the tag's, ahead of the tracker on its back and to the right, seen with z up.
    topic = ("--table", "truth", "--topic", "/vive/transform/tracker_1_ref", "--tag", "1", "--out", tmp_path / "raw")
    assert trackwright("import", bag, *topic).code == 0
    raw = read_recording(tmp_path / "raw").tables["truth"].select("x_m", -pl.col("y_m"), -pl.col("z_m")).to_numpy()
    turn = Rotation.from_quat(tables["truth"].select("qw", "qx", "qy", "qz").to_numpy(), scalar_first=True)
    way = turn.inv().apply(tables["truth"].select("x_m", "y_m", "z_m").to_numpy() - raw)
    np.testing.assert_allclose(way, np.tile([0.1, -0.025, 0.0], (len(way), 1)), atol=1e-6)
