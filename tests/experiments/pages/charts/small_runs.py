"""Runs whose errors are known, without a tracker, for figures of a comparison; and the data of a page's chart."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.pages.reports.runs import TrackRun
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.rows import scored_rows
from trackwright.trackers.recordings.folder import RecordingFolder

T = 0.1 * np.arange(30)


ANCHORS = {"A1": np.zeros(3), "A2": np.array([12.0, 0.0, 2.0]), "A3": np.array([12.0, 8.0, 2.0])}


def small_run(name: str, shifts: Mapping[str, float]) -> TrackRun:
    """A run whose error in x is that of each recording."""
    at = {"tag": "1", "t_s": T, "x_m": T, "y_m": T**2, "z_m": 1.0}
    truth = pl.DataFrame(at)
    folders = {key: RecordingFolder(key, None, Rig(key, anchors=ANCHORS), {"truth": truth}) for key in shifts}
    spread = {"std_x_m": 0.1, "std_y_m": 0.1, "std_z_m": 0.0, "cov_xy_m2": 0.0, "nis": 1.0, "nis_dof": 1.0}
    table = pl.concat(
        [pl.DataFrame({"recording": key} | at | spread).with_columns(pl.col("x_m") + s) for key, s in shifts.items()]
    )
    return TrackRun(name, Path(name), False, {}, folders, scored_rows(table, dict.fromkeys(shifts, truth)))


def chart_data(address: str) -> Any:
    """What an image of a page holds for plotly.js."""
    text = base64.b64decode(address.partition(",")[2]).decode()
    return json.loads(re.search(r'<metadata id="chart">(.*?)</metadata>', text, re.DOTALL)[1])
