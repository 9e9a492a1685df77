"""Simulated phases as a recording folder of many tags."""

from __future__ import annotations

import numpy as np
import polars as pl

from sim.scenarios import SimulatedPhases
from sim.tables.rows import every_row, named
from trackers.core.rig import Rig, Tag
from trackers.recordings.folder import RecordingFolder


def as_folder(world: SimulatedPhases, name: str) -> RecordingFolder:
    """The recording folder of a simulated world: tags named by their trajectory ids, missing phases empty."""
    count, rows, stations, antennas = world.phases.shape
    tags = [str(i) for i in world.ids]
    values = np.where(world.seen, world.phases, np.nan).reshape(-1, antennas)
    heard = pl.Series(np.isfinite(values).any(axis=1))
    phases = pl.DataFrame(
        {
            "t_s": np.tile(np.repeat(world.times, stations), count),
            "tag": named(np.repeat(np.arange(count), rows * stations), tags),
            "station": named(np.tile(np.arange(stations), count * rows), list(world.rig.stations)),
        }
        | {f"phase_{k + 1}_rad": pl.Series(values[:, k].astype(np.float64), nan_to_null=True) for k in range(antennas)}
    ).filter(heard)
    truth = pl.DataFrame(
        every_row(world.times, tags) | {f"{axis}_m": world.positions[..., k].ravel() for k, axis in enumerate("xyz")}
    )
    rig = Rig(
        name, stations=world.rig.stations, tags={tag: Tag() for tag in tags}, about="Simulated, see manifest.json."
    )
    tables = {"phases": phases.sort("t_s", maintain_order=True), "truth": truth.sort("t_s", maintain_order=True)}
    return RecordingFolder(name, None, rig, tables)
