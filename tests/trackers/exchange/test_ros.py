"""Bags of ROS 1, ROS 2 and MCAP that rosbags writes, imported by standard and custom messages."""

from __future__ import annotations

import contextlib
import sqlite3

import numpy as np
import polars as pl
import pytest

from tests.bags import RANGE, ROWS, START, UWB, place, write_bag
from tests.in_process import assert_refused_last, trackwright

RIG = 'format = 1\nname = "hall"\n[anchors]\n17 = [0.0, 0.0, 2.0]\n42 = [5.0, 0.0, 2.0]\n'


@pytest.fixture(autouse=True)
def _rosbags():
    """Skips the tests where rosbags is not installed."""
    pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Bags of each kind, a rig and a mapping of all their topics."""
    pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")
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
    said = trackwright(
        "import", bags / name, "--mapping", bags / "map.toml", "--rig", bags / "rig.toml", "--tag", "cart", "--out", out
    )
    assert said.code == 0, said.err
    tables = {
        name: pl.read_parquet(out / f"{name}.parquet") for name in ("ranges", "imu", "truth", "fixes", "odometry")
    }
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
    assert tables["truth"].select("x_m", "y_m", "z_m").to_numpy() == pytest.approx(
        np.stack([place(k) for k in range(ROWS)])
    )
    assert tables["truth"].select("qw", "qx", "qy", "qz").row(0) == pytest.approx((0.8, 0, 0, 0.6))
    assert tables["imu"].row(0, named=True)["accel_z_mps2"] == pytest.approx(9.81)
    assert tables["imu"].row(0, named=True)["gyro_y_radps"] == pytest.approx(0.2)
    assert tables["fixes"].row(0, named=True)["y_std_m"] == pytest.approx(0.3)
    assert tables["odometry"].row(0, named=True)["speed_mps"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--table", "truth"), ("no --topic", "/vicon/cart (geometry_msgs/msg/PoseStamped, 12)")),
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


def test_types_that_a_bag_does_not_define_are_read_from_msg_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_bag(tmp_path / "old", "db3")
    with contextlib.closing(sqlite3.connect(tmp_path / "old" / "old.db3")) as database:
        database.execute("delete from message_definitions")
        database.commit()
    (tmp_path / "rig.toml").write_text(RIG)
    arguments = (
        "import", "old", "--table", "ranges", "--topic", "/uwb", "--rig", "rig.toml", "--tag", "c", "--out", "hall",
        "--columns", "t_s=header.stamp", "anchor=ranges[].anchor", "range_m=ranges[].distance_mm in mm",
    )  # fmt: skip
    said = trackwright(*arguments)
    assert_refused_last(said, "--messages uwb_msgs/msg/Ranges.msg")
    (tmp_path / "uwb_msgs" / "msg").mkdir(parents=True)
    for name, text in (("Range", RANGE), ("Ranges", UWB)):
        (tmp_path / "uwb_msgs" / "msg" / f"{name}.msg").write_text(text)
    said = trackwright(*arguments, "--messages", "uwb_msgs/msg/Range.msg", "uwb_msgs/msg/Ranges.msg")
    assert said.code == 0, said.err
    assert len(pl.read_parquet("hall/ranges.parquet")) == 2 * ROWS


@pytest.mark.parametrize("name", ["ros1.bag", "ros2-mcap/ros2-mcap.mcap"])
def test_a_broken_bag_is_refused_wherever_it_is_broken(bags, tmp_path, name):
    whole, rng = (bags / name).read_bytes(), np.random.default_rng(6)
    broken, refused = tmp_path / f"broken{(bags / name).suffix}", 0
    (tmp_path / "rig.toml").write_text(RIG)
    for at in rng.integers(20, len(whole) - 20, 25).tolist():
        cut = bool(rng.integers(2))
        broken.write_bytes(whole[:at] if cut else whole[:at] + rng.bytes(12) + whole[at + 12 :])
        arguments = ("--topic", "/vicon/cart", "--table", "truth", "--tag", "c", "--out", tmp_path / f"out-{at}")
        said = trackwright("import", broken, *arguments)
        assert said.code in (0, 2)
        refused += said.code == 2
        if said.code == 2:
            assert said.err.splitlines()[-1].startswith("trackwright: ")
            assert not (tmp_path / f"out-{at}").exists()
    assert refused >= 10
