"""Bags of ROS 1 and ROS 2 that rosbags writes, with custom UWB ranges, IMU samples, true poses and odometry."""

from __future__ import annotations

import numpy as np

UWB = """std_msgs/Header header
string tag
uwb_msgs/Range[] ranges
"""
RANGE = """uint16 anchor
float64 distance_mm
"""
START = 1_770_000_000
ROWS = 12


def place(k):
    """The true position, m, at row k."""
    return np.array([1 + 0.1 * k, 2.0, 0.5])


def write_bag(path, kind):
    """A bag with custom UWB ranges, IMU, true poses and odometry; `kind`: bag (ROS 1), db3 or mcap (ROS 2)."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    for name, text in (("uwb_msgs/msg/Range", RANGE), ("uwb_msgs/msg/Ranges", UWB)):
        store.register(get_types_from_msg(text, name))
    types = store.types
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer1(path) if kind == "bag" else Writer2(path, version=9, storage_plugin=plugin)
    topics = {
        "/uwb": "uwb_msgs/msg/Ranges", "/imu": "sensor_msgs/msg/Imu", "/vicon/cart": "geometry_msgs/msg/PoseStamped",
        "/odom": "nav_msgs/msg/Odometry",
    }  # fmt: skip
    with writer:
        connections = {topic: writer.add_connection(topic, name, typestore=store) for topic, name in topics.items()}
        serialize = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
        for k in range(ROWS):
            sec, nanosec = START + k // 10, k % 10 * 100_000_000
            time = types["builtin_interfaces/msg/Time"](sec, nanosec)
            sequence = (k,) if kind == "bag" else ()
            header = types["std_msgs/msg/Header"](*sequence, time, "world")
            point, turn = (
                types["geometry_msgs/msg/Point"](*place(k)),
                types["geometry_msgs/msg/Quaternion"](0, 0, 0.6, 0.8),
            )
            pose, vector = types["geometry_msgs/msg/Pose"](point, turn), types["geometry_msgs/msg/Vector3"]
            anchors = {17: [0.0, 0.0, 2.0], 42: [5.0, 0.0, 2.0]}
            ranges = [
                types["uwb_msgs/msg/Range"](anchor, 1000 * float(np.linalg.norm(place(k) - at)))
                for anchor, at in anchors.items()
            ]
            covariance, nine = np.diag([0.04, 0.09, 0.16, 0, 0, 0]).ravel(), np.zeros(9)
            messages = {
                "/uwb": types["uwb_msgs/msg/Ranges"](header, "cart", ranges),
                "/imu": types["sensor_msgs/msg/Imu"](
                    header, turn, nine, vector(0.1, 0.2, 0.3), nine, vector(0.4, 0.5, 9.81), nine
                ),
                "/vicon/cart": types["geometry_msgs/msg/PoseStamped"](header, pose),
                "/odom": types["nav_msgs/msg/Odometry"](
                    header, "cart", types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance),
                    types["geometry_msgs/msg/TwistWithCovariance"](
                        types["geometry_msgs/msg/Twist"](vector(1, 0, 0), vector(0, 0, 0)), np.zeros(36)
                    ),
                ),
            }  # fmt: skip
            for topic, message in messages.items():
                stamp = sec * 10**9 + nanosec + 5_000_000
                writer.write(connections[topic], stamp, serialize(message, topics[topic]))
