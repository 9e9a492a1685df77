"""Tracks for other programs: estimates or truth as TUM, KITTI, CSV, ROS 2 bags and for the Rerun viewer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

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
_FRAME = "world"


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
        text = f"{self.recording}-{self.tag}"
        return "".join(c if c.isalnum() or c in "._-" else "_" for c in text)[:100]


def tracks_of(table: pl.DataFrame) -> list[ExportedTrack]:
    """The trajectories of a table of estimates or truth; rows and tracks without an estimate are left out.

    Where the heading alone is known, the body is taken as level.

    Raises UnusableInput for bearings, and if nothing remains.
    """
    if is_bearing(table):
        raise UnusableInput("the tracks hold bearings, no positions; --format csv writes them")
    tracks = []
    for (recording, tag), rows in table.partition_by(["recording", "tag"], as_dict=True, maintain_order=True).items():
        rows = usable_rows(rows)
        if rows.height:
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

    An unknown variance of the position is 0 as in ROS; attitudes are the poses' or the identity, with zero
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


def write_rrd(
    path: Path, tracks: Sequence[ExportedTrack], truths: Sequence[ExportedTrack], rigs: Mapping[str, Rig]
) -> None:
    """Writes tracks, truths and, by recording, rigs; raises UnusableInput without the package rerun-sdk."""
    try:
        import rerun as rr
    except ImportError:
        raise UnusableInput(
            "--format rrd needs the package rerun-sdk; install the extra: pip install 'trackwright[rerun]'"
        ) from None
    stream = rr.RecordingStream("trackwright")
    stream.save(path)
    for name, rig in rigs.items():
        stations = {key: station.position for key, station in rig.stations.items()}
        for what, places in (("anchors", rig.anchors), ("stations", stations)):
            if places:
                points = rr.Points3D(np.stack(list(places.values())), labels=list(places), radii=0.05)
                stream.log([name, what], points, static=True)
    for what, several in (("track", tracks), ("truth", truths)):
        for track in several:
            _log(rr, stream, [track.recording, f"tag {track.tag}", what], track)
    stream.flush()
    stream.disconnect()


def _log(rr: Any, stream: Any, entity: list[str], track: ExportedTrack) -> None:
    positions = np.nan_to_num(track.poses.positions)
    stream.log([*entity, "path"], rr.LineStrips3D([positions]), static=True)
    times, name = [rr.TimeColumn("t_s", duration=track.poses.times)], rr.new_entity_path
    points = rr.Points3D.columns(positions=positions, radii=np.full(len(positions), 0.04))
    rr.send_columns(name([*entity, "position"]), times, points, recording=stream)
    if track.covariances is not None:
        half_sizes, quaternions = _ellipsoids(track.covariances)
        shapes = rr.Ellipsoids3D.columns(centers=positions, half_sizes=half_sizes, quaternions=quaternions)
        rr.send_columns(name([*entity, "ellipsoid 95 %"]), times, shapes, recording=stream)


def _ellipsoids(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half axes (n, 3), m, and attitudes (n, 4) x, y, z, w of the 95 % ellipsoids; an unknown variance counts as 0."""
    values, axes = np.linalg.eigh(np.nan_to_num(covariances))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return np.sqrt(np.maximum(values, 0.0) * chi_square_quantile(0.95, 3)), np.roll(quaternions_of(axes), -1, axis=1)


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
