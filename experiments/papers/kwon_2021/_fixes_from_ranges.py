"""Simulated ranges with the fixes that a positioning system computes from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from trackers.catalogue import spec_of
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracks import batches
from trackers.recordings.trajectories import known_heights


def fixes_from_ranges(folder: RecordingFolder, tracker: str, free_height: bool = False) -> RecordingFolder:
    """The folder with a table of fixes: the usable positions that a single-epoch tracker estimates from its ranges."""
    tables = []
    for group in spec_of(tracker).batches([folder], tracker, free_height):
        for trajectories, batch in batches(group.trajectories):
            estimates = group.tracker.run(batch)
            for k, trajectory in enumerate(trajectories):
                one, rows = estimates[k], len(trajectory.recording)
                position = [np.asarray(x, float)[:rows] for x in one.mean.position]
                axes = position if len(position) == 3 else [*position, known_heights(trajectory)]
                columns = {f"{a}_m": x for a, x in zip("xyz", axes, strict=True)}
                tag = pl.repeat(trajectory.tag, rows, eager=True)
                fixes = pl.DataFrame({"t_s": trajectory.recording.times, "tag": tag} | columns)
                tables.append(fixes.filter(pl.Series(one.usable[:rows])))
    return replace(folder, tables=folder.tables | {"fixes": pl.concat(tables).sort("t_s", maintain_order=True)})
