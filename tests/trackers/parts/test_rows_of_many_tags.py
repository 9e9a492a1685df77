"""Rows of many tags by whole columns are those of each tag by itself."""

import dataclasses

import jax
import numpy as np
import polars as pl
import pytest

from trackwright.sim.worlds import WORLDS
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.recordings.tracks import Trajectories

CASES = [
    *(("station", name) for name in ("direct", "beam")),
    *(("line", name) for name in ("fix-kf", "line-grid", "mhk")),
    *(("tdoa", name) for name in ("tdoa", "tdoa-imu")),
    ("fusion", "fusion"),
    *(("tool", name) for name in ("uwb-imu", "uwb", "multilateration")),
]
NUMBERS = {
    "station": {"rows": 12, "drop_outs": 0.3},
    "line": {"rate_hz": 0.5},
    "tdoa": {"rows": 12, "imu": True},
    "fusion": {"rows": 12},
    "tool": {"rows": 40},
}


@pytest.mark.parametrize(("world", "tracker"), CASES)
def test_rows_of_many_tags_are_those_of_each_alone(world, tracker):
    folder = WORLDS[world](np.array([3, 11, 4]), 5, **NUMBERS[world])
    together = TRACKERS[tracker].batches([folder], tracker)
    every = {(t.tag, t.station): t.recording for batch in together for t in batch.trajectories}
    for tag in ("3", "11", "4"):
        # Without the simulated arrays: from tables, as a recording on disk.
        tables = {name: table.filter(pl.col("tag") == tag) for name, table in folder.tables.items()}
        for batch in TRACKERS[tracker].batches([dataclasses.replace(folder, tables=tables)], tracker):
            for alone in batch.trajectories:
                jax.tree_util.tree_map(
                    np.testing.assert_array_equal,
                    stack([alone.recording])._replace(key=None),
                    stack([every.pop((alone.tag, alone.station))])._replace(key=None),
                )
    assert not every


def test_a_batch_of_trajectories_is_the_stack_of_their_recordings():
    folder = WORLDS["station"](np.arange(3), 1, rows=12, drop_outs=0.4)
    trajectories = TRACKERS["beam"].batches([folder], "beam")[0].trajectories
    chosen = trajectories[::2]
    assert isinstance(chosen, Trajectories)
    lengths = {len(t.recording) for t in chosen}
    assert len(lengths) > 1
    one, other = chosen.columns.batch(16, seed=4), stack([t.recording for t in chosen], 16, seed=4)
    jax.tree_util.tree_map(np.testing.assert_array_equal, one, other)
