"""Values fitted without a block of time."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.experiments.cli.small_archive import random_walk
from trackwright.trackers.recordings.folder import read_recording
from trackwright.tuning.data import fit_data
from trackwright.tuning.fitting import left_out_blocks


@pytest.mark.slow
def test_the_values_without_a_block_of_time_are_those_of_a_fit_to_the_rest_and_compile_nothing(tmp_path):
    folder = read_recording(random_walk(tmp_path / "one", 6, 0.3, rows=400))
    named = tw.build("fix-kf", folder)
    data = fit_data(named.only_batch([folder]), "state-nll")
    level = "sensors.fixes.sigma_horizontal"
    flat = tw.FitOptions(prior="flat")
    result = tw.fit(data.tracker, data, data.objective, level, flat)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(listen := lambda name, seconds, **_: compiled.append(name))
    blocks = left_out_blocks(result, data)
    jax.monitoring.unregister_event_duration_listener(listen)
    assert not [name for name in compiled if name.endswith("backend_compile_duration")]
    assert [blocks[0][0], blocks[-1][1], len(blocks)] == [-np.inf, np.inf, 4]
    assert all(a[1] == b[0] for a, b in pairwise(blocks))
    for start, stop, values in blocks[:2]:
        # In holes of that length truth is not interpolated.
        truth = folder.tables["truth"].filter(~pl.col("t_s").is_between(start, stop, "left"))
        rest = replace(folder, tables=folder.tables | {"truth": truth})
        alone = tw.fit(named, rest, "state-nll", level, flat)
        assert float(values[level]) == pytest.approx(float(alone.values[level]), rel=0.01)
        assert abs(np.log(values[level] / result.values[level])) > 0.005
