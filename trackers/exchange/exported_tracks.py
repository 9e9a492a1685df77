"""Tracks for other programs: estimates or truth as TUM, KITTI, CSV, ROS 2 bags and for the Rerun viewer."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import polars as pl

from trackwright.trackers.core.data.consistency import chi_square_quantile
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.rows import covariances
from trackwright.trackers.exchange.ros_reader import rosbags_module
from trackwright.trackers.exchange.trajectories import (
    PoseTrajectory,
    quaternions_of,
    trajectory_of_table,
    usable_rows,
    write_trajectory,
    written_files,
)
from trackwright.trackers.recordings.atomic import atomic_write, beside
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.trackers.recordings.rig_file import RIG_FILE
from trackwright.trackers.recordings.tracks_table import HEADING, is_bearing, read_tracks, source_paths

_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"


@dataclass(frozen=True, eq=False)
class ExportedTrack:
    """A trajectory with its recording and tag, and the covariances (n, 3, 3), m², of its positions, or None."""

    recording: str
    tag: str
    poses: PoseTrajectory
    covariances: np.ndarray | None = None

    @property
    def file_name(self) -> str:
        """Recording and tag as the name of a file without its ending."""
        return re.sub(r"[^\w.-]", "_", f"{self.recording}-{self.tag}")[:100]


def tracks_of(table: pl.DataFrame) -> list[ExportedTrack]:
    """The trajectories in a table of estimates or truth; a body with a heading alone is level. Or UnusableInput."""
    if is_bearing(table):
        raise UnusableInput("the tracks hold bearings, no positions; --format csv writes them")
    tracks = []
    for (recording, tag), rows in table.partition_by(["recording", "tag"], as_dict=True, maintain_order=True).items():
        if (rows := usable_rows(rows)).height:
            given = covariances(rows) if "std_x_m" in rows.columns else None
            poses, heading = trajectory_of_table(rows, f"tag {tag} of '{recording}'"), float_column(rows, HEADING)
            if poses.quaternions is None and np.isfinite(heading).all():
                level = np.stack([np.cos(heading / 2), *np.zeros((2, len(heading))), np.sin(heading / 2)], axis=1)
                poses = replace(poses, quaternions=level)
            tracks.append(ExportedTrack(str(recording), str(tag), poses, given))
    if not tracks:
        raise UnusableInput("no track holds an estimate; run `trackwright check` on the recording")
    return tracks


def write_bag(out: Path, tracks: Sequence[ExportedTrack]) -> list[str]:
    """Writes the bag, a new folder, completely or not at all, and returns the topics, /RECORDING/TAG.

    An unknown variance is 0 as in ROS, an unknown attitude the identity. Raises UnusableInput for times before 0.
    """
    rosbag2, typesys = rosbags_module("rosbag2", "--format ros2"), rosbags_module("typesys", "--format ros2")
    if early := [track.poses.name for track in tracks if track.poses.times[0] < 0]:
        raise UnusableInput(f"{early[0]}: has times before 0 s, which a ROS bag cannot hold; cut or shift them")
    if out.exists():
        raise UnusableInput(f"--out {out}: exists already, expected a new folder for the bag; choose another name")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    # A part of a topic has letters, digits and underscores, not a digit first.
    plain = [
        [re.sub(r"^(?=\d|$)", "tag_", re.sub(r"\W", "_", x, flags=re.A)) for x in (t.recording, t.tag)] for t in tracks
    ]
    topics = ["/" + "/".join(names) for names in plain]
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside(out, Path.mkdir) as scratch:
            # The bag's files have the name of its folder, which is why a folder around it is temporary, not a name.
            plugin = rosbag2.StoragePlugin.SQLITE3
            with rosbag2.Writer(scratch / out.name, version=9, storage_plugin=plugin) as writer:
                for topic, track in zip(topics, tracks, strict=True):
                    connection = writer.add_connection(topic, _TYPE, typestore=store)
                    for row in range(len(track.poses)):
                        stamp = round(track.poses.times[row] * 1e9)
                        writer.write(connection, stamp, store.serialize_cdr(_message(store.types, track, row), _TYPE))
            (scratch / out.name).rename(out)
    except OSError as error:
        raise UnusableInput(f"{out}: cannot be written ({error.strerror}); check free space and permissions") from error
    return topics


def _message(types: Mapping[str, type], track: ExportedTrack, row: int) -> object:
    """The pose of a row as a ROS message."""
    point, quaternion, pose = (types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion", "Pose"))
    covariance, poses = np.zeros((6, 6)), track.poses
    if track.covariances is not None:
        covariance[:3, :3] = np.nan_to_num(track.covariances[row])
    w, x, y, z = (1.0, 0.0, 0.0, 0.0) if poses.quaternions is None else poses.quaternions[row].tolist()
    place = pose(point(*np.nan_to_num(poses.positions[row]).tolist()), quaternion(x, y, z, w))
    moment = types["builtin_interfaces/msg/Time"](*divmod(round(poses.times[row] * 1e9), 10**9))
    header = types["std_msgs/msg/Header"](moment, "world")
    return types[_TYPE](header, types["geometry_msgs/msg/PoseWithCovariance"](place, covariance.ravel()))


def write_rrd(
    path: Path, tracks: Sequence[ExportedTrack], truths: Sequence[ExportedTrack], rigs: Mapping[str, Rig]
) -> None:
    """Writes tracks, truths and, by recording, rigs; raises UnusableInput without the package rerun-sdk."""
    try:
        import rerun as rr
    except ImportError:
        fix = "install the extra: pip install 'trackwright[rerun]'"
        raise UnusableInput(f"--format rrd needs the package rerun-sdk; {fix}") from None
    stream = rr.RecordingStream("trackwright")
    stream.save(path)
    for name, rig in rigs.items():
        stations = {key: station.position for key, station in rig.stations.items()}
        for what, places in (("anchors", rig.anchors), ("stations", stations)):
            if places:
                points = rr.Points3D(np.stack(list(places.values())), labels=list(places), radii=0.05)
                stream.log([name, what], points, static=True)
    for what, track in (*(("track", t) for t in tracks), *(("truth", t) for t in truths)):
        entity, positions = [track.recording, f"tag {track.tag}", what], np.nan_to_num(track.poses.positions)
        stream.log([*entity, "path"], rr.LineStrips3D([positions]), static=True)
        shapes = {"position": rr.Points3D.columns(positions=positions, radii=np.full(len(positions), 0.04))}
        if track.covariances is not None:
            values, axes = np.linalg.eigh(np.nan_to_num(track.covariances))
            axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
            shapes["ellipsoid 95 %"] = rr.Ellipsoids3D.columns(
                centers=positions,
                half_sizes=np.sqrt(np.maximum(values, 0.0) * chi_square_quantile(0.95, 3)),
                quaternions=np.roll(quaternions_of(axes), -1, axis=1),
            )
        times = [rr.TimeColumn("t_s", duration=track.poses.times)]
        for name, columns in shapes.items():
            rr.send_columns(rr.new_entity_path([*entity, name]), times, columns, recording=stream)
    stream.flush()
    stream.disconnect()


Format = Literal["tum", "kitti", "csv", "ros2", "rrd"]


def export_tracks(run: Path, format: Format, out: Path, tag: str | None = None, force: bool = False) -> Iterator[str]:
    """Exports the tracks in a folder of `track`, or the truth of a recording; a line for each file.

    `format`: tum, kitti, csv, ros2 or rrd. `force`: replace a file that exists. Raises UnusableInput.
    """

    def refuse_existing(*files: Path) -> None:
        if out.is_dir() and any(out.iterdir()):
            raise UnusableInput(f"--out {out}: is a folder with content; expected a new file or an empty folder")
        if not force and (old := next((file for file in files if file.is_file()), None)):
            raise UnusableInput(f"--out {old}: exists; expected a new file; --force replaces it")

    refuse_existing(out)
    known: list[RecordingFolder] = []
    if is_recording := (run / RIG_FILE).is_file():
        known = [read_recording(run)]
    else:
        for path in source_paths(run) if format == "rrd" else ():
            try:
                known.append(read_recording(path))
            except UnusableInput as problem:
                yield f"notice: without its anchors and truth: {problem}"
    truths = [f.tables["truth"].with_columns(recording=pl.lit(f.name)) for f in known if "truth" in f.tables]
    if is_recording and not truths:
        raise UnusableInput(f"{run}: has no truth table; expected a folder of `track`, or a recording with truth")
    table = truths.pop() if is_recording else read_tracks(run)
    if tag is not None:
        tags = sorted(table["tag"].cast(pl.String).unique())
        table = table.filter(pl.col("tag").cast(pl.String) == tag)
        if table.is_empty():
            raise UnusableInput(f"--tag {tag}: no row of it; found {listed(tags)}")
    if format == "csv":
        atomic_write(out, table.write_csv)
        yield f"wrote {out}: {counted(len(table), 'row')}"
        return
    tracks = tracks_of(table)
    if format == "ros2":
        yield f"wrote {out}: a ROS 2 bag with {listed(write_bag(out, tracks))}"
    elif format == "rrd":
        true = [track for truth in truths for track in tracks_of(truth) if tag in (None, track.tag)]
        rigs = {folder.name: folder.rig for folder in known}
        atomic_write(out, partial(write_rrd, tracks=tracks, truths=true, rigs=rigs))
        yield f"wrote {out}: {counted(len(tracks), 'track')}; see it: rerun {out}"
    else:
        alone = len(tracks) == 1 and bool(out.suffix)
        files = [out] if alone else [out / f"{track.file_name}.{format}" for track in tracks]
        refuse_existing(*(file for path in files for file in written_files(path, format)))
        files[0].parent.mkdir(parents=True, exist_ok=True)
        for track, path in zip(tracks, files, strict=True):
            write_trajectory(track.poses, path, format)
            yield f"wrote {path}: {counted(len(track.poses), 'pose')}"
