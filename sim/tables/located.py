"""A simulated world of ranges with the fixes that a locating system makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from trackers.catalogue import groups
from trackers.recordings.folder import Folder
from trackers.recordings.trajectories import shown_height
from trackers.tracks import batches


def located(folder: Folder, tracker: str, free_height: bool = False) -> Folder:
    """The folder with a table of fixes: what the named tracker of single moments makes of its ranges."""
    tables = []
    for group in groups([folder], tracker, free_height):
        for lanes, batch in batches(group.lanes):
            estimates = group.tracker.run(batch)
            for k, lane in enumerate(lanes):
                one, rows = estimates[k], len(lane.recording)
                place = [np.asarray(x, float)[:rows] for x in one.mean.position]
                axes = place if len(place) == 3 else [*place, shown_height(lane)]
                columns = {f"{a}_m": x for a, x in zip("xyz", axes, strict=True)}
                tag = pl.repeat(lane.tag, rows, eager=True)
                found = pl.DataFrame({"t_s": lane.recording.times, "tag": tag} | columns)
                tables.append(found.filter(pl.Series(one.usable[:rows])))
    return replace(folder, tables=folder.tables | {"fixes": pl.concat(tables).sort("t_s", maintain_order=True)})
