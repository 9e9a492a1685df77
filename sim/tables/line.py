"""A simulated assembly line as a recording folder of many tags."""

from __future__ import annotations

import numpy as np
import polars as pl

from sim.line import TAG_HEIGHT, SimulatedLine
from sim.tables.rows import every_row
from trackers.core.rig import Rig, Tag
from trackers.recordings.folder import RecordingFolder


def simulated_line(world: SimulatedLine, name: str) -> RecordingFolder:
    """The recording folder: tags named by their trajectory ids, fixes without height, truth at the tags' height."""
    tags = [str(i) for i in world.ids]
    ids = every_row(world.times, tags)
    fixes = np.where(world.seen, world.fixes, np.nan)
    measured = {f"{a}_m": pl.Series(fixes[..., k].ravel(), nan_to_null=True) for k, a in enumerate("xy")}
    true = {f"{a}_m": world.positions[..., k].ravel() for k, a in enumerate("xy")}
    nowhere = pl.lit(None, pl.Float64).alias("z_m")
    tables = {
        "fixes": pl.DataFrame(ids | measured).with_columns(nowhere).sort("t_s", maintain_order=True),
        "truth": pl.DataFrame(ids | true).with_columns(z_m=pl.lit(TAG_HEIGHT)).sort("t_s", maintain_order=True),
    }
    rig = Rig(
        name,
        tags={tag: Tag(height=TAG_HEIGHT) for tag in tags},
        path_knots=world.knots,
        about="Simulated, see manifest.json.",
    )
    return RecordingFolder(name, None, rig, tables)
