"""The NumPy loops of the benchmarks are the filters that they are compared with."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from experiments.bench.loops import filtered, model_of, vector
from sim.worlds import WORLDS
from trackers.catalogue import TRACKERS


@pytest.mark.parametrize(
    ("world", "name"),
    [("line", "fix-kf"), ("ranges", "uwb"), pytest.param("tool", "uwb-imu", marks=pytest.mark.slow)],
)
def test_a_loop_has_the_estimates_of_the_tracker(world, name):
    (batch, *_) = TRACKERS[name].batches([WORLDS[world](np.arange(1), 2)], name)
    recording = batch.trajectories[0].recording
    estimates = batch.tracker.run(recording)
    first, last = len(recording) // 2, len(recording) // 2 + 100
    state = vector(jax.tree_util.tree_map(lambda x: x[first - 1], estimates.mean))
    dts = np.diff(recording.times, prepend=0.0)[:last]
    model = model_of(batch.tracker, recording, batch.planar)
    assert model is not None
    means = filtered(model, state, np.asarray(estimates.covariance[first - 1], float), dts, first)
    own = np.stack([np.asarray(x) for x in estimates.mean.position], axis=-1)[first:last]
    # uwb-imu is a mixture of yaws and linearises a step in three stages.
    np.testing.assert_allclose(means[:, : own.shape[1]], own, atol=1e-2 if name == "uwb-imu" else 1e-6)
