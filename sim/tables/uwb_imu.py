"""Simulated ranges and IMU samples as a recording folder of many tags."""

from __future__ import annotations

import numpy as np
import polars as pl

from sim.imu import SimulatedUwbImu
from sim.tables.ranging import simulated_ranging
from sim.tables.rows import every_row, named
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tables import QUATERNION


def simulated_uwb_imu(world: SimulatedUwbImu, name: str) -> RecordingFolder:
    """The recording folder: that of the ranges with the IMU's samples and a truth with attitudes at their times."""
    folder = simulated_ranging(world.ranges, name)
    tags = [str(i) for i in world.ranges.ids]
    tag, row = np.nonzero(world.seen)
    motion = np.concatenate([world.accel, world.gyro], axis=2)[tag, row]
    columns = [*(f"accel_{axis}_mps2" for axis in "xyz"), *(f"gyro_{axis}_radps" for axis in "xyz")]
    imu = pl.DataFrame({"t_s": world.times[row], "tag": named(tag, tags)} | dict(zip(columns, motion.T, strict=True)))
    count, samples = world.seen.shape
    pose = np.concatenate([world.positions, world.attitudes], axis=2).reshape(count * samples, 7)
    truth = pl.DataFrame(
        every_row(world.times, tags) | dict(zip(("x_m", "y_m", "z_m", *QUATERNION), pose.T, strict=True))
    )
    tables = {name: table.sort("t_s", maintain_order=True) for name, table in (("imu", imu), ("truth", truth))}
    return RecordingFolder(name, None, folder.rig, folder.tables | tables)
