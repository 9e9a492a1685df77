"""The tracker that is chosen for a recording, and readings that come later than it assumes."""

from __future__ import annotations

import numpy as np
import polars as pl

from trackwright.sim import worlds
from trackwright.trackers.catalogue import build, fitting
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.cautions import late_readings
from trackwright.trackers.recordings.folder import RecordingFolder

DELAY_S = 0.4


def _late_fixes(delay):
    """Fixes of a tag that moves at about 1 m/s, `delay` seconds late."""
    times, rng = 0.1 * np.arange(400), np.random.default_rng(0)

    def place(t):
        return np.stack([3 * np.cos(0.4 * t), 2 * np.sin(0.7 * t), np.ones_like(t)], axis=-1)

    def table(t, positions):
        return pl.DataFrame({"t_s": t, "tag": "T"} | dict(zip(("x_m", "y_m", "z_m"), positions.T, strict=True)))

    fixes = table(times, place(times - delay) + rng.normal(0, 0.03, (len(times), 3)))
    return RecordingFolder("late", None, Rig("late"), {"fixes": fixes, "truth": table(times, place(times))})


def test_late_fixes_are_named_with_the_latency_that_allows_for_them():
    folder = _late_fixes(DELAY_S)
    named = build("fix-kf", folder)
    (line,) = late_readings(named, [folder])
    assert line.startswith("late: fixes come 0.4")
    assert "--set sensors.fixes.latency=0.4" in line
    assert late_readings(named.with_values({"sensors.fixes.latency": DELAY_S}), [folder]) == []
    assert late_readings(named, [_late_fixes(0.02)]) == []


def test_ranges_and_an_imu_are_tracked_without_the_imu_where_the_ranges_suffice():
    folder = worlds.tool(n=1, seed=1, rows=60).folder()
    three = folder.tables["ranges"].filter(pl.col("anchor").is_in(sorted(folder.rig.anchors)[:3]))
    for ranges, expected in ((folder.tables["ranges"], "uwb"), (three, "uwb-imu")):
        tables = dict(folder.tables) | {"ranges": ranges}
        assert fitting(RecordingFolder(folder.name, None, folder.rig, tables)) == expected
