"""The fixes of the maker's own locating system, as they are in the recording."""

from __future__ import annotations

import polars as pl

from trackwright.experiments.lab.benchmark.problems import NotRead
from trackwright.trackers.recordings.folder import RecordingFolder


def fixes(folder: RecordingFolder) -> pl.DataFrame:
    """The estimates of all tags; raises NotRead for a recording without fixes."""
    for name in ("maker_fixes", "fixes"):
        if name in folder.tables:
            return folder.tables[name].select("t_s", "tag", "x_m", "y_m", "z_m")
    raise NotRead(f"{folder.name}: the maker's fixes are not recorded")
