"""Simulated ranges as a recording folder of many tags."""

from __future__ import annotations

import numpy as np
import polars as pl

from sim.ranging import SimulatedRanges
from sim.tables.rows import every_row, named
from trackers.core.rig import Rig, Tag
from trackers.recordings.folder import RecordingFolder


def simulated_ranging(world: SimulatedRanges, name: str) -> RecordingFolder:
    """The recording folder: tags named by their trajectory ids, a row per range that was seen, truth in space."""
    tags = [str(i) for i in world.ids]
    tag, row, anchor = np.nonzero(world.seen)
    ranges = pl.DataFrame(
        {
            "t_s": world.times[row],
            "tag": named(tag, tags),
            "anchor": named(anchor, list(world.rig.anchors)),
            "range_m": world.ranges[tag, row, anchor].astype(float),
        }
    )
    truth = pl.DataFrame(
        every_row(world.times, tags) | {f"{axis}_m": world.positions[..., k].ravel() for k, axis in enumerate("xyz")}
    )
    # A tag whose height never changes has a known one.
    heights = [float(z[0]) if np.ptp(z) == 0 else None for z in world.positions[..., 2]]
    known = {t: Tag(height=h) for t, h in zip(tags, heights, strict=True)}
    rig = Rig(name, anchors=world.rig.anchors, tags=known, about="Simulated, see manifest.json.")
    tables = {"ranges": ranges.sort("t_s", maintain_order=True), "truth": truth.sort("t_s", maintain_order=True)}
    return RecordingFolder(name, None, rig, tables)
