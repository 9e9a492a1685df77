"""Simulated ranges with the fixes that a positioning system computes from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from trackers.catalogue import spec_of
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracks import batches


def fixes_from_ranges(folder: RecordingFolder, tracker: str, free_height: bool = False) -> RecordingFolder:
    """The folder with a table of fixes: the usable positions that a single-epoch tracker estimates from its ranges."""
    tables = []
    for group in spec_of(tracker).batches([folder], tracker, free_height):
        for trajectories, batch in batches(group.trajectories):
            estimates, columns = group.tracker.run(batch), trajectories.columns
            rows = np.arange(estimates.status.shape[1]) < np.diff(columns.starts)[:, None]
            position = [np.asarray(x, float)[rows] for x in estimates.mean.position]
            axes = position if len(position) == 3 else [*position, columns.of_each(trajectories.heights)]
            tag = pl.Series(trajectories.tags).gather(columns.of_each(np.arange(len(columns))))
            fixes = pl.DataFrame(
                {"t_s": columns.times, "tag": tag} | {f"{a}_m": x for a, x in zip("xyz", axes, strict=True)}
            )
            tables.append(fixes.filter(pl.Series(estimates.usable[rows])))
    return replace(folder, tables={**folder.tables, "fixes": pl.concat(tables).sort("t_s", maintain_order=True)})
