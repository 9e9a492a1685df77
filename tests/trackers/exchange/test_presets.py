"""Presets on rows written as each data set or kit publishes them: what is measured agrees with places and truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.in_process import assert_refused_last, trackwright
from trackwright.trackers.exchange.mapping_file import PRESETS
from trackwright.trackers.recordings.folder import read_recording

ANCHORS = {
    str(k): np.array(place) for k, place in enumerate([(3, 3, 1.5), (3, 0, 1), (2, -3, 2), (-2, -3, 1), (-3, 1, 2)])
}
TIMES = 0.1 * np.arange(6)
BODY = np.stack([np.sin(TIMES), 0.5 * TIMES, 1 + 0.1 * TIMES], axis=1)
TURN = (0.6, 0.0, 0.0, 0.8)
"""The attitude of the body, w, x, y, z: turned about z, x to (-0.28, 0.96)."""


def _tag(offset):
    """The way (n, 3) of a tag on the body, m."""
    (x, y, z), (c, s) = offset, (-0.28, 0.96)
    return BODY + np.array([c * x - s * y, s * x + c * y, z])


def _imported(tmp_path, source, preset, *options):
    said = trackwright("import", tmp_path / source, "--mapping", preset, *options, "--out", tmp_path / "hall")
    assert said.code == 0, said.err
    return read_recording(tmp_path / "hall")


def _agrees(recording, rows, tolerance=1e-4):
    """Whether so many readings of distances, or of their differences, are those of the truth to the anchors."""
    (name,) = {"ranges", "tdoa"} & set(recording.tables)
    columns = {"ranges": ("anchor",), "tdoa": ("anchor", "anchor_2")}[name]
    table = recording.tables[name].join(recording.tables["truth"], ["t_s", "tag"])
    way = table.select("x_m", "y_m", "z_m").to_numpy()
    far = [np.linalg.norm(way - [recording.rig.anchors[a] for a in table[column]], axis=1) for column in columns]
    assert len(table) == len(recording.tables[name]) == rows
    values = table["range_m" if name == "ranges" else "range_difference_m"]
    np.testing.assert_allclose(values, far[0] - (far[1] if far[1:] else 0), atol=tolerance)


def _differences(way):
    """Pairs A, B of neighbours and the distance to B less that to A, at each time."""
    for k, place in enumerate(way):
        a, b = str(k % 5), str((k + 1) % 5)
        yield k, a, b, np.linalg.norm(place - ANCHORS[b]) - np.linalg.norm(place - ANCHORS[a])


def _survey(path):
    """UTIL's anchors, of anchor_survey.py: positions, then orientations."""
    lines = [f"an{a}_p,{x},{y},{z}" for a, (x, y, z) in ANCHORS.items()] + [
        f"an{a}_quat,0.0,0.0,0.0,1.0" for a in ANCHORS
    ]
    path.write_text("\n".join(lines) + "\n")


def test_util_has_streams_of_unequal_length_side_by_side(tmp_path):
    # log_to_csv.py: numbers are floats, and cells after the end of a stream empty.
    header = (
        "t_tdoa,idA,idB,tdoa_meas,t_acc,acc_x,acc_y,acc_z,t_gyro,gyro_x,gyro_y,gyro_z,t_tof,tof,t_flow,deltaX,deltaY,"
    )
    header += "t_baro,baro,t_pose,pose_x,pose_y,pose_z,pose_qx,pose_qy,pose_qz,pose_qw"
    lines = [f"{TIMES[k]},{a}.0,{b}.0,{d}" for k, a, b, d in _differences(_tag((-0.01245, 0.00127, 0.0908)))]
    w, x, y, z = TURN
    poses = [f"{t},{p[0]},{p[1]},{p[2]},{x},{y},{z},{w}" for t, p in zip(TIMES, BODY, strict=True)]
    rest = "0.1,0.0,0.0,1.0,0.1,0.0,0.0,0.0,0.1,0.5,0.1,0.0,0.0,0.1,80.0"
    rows = [f"{line},{rest},{pose}" for line, pose in zip([*lines[:4], ",,,", ",,,"], poses, strict=True)]
    (tmp_path / "const1.csv").write_text("\n".join([header, *rows]) + "\n")
    _survey(tmp_path / "anchor_const1_survey.txt")
    _agrees(_imported(tmp_path, "const1.csv", "util", "--rig", tmp_path / "anchor_const1_survey.txt"), 4)


def test_starloc_has_true_places_of_tags_beside_raw_ranges(tmp_path):
    ways = {"1": _tag((0.1, 0, 0)), "2": _tag((-0.1, 0.1, 0))}
    header = "time_s,to_id,range,from_id,x,y,z,w,rot_x,rot_y,rot_z,tag_pos_x,tag_pos_y,tag_pos_z,bias,gt_range\n"
    lines = []
    for k, t in enumerate(TIMES):
        for tag, way in ways.items():
            a, (x, y, z) = str(k % 5), way[k]
            d = np.linalg.norm(way[k] - ANCHORS[a])
            lines.append(f"{t + 0.01 * int(tag)},{a},{d},{tag},0,0,0,0.6,0.0,0.0,0.8,{x},{y},{z},0.0,{d}\n")
    (tmp_path / "loop").mkdir()
    (tmp_path / "loop" / "uwb.csv").write_text(header + "".join(lines))
    places = "".join(f"{a},{x},{y},{z}\n" for a, (x, y, z) in ANCHORS.items())
    (tmp_path / "uwb_markers_v3.csv").write_text(",x,y,z\n" + places)
    _agrees(_imported(tmp_path, "loop", "starloc", "--rig", tmp_path / "uwb_markers_v3.csv"), 12)


def test_miluv_has_tags_on_robots_in_folders(tmp_path):
    # process_uwb.py and cleanup_csv.py, of the columns that are read, among others.
    offsets = {"1": (0.13189, -0.17245, -0.05249), "2": (0.16544, -0.15085, -0.03456)}
    w, x, y, z = TURN
    for robot, offset in offsets.items():
        folder = tmp_path / "exp" / f"ifo00{robot}"
        folder.mkdir(parents=True)
        rows = [
            f"{np.linalg.norm(p - ANCHORS['3'])},{robot}0,3,-85.1,-84.2,{t}\n{9.9},{robot}0,31,-85.1,-84.2,{t}\n"
            for t, p in zip(TIMES, _tag(offset), strict=True)
        ]
        (folder / "uwb_range.csv").write_text("range,from_id,to_id,fpp1,fpp2,timestamp\n" + "".join(rows))
        axes = [f"{kind}.{a}" for kind in ("angular_velocity", "linear_acceleration") for a in "xyz"]
        (folder / "imu_px4.csv").write_text(f"timestamp,{','.join(axes)}\n0.0,0.1,0.2,0.3,0.4,0.5,9.8\n")
        pose = [f"pose.position.{a}" for a in "xyz"] + [f"pose.orientation.{a}" for a in "xyzw"]
        rows = [f"{t},{p[0]},{p[1]},{p[2]},{x},{y},{z},{w}\n" for t, p in zip(TIMES, BODY, strict=True)]
        (folder / "mocap.csv").write_text(f"timestamp,{','.join(pose)}\n" + "".join(rows))
    places = "".join(f'    "{a}": "[{float(x)}, {float(y)}, {float(z)}]"\n' for a, (x, y, z) in ANCHORS.items())
    (tmp_path / "anchors.yaml").write_text(f'"0":\n{places}')
    recording = _imported(tmp_path, "exp", "miluv", "--rig", tmp_path / "anchors.yaml")
    _agrees(recording, 12)
    assert recording.tables["imu"].rows() == [(0.0, tag, 0.4, 0.5, 9.8, 0.1, 0.2, 0.3) for tag in ("10", "20")]
    (tmp_path / "anchors.yaml").write_text(f'"0":\n{places}"1":\n    "2": "[9.0, 9.0, 9.0]"\n')
    arguments = ("--mapping", "miluv", "--rig", tmp_path / "anchors.yaml", "--out", tmp_path / "twice")
    assert_refused_last(
        trackwright("import", tmp_path / "exp", *arguments), "anchor 2 at (9.0", "keep one of the set-ups"
    )


@pytest.mark.parametrize(("preset", "table"), [("crazyflie", "ranges"), ("crazyflie-tdoa", "tdoa")])
def test_a_log_of_cfclient_has_a_column_for_each_anchor_or_pair(tmp_path, preset, table):
    way = _tag((0, 0, 0))
    far = np.stack([np.linalg.norm(way - place, axis=1) for place in ANCHORS.values()], axis=1)
    names = (
        [f"ranging.distance{a}" for a in range(4)] if table == "ranges" else [f"tdoa2.d{a}-{a + 1}" for a in range(4)]
    )
    values = far[:, :4] if table == "ranges" else far[:, 1:] - far[:, :4]
    rows = [f"{1000 * t + 5000:.0f},{','.join(map(str, row))}" for t, row in zip(TIMES, values, strict=True)]
    (tmp_path / "lps.csv").write_text(f"Timestamp,{','.join(names)}\n" + "\n".join(rows) + "\n")
    places = "".join(f"{a}:\n  x: {float(x)}\n  y: {float(y)}\n  z: {float(z)}\n" for a, (x, y, z) in ANCHORS.items())
    (tmp_path / "lps.yaml").write_text(places)
    recording = _imported(tmp_path, "lps.csv", preset, "--rig", tmp_path / "lps.yaml")
    truth = pl.DataFrame({"t_s": TIMES + 5, "tag": "cf", **dict(zip(("x_m", "y_m", "z_m"), way.T, strict=True))})
    near = [one.with_columns(pl.col("t_s").round(3)) for one in (recording.tables[table], truth)]
    _agrees(replace(recording, tables={table: near[0], "truth": near[1]}), 24)


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
            one = given.get(name)
            if node.name == "NAME":
                one = made(about, one or {})
            elif node.name == "SEQUENCE":
                one = [made(about[0][1], part) for part in one]
            elif node.name == "ARRAY":
                one = np.zeros(about[1])
            values[name] = ("" if about == ("string", 0) else 0) if one is None else one
        return store.types[kind](**values)

    with Writer(path) as writer:
        kinds = {topic: kind for _, topic, kind, _ in messages}
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for t, topic, kind, fields in messages:
            stamp = {"sec": int(t), "nanosec": round((t - int(t)) * 1e9)}
            message = made(kind, {"header": {"stamp": stamp}, **fields})
            writer.write(connections[topic], round(t * 1e9), store.serialize_ros1(message, kind))


def _xyz(place):
    return dict(zip("xyz", map(float, place), strict=True))


def test_util_bags_have_units_of_the_crazyflie(tmp_path):
    pose = "geometry_msgs/msg/PoseWithCovarianceStamped"
    turn = {"orientation": {**_xyz(TURN[1:]), "w": TURN[0]}}
    messages = [
        (t, "/pose_data", pose, {"pose": {"pose": {"position": _xyz(p), **turn}}})
        for t, p in zip(TIMES, BODY, strict=True)
    ]
    for k, a, b, d in _differences(_tag((-0.01245, 0.00127, 0.0908))):
        messages.append((TIMES[k], "/tdoa_data", "cf_msgs/msg/Tdoa", {"idA": int(a), "idB": int(b), "data": d}))
    imu = {"linear_acceleration": _xyz((0, 0, 1)), "angular_velocity": _xyz((180, 0, 0))}
    _bag(tmp_path / "const1.bag", [*messages, (0.2, "/imu_data", "sensor_msgs/msg/Imu", imu)])
    _survey(tmp_path / "survey.txt")
    recording = _imported(tmp_path, "const1.bag", "util-bag", "--rig", tmp_path / "survey.txt")
    _agrees(recording, 6)
    assert recording.tables["imu"].rows()[0] == pytest.approx((0.2, "cf", 0, 0, 9.80665, np.pi, 0, 0))


def test_isas_walks_have_z_down_nested_ranges_and_failed_exchanges(tmp_path):
    flip = np.array([1, -1, -1])
    # The tracker is turned half round y against the board: q of the bag is q of the board, in a frame with z down, ∘ j.
    rotation = {"w": 0.0, "x": 0.0, "y": 0.0, "z": 1.0}
    messages = []
    for t, p in zip(TIMES, BODY, strict=True):
        seen = [
            {
                "id": int(a),
                "pos": _xyz(flip * place),
                "range": np.linalg.norm(p + (0.1, -0.025, 0) - place),
                "ra": int(a != "4"),
            }
            for a, place in ANCHORS.items()
        ]
        stick = {"id": 27956, "pos": _xyz(flip * p), "ranges": seen}
        messages.append((t, "/rtls_flares", "isas_msgs/msg/RTLSStick", stick))
        vive = {"transform": {"translation": _xyz(flip * p), "rotation": rotation}}
        messages.append((t, "/vive/transform/tracker_1_ref", "geometry_msgs/msg/TransformStamped", vive))
    gravity = {"linear_acceleration": _xyz((0.1, 0.2, 9.9))}
    _bag(tmp_path / "walk.bag", [*messages, (0.2, "/waveshare_sense_hat_b", "sensor_msgs/msg/Imu", gravity)])
    recording = _imported(tmp_path, "walk.bag", "isas-walk")
    assert recording.tables["truth"].select("qw", "qx", "qy", "qz").rows()[0] == (1, 0, 0, 0)
    _agrees(recording, 24)
    np.testing.assert_allclose(recording.tables["fixes"].select("x_m", "y_m", "z_m"), BODY, atol=1e-9)


def test_the_help_names_all_presets_and_a_misspelled_one_is_refused(tmp_path):
    said = " ".join(trackwright("import", "--help").out.split())
    assert ", ".join(sorted(PRESETS)) in said
    arguments = ("import", tmp_path, "--mapping", "milluv", "--out", tmp_path / "new")
    assert_refused_last(trackwright(*arguments), "milluv: cannot be read", "(did you mean miluv?)")


def test_the_bag_of_isas_walk_1_gives_the_recording_that_was_made_by_hand(recordings, tmp_path):
    bag, by_hand = recordings.parent / "recordings-raw" / "isas-walk-1.bag", recordings / "isas-walk-1"
    if not bag.is_file():
        pytest.skip(f"no bag at {bag}")
    pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")
    mine = _imported(tmp_path, bag, "isas-walk", "--origin", "1664959673.400324106").tables
    for name, file, later in (("ranges", "ranges", 0.0), ("imu", "imu", -0.045), ("fixes", "maker_fixes", 0.0)):
        ids = dict.fromkeys(("tag", "anchor"), pl.String)
        theirs = pl.read_csv(by_hand / f"{file}.csv.gz", schema_overrides=ids)
        table = mine[name].with_columns(pl.col("t_s") + later)
        order = [column for column in ("t_s", "anchor") if column in table.columns]
        table, theirs = (one.with_columns(pl.col("t_s").round(5)).sort(order) for one in (table, theirs))
        numbers = [column for column in theirs.columns if column not in ids]
        assert table.select(set(ids) & set(theirs.columns)).equals(theirs.select(set(ids) & set(theirs.columns)))
        np.testing.assert_allclose(table.select(numbers), theirs.select(numbers), atol=1.1e-5)
