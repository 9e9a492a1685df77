"""Simulated ranges as a recording folder of many tags."""

from __future__ import annotations

import numpy as np
import polars as pl

from experiments.folder import Folder
from sim.ranging import SimulatedRanges
from trackers.core.rig import Rig, Tag


def simulated_ranging(world: SimulatedRanges, name: str) -> Folder:
    """The recording folder: tags named by their trajectory ids, a row per range that was seen, truth in space."""
    count, rows, anchors = world.ranges.shape
    tags, names = [str(i) for i in world.ids], list(world.rig.anchors)
    tag, row, anchor = np.nonzero(world.seen)
    ranges = pl.DataFrame(
        {
            "t_s": world.times[row],
            "tag": pl.Series(tag).replace_strict(range(count), tags, return_dtype=pl.String),
            "anchor": pl.Series(anchor).replace_strict(range(anchors), names, return_dtype=pl.String),
            "range_m": world.ranges[tag, row, anchor].astype(float),
        }
    )
    truth = pl.DataFrame(
        {
            "t_s": np.tile(world.times, count),
            "tag": pl.Series(np.repeat(np.arange(count), rows)).replace_strict(
                range(count), tags, return_dtype=pl.String
            ),
        }
        | {f"{axis}_m": world.positions[..., k].ravel() for k, axis in enumerate("xyz")}
    )
    # A tag whose height never changes has a known one.
    heights = [float(z[0]) if np.ptp(z) == 0 else None for z in world.positions[..., 2]]
    known = {t: Tag(height=h) for t, h in zip(tags, heights, strict=True)}
    rig = Rig(name, anchors=world.rig.anchors, tags=known, about="Simulated, see manifest.json.")
    tables = {"ranges": ranges.sort("t_s", maintain_order=True), "truth": truth.sort("t_s", maintain_order=True)}
    return Folder(name, None, rig, tables)
