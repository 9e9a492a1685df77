"""Tracks as a ROS 2 bag: a topic of poses with covariances for each track."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.exchange.exported_tracks import ExportedTrack
from trackwright.trackers.exchange.ros_reader import rosbags_module
from trackwright.trackers.recordings.beside import beside

_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_FRAME = "world"


def write_bag(out: Path, tracks: Sequence[ExportedTrack]) -> list[str]:
    """Writes the bag, a new folder, completely or not at all, and returns the topics, /RECORDING/TAG.

    An unknown variance of the position is 0 as in ROS; attitudes are those of the poses or the identity, with zero
    variance. Raises UnusableInput for times before 0, an existing folder, and without the package rosbags.
    """
    rosbag2, typesys = rosbags_module("rosbag2", "--format ros2"), rosbags_module("typesys", "--format ros2")
    early = [track.poses.name for track in tracks if track.poses.times[0] < 0]
    if early:
        raise UnusableInput(f"{early[0]}: has times before 0 s, which a ROS bag cannot hold; cut or shift them")
    if out.exists():
        raise UnusableInput(f"--out {out}: exists already, expected a new folder for the bag; choose another name")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    plugin, topics = rosbag2.StoragePlugin.SQLITE3, []
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside(out, Path.mkdir) as scratch:
            # The bag's files have the name of its folder, which is why a folder around it is temporary, not a name.
            with rosbag2.Writer(scratch / out.name, version=9, storage_plugin=plugin) as writer:
                for track in tracks:
                    topic = f"/{_plain(track.recording)}/{_plain(track.tag)}"
                    topics.append(topic)
                    connection = writer.add_connection(topic, _TYPE, typestore=store)
                    for stamp, message in _messages(store, track):
                        writer.write(connection, stamp, store.serialize_cdr(message, _TYPE))
            (scratch / out.name).rename(out)
    except OSError as error:
        raise UnusableInput(f"{out}: cannot be written ({error.strerror}); check free space and permissions") from error
    return topics


def _messages(store: Any, track: ExportedTrack) -> Any:
    types = store.types
    quaternion, point = types["geometry_msgs/msg/Quaternion"], types["geometry_msgs/msg/Point"]
    time, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    pose, with_covariance = types["geometry_msgs/msg/Pose"], types["geometry_msgs/msg/PoseWithCovariance"]
    poses = track.poses
    given = np.tile([1.0, 0, 0, 0], (len(poses), 1)) if poses.quaternions is None else poses.quaternions
    for k, position in enumerate(np.nan_to_num(poses.positions).tolist()):
        covariance = np.zeros((6, 6))
        if track.covariances is not None:
            covariance[:3, :3] = np.nan_to_num(track.covariances[k])
        w, x, y, z = given[k].tolist()
        stamp = round(poses.times[k] * 1e9)
        moment = time(sec=stamp // 10**9, nanosec=stamp % 10**9)
        place = pose(position=point(*position), orientation=quaternion(x=x, y=y, z=z, w=w))
        yield stamp, types[_TYPE](header(moment, _FRAME), with_covariance(place, covariance.ravel()))


def _plain(text: str) -> str:
    """The text as a part of a topic: letters, digits and underscores, not a digit first."""
    name = "".join(c if c.isascii() and c.isalnum() else "_" for c in text)
    return f"tag_{name}" if not name or name[0].isdigit() else name
