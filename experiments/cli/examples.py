"""Small simulated recordings that have what a tracker reads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from trackwright.sim.worlds import WORLDS, tdoa
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracker_spec import TrackerSpec


def example_for(spec: TrackerSpec) -> RecordingFolder | None:
    """A simulated recording that has what the tracker needs, None where no world has it: of each world as it is, with
    a floor and known heights, and with bearings in the place of its readings."""
    for world in WORLDS.values():
        folder = world(np.arange(1), 0)
        truth = folder.tables["truth"]
        x, y, z = (truth[axis].to_numpy() for axis in ("x_m", "y_m", "z_m"))
        (west, east), (south, north) = ((v.min() - 1, v.max() + 1) for v in (x, y))
        outline = np.array([[west, south], [east, south], [east, north], [west, north]])
        tags = {tag: Tag(float(z[0])) for tag in truth["tag"].unique()}
        examples = [folder, replace(folder, rig=replace(folder.rig, outline=outline, tags=tags))]
        angles = {name: s.angles(np.stack([x, y, z], axis=1)).T for name, s in folder.rig.stations.items()}
        at = truth.select("t_s", "tag")
        seen = [at.with_columns(station=pl.lit(k), azimuth_rad=a, elevation_rad=e) for k, (a, e) in angles.items()]
        if seen:
            examples.append(replace(folder, tables={"bearings": pl.concat(seen).sort("t_s"), "truth": truth}))
        for example in examples:
            if spec.missing(example) is None:
                return example
    differences = tdoa(1, imu=True).folder()
    return differences if spec.missing(differences) is None else None
