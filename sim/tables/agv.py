"""A simulated vehicle round a workstation as a recording folder of many tags."""

from __future__ import annotations

import numpy as np
import polars as pl

from sim.agv import SimulatedFixes
from sim.tables.rows import every_row
from trackers.core.rig import Rig, Tag
from trackers.recordings.folder import RecordingFolder


def simulated_agv(world: SimulatedFixes, name: str) -> RecordingFolder:
    """The recording folder: tags named by their trajectory ids, the designed route as the rig's path."""
    tags = [str(i) for i in world.ids]
    ids = every_row(world.times, tags)
    fixes = np.where(world.seen, world.fixes, np.nan)
    tables = {
        table: pl.DataFrame(
            ids | {f"{a}_m": pl.Series(values[..., k].ravel(), nan_to_null=True) for k, a in enumerate("xyz")}
        ).sort("t_s", maintain_order=True)
        for table, values in (("fixes", fixes), ("truth", world.positions))
    }
    rig = Rig(
        name,
        anchors=world.anchors,
        tags={tag: Tag() for tag in tags},
        path_knots=world.route,
        about="Simulated, see manifest.json.",
    )
    return RecordingFolder(name, None, rig, tables)
