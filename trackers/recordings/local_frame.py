"""Recordings in map coordinates, tracked about an origin nearby: single precision resolves 5e6 m to half a metre."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import polars as pl

from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import table_kinds
from trackwright.trackers.recordings.tracker_spec import TrackerBatch
from trackwright.trackers.recordings.trajectories import Trajectories

FAR_M = 1000.0
"""Distance of x or y from zero, m, from which on coordinates are those of a map if it is also larger than the site."""


def near_origin(folder: RecordingFolder) -> RecordingFolder:
    """The recording about an origin of whole metres in the middle of its site, or as it is if that is near zero.

    The site is that of the rig, or, where this has no geometry, of most fixes. Heights are unchanged.
    """
    points = _site(folder)
    if not len(points):
        return folder
    low, high = points.min(axis=0), points.max(axis=0)
    middle = np.round((low + high) / 2)
    if (np.abs(middle) <= np.maximum(FAR_M, high - low)).all():
        return folder
    x, y = middle.tolist()
    here = {"x_m": pl.col("x_m") - x, "y_m": pl.col("y_m") - y}
    kinds = table_kinds()
    tables = {name: t.with_columns(**here) if kinds[name].position else t for name, t in folder.tables.items()}
    return replace(folder, rig=_moved(folder.rig, middle), tables=tables, origin=(x, y))


def _site(folder: RecordingFolder) -> np.ndarray:
    """Points (n, 2), m, on and between which the tags are; none where neither the rig nor fixes tell."""
    rig = folder.rig
    places = [*rig.anchors.values(), *(station.position for station in rig.stations.values())]
    corners = [x for x in (rig.path_knots, rig.outline) if x is not None]
    points = np.concatenate([np.array([p[:2] for p in places]).reshape(-1, 2), *corners, rig.all_walls()[:, :2]])
    if len(points) or "fixes" not in folder.tables:
        return points
    known = folder.tables["fixes"].select("x_m", "y_m").drop_nulls().to_numpy()
    return np.quantile(known, [0.1, 0.9], axis=0) if len(known) else points


def _moved(rig: Rig, origin: np.ndarray) -> Rig:
    """The rig with its x and y from the origin (2,)."""
    solid = np.append(origin, 0.0)
    return replace(
        rig,
        anchors={name: np.asarray(place) - solid for name, place in rig.anchors.items()},
        stations={name: replace(s, position=np.asarray(s.position) - solid) for name, s in rig.stations.items()},
        path_knots=None if rig.path_knots is None else rig.path_knots - origin,
        walls=None if rig.walls is None else rig.walls - np.tile(origin, 2),
        outline=None if rig.outline is None else rig.outline - origin,
    )


def from_origins(tracks: pl.DataFrame, batches: Iterable[TrackerBatch]) -> pl.DataFrame:
    """The estimates with x and y from the origin of the trajectories of their recording in `batches`."""
    origins = {f.name: f.origin for batch in batches for f in Trajectories.of(batch.trajectories).folders}
    if "x_m" not in tracks.columns or not any(map(any, origins.values())):
        return tracks
    name = pl.col("recording").cast(pl.String)
    of_rows = (name.replace_strict({key: o[k] for key, o in origins.items()}, default=0.0) for k in range(2))
    return tracks.with_columns(pl.col(axis) - origin for axis, origin in zip(("x_m", "y_m"), of_rows, strict=True))
