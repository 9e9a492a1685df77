"""Tracks as a recording of the Rerun viewer: paths, positions over time, 95 % ellipsoids, truth, anchors, stations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.exchange.exported_tracks import ExportedTrack
from trackwright.trackers.exchange.poses import quaternions_of

_QUANTILE_95 = 7.814727903251178
"""95 % quantile of χ² with 3 degrees of freedom."""


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
    return np.sqrt(np.maximum(values, 0.0) * _QUANTILE_95), np.roll(quaternions_of(axes), -1, axis=1)
