"""A simulated world of ranges with the fixes that a locating system makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from trackers.catalogue import spec_of
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracks import batches
from trackers.recordings.trajectories import known_heights


def fixes_from_ranges(folder: RecordingFolder, tracker: str, free_height: bool = False) -> RecordingFolder:
    """The folder with a table of fixes: what the named tracker of single moments makes of its ranges."""
    tables = []
    for group in spec_of(tracker).batches([folder], tracker, free_height):
        for trajectories, batch in batches(group.trajectories):
            estimates = group.tracker.run(batch)
            for k, trajectory in enumerate(trajectories):
                one, rows = estimates[k], len(trajectory.recording)
                place = [np.asarray(x, float)[:rows] for x in one.mean.position]
                axes = place if len(place) == 3 else [*place, known_heights(trajectory)]
                columns = {f"{a}_m": x for a, x in zip("xyz", axes, strict=True)}
                tag = pl.repeat(trajectory.tag, rows, eager=True)
                found = pl.DataFrame({"t_s": trajectory.recording.times, "tag": tag} | columns)
                tables.append(found.filter(pl.Series(one.usable[:rows])))
    return replace(folder, tables=folder.tables | {"fixes": pl.concat(tables).sort("t_s", maintain_order=True)})
