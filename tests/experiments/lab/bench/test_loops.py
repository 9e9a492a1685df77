"""The NumPy loops of the benchmarks are the filters that they are compared with."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from trackwright.experiments.lab.bench.loops import model_of, state_after
from trackwright.experiments.lab.bench.recordings import AGREEMENT_M, RECORDINGS, difference, loops
from trackwright.experiments.lab.benchmark.adapters.plain import filtered
from trackwright.sim.worlds import WORLDS
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.recordings.folder import read_recording


@pytest.mark.parametrize(
    ("world", "name"),
    [("line", "fix-kf"), ("ranges", "uwb"), pytest.param("tool", "uwb-imu", marks=pytest.mark.slow)],
)
def test_a_loop_has_the_estimates_of_the_tracker(world, name):
    (batch, *_) = TRACKERS[name].batches([WORLDS[world](np.arange(1), 2)], name)
    recording = batch.trajectories[0].recording
    tracker = batch.tracker
    if name == "uwb-imu":
        # One of the filters of the mixture: the loop is no mixture.
        tracker = dataclasses.replace(tracker, filter=tracker.filter.kalman)
    estimates = tracker.run(recording)
    first, last = len(recording) // 2, len(recording) // 2 + 100
    state, P = state_after(first - 1, tracker, estimates)
    dts = np.diff(recording.times, prepend=0.0)[:last]
    model = model_of(tracker, recording, batch.planar)
    assert model is not None
    means, _ = filtered(model, state, P, dts, first)
    own = np.stack([np.asarray(x) for x in estimates.mean.position], axis=-1)[first:last]
    np.testing.assert_allclose(means[:, : own.shape[1]], own, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDINGS)
def test_the_loops_of_the_benchmark_have_the_estimates_of_real_recordings(recordings, name):
    folder = read_recording(recordings / name)
    compared = 0
    for tracker, spec in TRACKERS.items():
        if spec.missing(folder) is not None:
            continue
        batch = spec.batches([folder], tracker)[0]
        each = [t.recording for t in batch.trajectories]
        if model_of(batch.tracker, each[0], batch.planar) is None:
            continue
        estimates = batch.tracker.run(each)[0]
        loop, _ = loops(batch, each[0], estimates)["NumPy"]
        assert difference(loop(), estimates, len(each[0])) <= AGREEMENT_M, tracker
        compared += 1
    assert compared or name == "ble51-uca-x0y2"


def test_padding_leaves_the_rows_that_a_loop_is_compared_in(recordings):
    # The first of the two tags has fewer rows than the second.
    folder = read_recording(recordings / "starloc-fast-s1")
    batch = TRACKERS["uwb"].batches([folder], "uwb")[0]
    each = [t.recording for t in batch.trajectories]
    assert len(each[0]) < len(each[1])
    estimates = batch.tracker.run(each)[0]
    loop, _ = loops(batch, each[0], estimates)["NumPy"]
    assert difference(loop(), estimates, len(each[0])) <= AGREEMENT_M
