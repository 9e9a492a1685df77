"""Runs whose errors are known, without a tracker, for charts of a comparison."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import polars as pl

from trackwright.experiments.pages.reports.comparison import Run
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.rows import scored_rows
from trackwright.trackers.recordings.folder import RecordingFolder

T = 0.1 * np.arange(30)
ANCHORS = {"A1": np.zeros(3), "A2": np.array([12.0, 0.0, 2.0]), "A3": np.array([12.0, 8.0, 2.0])}


def small_run(name: str, shifts: Mapping[str, float]) -> Run:
    """A run whose error in x is that of each recording."""
    at = {"tag": "1", "t_s": T, "x_m": T, "y_m": T**2, "z_m": 1.0}
    truth = pl.DataFrame(at)
    folders = {key: RecordingFolder(key, None, Rig(key, anchors=ANCHORS), {"truth": truth}) for key in shifts}
    spread = {"std_x_m": 0.1, "std_y_m": 0.1, "std_z_m": 0.0, "cov_xy_m2": 0.0, "nis": 1.0, "nis_dof": 1.0}
    tables = (pl.DataFrame({"recording": k} | at | spread).with_columns(pl.col("x_m") + s) for k, s in shifts.items())
    return Run(name, Path(name), {}, False, folders, scored_rows(pl.concat(tables), dict.fromkeys(shifts, truth)))
