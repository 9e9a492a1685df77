"""Presets on rows written as each data set or kit publishes them: what is measured agrees with places and truth."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from tests.in_process import assert_refused_last, trackwright
from trackwright.trackers.recordings.folder import read_recording

ANCHORS = np.array([(3, 3, 1.5), (3, 0, 1), (2, -3, 2), (-2, -3, 1), (-3, 1, 2)])
T = 0.1 * np.arange(6)
BODY = np.stack([np.sin(T), 0.5 * T, 1 + 0.1 * T], axis=1)
W, Z = 0.6, 0.8
"""The attitude of the body, turned about z: its x points to (-0.28, 0.96)."""

OF_UTIL = (-0.01245, 0.00127, 0.0908)
POSES = [(*p, 0.0, 0.0, Z, W) for p in BODY.tolist()]


def _tag(x, y, z):
    """The way (n, 3) of a tag on the body, m."""
    return BODY + np.array([-0.28 * x - 0.96 * y, 0.96 * x - 0.28 * y, z])


def _far(way):
    """The distances (n, 5) to the anchors."""
    return np.linalg.norm(way[:, None] - ANCHORS, axis=2)


def _differences(way):
    """At each time two anchors, A and B, and the distance to B less that to A."""
    return [(k % 5, (k + 1) % 5, far[(k + 1) % 5] - far[k % 5]) for k, far in enumerate(_far(way))]


def _csv(path, header, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def _anchors(path, line):
    path.write_text("".join(line.format(k, *place) for k, place in enumerate(ANCHORS.tolist())))
    return "--rig", path


def _imported(tmp_path, source, preset, *options):
    said = trackwright("import", tmp_path / source, "--mapping", preset, *options, "--out", tmp_path / "hall")
    assert said.code == 0, said.err
    return read_recording(tmp_path / "hall")


def _agrees(recording, rows, truth=None):
    """Whether so many distances to anchors, or differences of them, are those of the truth at their times."""
    (name,) = {"ranges", "tdoa"} & set(recording.tables)
    table = recording.tables[name].with_columns(pl.col("t_s").round(6))
    table = table.join((truth or recording).tables["truth"].with_columns(pl.col("t_s").round(6)), ["t_s", "tag"])
    assert len(table) == len(recording.tables[name]) == rows
    way, anchors = table.select("x_m", "y_m", "z_m").to_numpy(), recording.rig.anchors
    first, *second = (
        np.linalg.norm(way - [anchors[a] for a in table[column]], axis=1)
        for column in (("anchor",) if name == "ranges" else ("anchor", "anchor_2"))
    )
    measured = table["range_m" if name == "ranges" else "range_difference_m"]
    np.testing.assert_allclose(measured, first - sum(second), atol=1e-4)


def test_util_has_streams_of_unequal_length_side_by_side(tmp_path):
    # log_to_csv.py: numbers are floats, and cells after the end of a stream empty.
    header = "t_tdoa,idA,idB,tdoa_meas,t_acc,acc_x,acc_y,acc_z,t_gyro,gyro_x,gyro_y,gyro_z,t_tof,tof,t_flow,deltaX,"
    header += "deltaY,t_baro,baro,t_pose,pose_x,pose_y,pose_z,pose_qx,pose_qy,pose_qz,pose_qw"
    tdoa = [(t, float(a), float(b), d) for t, (a, b, d) in zip(T, _differences(_tag(*OF_UTIL)), strict=True)]
    rows = [(*d, *[0.1] * 15, t, *p) for d, t, p in zip([*tdoa[:4], *[[""] * 4] * 2], T, POSES, strict=True)]
    _csv(tmp_path / "const1-trial1-tdoa2.csv", header, rows)
    lines = "an{0}_p,{1},{2},{3}\nan{0}_quat,0.0,0.0,0.0,1.0\n"
    rig = _anchors(tmp_path / "anchor_const1_survey.txt", lines)
    _agrees(_imported(tmp_path, "const1-trial1-tdoa2.csv", "util", *rig), 4)
    # Without a motion-capture system the card has no pose.
    _csv(tmp_path / "flight.csv", header.partition(",t_pose")[0], [row[:-8] for row in rows])
    said = trackwright("import", tmp_path / "flight.csv", "--mapping", "util", *rig, "--out", tmp_path / "flight")
    assert said.code == 0, said.err
    assert "no truth" in said.err
    assert set(read_recording(tmp_path / "flight").tables) == {"tdoa"}


def test_starloc_has_true_places_of_tags_beside_raw_ranges(tmp_path):
    header = "time_s,to_id,range,from_id,x,y,z,w,rot_x,rot_y,rot_z,tag_pos_x,tag_pos_y,tag_pos_z,bias,gt_range"
    ways = {1: _tag(0.1, 0, 0), 2: _tag(-0.1, 0.1, 0)}
    rows = [
        (T[k] + 0.01 * tag, k % 5, _far(way)[k, k % 5], tag, *BODY[k], W, 0.0, 0.0, Z, *way[k], 0.0, 1.0)
        for k in range(6)
        for tag, way in ways.items()
    ]
    _csv(tmp_path / "loop-2d_s5" / "uwb.csv", header, rows)
    rig = _anchors(tmp_path / "uwb_markers_v3.csv", "{},{},{},{}\n")
    _agrees(_imported(tmp_path, "loop-2d_s5", "starloc", *rig), 12)


def test_miluv_has_tags_on_robots_in_folders(tmp_path):
    # process_uwb.py and cleanup_csv.py: the columns that are read, among others.
    axes = ",".join(f"{kind}.{a}" for kind in ("angular_velocity", "linear_acceleration") for a in "xyz")
    pose = "timestamp,pose.position.x,pose.position.y,pose.position.z," + ",".join(
        f"pose.orientation.{a}" for a in "xyzw"
    )
    for robot, offset in ((1, (0.13189, -0.17245, -0.05249)), (2, (0.16544, -0.15085, -0.03456))):
        folder, far = tmp_path / "exp" / f"ifo00{robot}", _far(_tag(*offset))
        seen = [(far[k, a], 10 * robot, a, -85.1, -84.2, T[k]) for k in range(6) for a in (0, 3)]
        between = [(2.0, 10 * robot, 31, -85.1, -84.2, 0.3)]
        _csv(folder / "uwb_range.csv", "range,from_id,to_id,fpp1,fpp2,timestamp", [*seen, *between])
        _csv(folder / "imu_px4.csv", f"timestamp,{axes}", [(0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 9.8)])
        _csv(folder / "mocap.csv", pose, [(t, *p) for t, p in zip(T, POSES, strict=True)])
    rig = _anchors(tmp_path / "anchors.yaml", '    "{}": "[{}, {}, {}]"\n')
    recording = _imported(tmp_path, "exp", "miluv", *rig)
    _agrees(recording, 24)
    assert recording.rig.bodies == {"ifo001": ("10", "11"), "ifo002": ("20", "21")}
    assert set(recording.rig.tags) == {"10", "11", "20", "21"}
    assert recording.tables["imu"].rows() == [(0.0, tag, 0.4, 0.5, 9.8, 0.1, 0.2, 0.3) for tag in ("10", "20")]
    rig[1].write_text(rig[1].read_text() + '"1":\n    "2": "[9.0, 9.0, 9.0]"\n')
    said = trackwright("import", tmp_path / "exp", "--mapping", "miluv", *rig, "--out", tmp_path / "twice")
    assert_refused_last(said, "anchor 2 at (9.0", "keep one of the set-ups")


@pytest.mark.parametrize("preset", ["crazyflie", "crazyflie-tdoa"])
def test_a_log_of_cfclient_has_a_column_for_each_anchor_or_pair(tmp_path, preset):
    far, twr = _far(_tag(0, 0, 0)), preset == "crazyflie"
    names = [f"ranging.distance{a}" if twr else f"tdoa2.d{a}-{a + 1}" for a in range(4)]
    values = far[:, :4] if twr else far[:, 1:] - far[:, :4]
    rows = [(f"{1000 * t:.0f}", *row) for t, row in zip(T, values, strict=True)]
    _csv(tmp_path / "lps.csv", "Timestamp," + ",".join(names), rows)
    rig = _anchors(tmp_path / "lps.yaml", "{}:\n  x: {}\n  y: {}\n  z: {}\n")
    recording = _imported(tmp_path, "lps.csv", preset, *rig)
    tum = "".join(f"{t} {p[0]} {p[1]} {p[2]} 0 0 0 1\n" for t, p in zip(T, BODY, strict=True))
    (tmp_path / "way.tum").write_text(tum)
    arguments = ("--table", "truth", "--tag", "cf", "--out", tmp_path / "t")
    assert trackwright("import", tmp_path / "way.tum", *arguments).code == 0
    _agrees(recording, 24, read_recording(tmp_path / "t"))
    other = "crazyflie-tdoa" if twr else "crazyflie"
    said = trackwright("import", tmp_path / "lps.csv", "--mapping", other, *rig, "--out", tmp_path / "other")
    assert_refused_last(said, "another mapping? presets: crazyflie, crazyflie-tdoa, ")


DEFINITIONS = {
    "cf_msgs/msg/Tdoa": "std_msgs/Header header\nint32 idA\nint32 idB\nfloat32 data",
    "isas_msgs/msg/RTLSRange": "uint16 id\ngeometry_msgs/Point pos\nfloat32 pr\nfloat32 range\nfloat32 mean\nfloat32 var\n"
    "float32 fpp\nfloat32 rxp\nfloat32 csn\nfloat32 cmn\nuint8 toc\nuint8 ra",
    "isas_msgs/msg/RTLSStick": "std_msgs/Header header\nuint16 id\nuint32 t\ngeometry_msgs/Point pos\n"
    "geometry_msgs/Point mean\ngeometry_msgs/Vector3 hrp\nuint8 noga\nuint8 nora\nisas_msgs/RTLSRange[] ranges",
}


def _bag(path, messages):
    """A ROS 1 bag of messages (s, topic, type, fields), in which fields that are not given are zero."""
    pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))

    def made(kind, given):
        values = {}
        for name, (node, about) in store.fielddefs[kind][1]:
            value = given.get(name, {"NAME": {}, "SEQUENCE": []}.get(node.name, "" if name.endswith("frame_id") else 0))
            if node.name == "NAME":
                value = made(about, value)
            elif node.name != "BASE":
                value = np.zeros(about[1]) if node.name == "ARRAY" else [made(about[0][1], one) for one in value]
            values[name] = value
        return store.types[kind](**values)

    with Writer(path) as writer:
        kinds = {topic: kind for _, topic, kind, _ in messages}
        topics = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for t, topic, kind, fields in messages:
            message = made(kind, {"header": {"stamp": {"sec": 0, "nanosec": round(t * 1e9)}}, **fields})
            writer.write(topics[topic], round(t * 1e9), store.serialize_ros1(message, kind))


def _xyz(*place):
    return dict(zip("xyzw", map(float, place), strict=False))


def test_isas_walks_have_z_down_nested_ranges_and_failed_exchanges(tmp_path):
    messages = [(0.2, "/waveshare_sense_hat_b", "sensor_msgs/msg/Imu", {"linear_acceleration": _xyz(0, 0, 9.9)})]
    down, far = np.array([1, -1, -1]), _far(BODY + [0.1, -0.025, 0])
    for t, p, ranges in zip(T, BODY, far, strict=True):
        seen = [
            {"id": k, "pos": _xyz(*down * ANCHORS[k]), "range": ranges[k] + 9 * (k == 4), "ra": int(k < 4)}
            for k in range(5)
        ]
        stick = {"id": 27956, "pos": _xyz(*down * p), "ranges": seen}
        messages.append((t, "/rtls_flares", "isas_msgs/msg/RTLSStick", stick))
        # The board is level, and the tracker turned half round y on it, seen with z down.
        vive = {"transform": {"translation": _xyz(*down * p), "rotation": _xyz(0, 0, 1, 0)}}
        messages.append((t, "/vive/transform/tracker_1_ref", "geometry_msgs/msg/TransformStamped", vive))
    _bag(tmp_path / "walk.bag", messages)
    recording = _imported(tmp_path, "walk.bag", "isas-walk")
    _agrees(recording, 24)
    np.testing.assert_allclose(recording.tables["fixes"].select("x_m", "y_m", "z_m"), BODY, atol=1e-9)


@pytest.fixture
def bag(recordings):
    """The bag of a real walk, beside the recording that was made of it by hand."""
    pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")
    path = recordings.parent / "recordings-raw" / "isas-walk-1.bag"
    return path if path.is_file() else pytest.skip(f"no bag at {path}")


def test_the_bag_of_isas_walk_1_gives_the_recording_that_was_made_by_hand(bag, recordings, tmp_path):
    tables = _imported(tmp_path, bag, "isas-walk", "--origin", "1664959673.400324106").tables
    for name, file, later in (("ranges", "ranges", 0.0), ("imu", "imu", -0.045), ("fixes", "maker_fixes", 0.0)):
        ids = dict.fromkeys(("tag", "anchor"), pl.String)
        theirs = pl.read_csv(recordings / "isas-walk-1" / f"{file}.csv.gz", schema_overrides=ids)
        mine = tables[name].with_columns(pl.col("t_s") + later).select(theirs.columns)
        order = [pl.col("t_s").round(5), *(["anchor"] if name == "ranges" else [])]
        for one, other in zip(mine.sort(order), theirs.sort(order), strict=True):
            if one.dtype == pl.String:
                assert one.equals(other)
            else:
                np.testing.assert_allclose(one, other, atol=1.1e-5)
