"""Mistakes made on a recording in memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import polars as pl

from trackwright.trackers.recordings.folder import RecordingFolder

Make = Callable[[RecordingFolder], RecordingFolder]


def with_columns(name: str, **columns: pl.Expr) -> Make:
    """Other columns of a table."""
    return lambda folder: replace(folder, tables=folder.tables | {name: folder.tables[name].with_columns(**columns)})


def about_z(q: np.ndarray, degrees: float) -> np.ndarray:
    """The attitude q turned about the world's z."""
    c, s = np.cos(np.radians(degrees) / 2), np.sin(np.radians(degrees) / 2)
    w, x, y, z = q
    return np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
