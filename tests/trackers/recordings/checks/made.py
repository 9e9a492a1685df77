"""Mistakes made on a recording in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.recordings.folder import RecordingFolder

Make = Callable[[RecordingFolder], RecordingFolder]


def with_columns(name: str, *columns: pl.Expr, **named: pl.Expr) -> Make:
    """Other columns of a table."""
    return lambda folder: replace(
        folder, tables={**folder.tables, name: folder.tables[name].with_columns(*columns, **named)}
    )


def with_rows(name: str, kept: pl.Expr) -> Make:
    """Some of the rows of a table."""
    return lambda folder: replace(folder, tables={**folder.tables, name: folder.tables[name].filter(kept)})


def only(*tables: str) -> Make:
    """These tables alone."""
    return lambda folder: replace(folder, tables={name: folder.tables[name] for name in tables})


def with_anchors(change: Callable[[dict[str, np.ndarray]], dict[str, Any]]) -> Make:
    """Other places of the anchors that the change gives of all."""
    return lambda folder: replace(
        folder, rig=replace(folder.rig, anchors={**folder.rig.anchors, **change(dict(folder.rig.anchors))})
    )


def with_stations(change: Callable[[Station], Station], chosen: Sequence[str] | None = None) -> Make:
    """Other stations, of all or of those that are chosen."""
    return lambda folder: replace(
        folder,
        rig=replace(
            folder.rig,
            stations={k: change(s) if chosen is None or k in chosen else s for k, s in folder.rig.stations.items()},
        ),
    )


def rotated(change: Callable[[np.ndarray], np.ndarray], chosen: Sequence[str] | None = None) -> Make:
    """Other quaternions of stations."""
    return with_stations(lambda s: replace(s, rotation=change(np.asarray(s.rotation, float))), chosen)


def about_z(q: np.ndarray, degrees: float) -> np.ndarray:
    """The attitude q turned about the world's z."""
    c, s = np.cos(np.radians(degrees) / 2), np.sin(np.radians(degrees) / 2)
    w, x, y, z = q
    return np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
