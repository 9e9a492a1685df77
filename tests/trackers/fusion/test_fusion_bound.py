"""Ranges and bearings in one state: errors beside the Cramér–Rao bound, and consistency, in worlds of the tracker's model."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.known_start import NEVER_LOST
from trackwright.experiments.lab.validation.own_worlds import own_world
from trackwright.sim import worlds
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.tunable import tunables
from trackwright.trackers.core.run.crlb import posterior_bound

TAGS, SETTLED = 32, 80
"""Tags, and rows until the start is forgotten."""


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.5, 1.0, 2.0])
def test_errors_reach_the_bound_and_ellipses_hold(noise):
    """Normal noise, and a start near the truth, about which readings are linear."""
    batch = TRACKERS["fusion"].batches([worlds.fusion(TAGS, 5, rows=60, lost=0.0, hidden=0.0).folder()], "fusion")[0]
    levels = {
        name: noise * np.asarray(node.value)
        for name, node in tunables(batch.tracker).items()
        if (name.startswith("sensors.") and ".sigma_" in name) or "sigma_bias" in name
    }
    normal = {"sensors.*.dof": 1e4, "sensors.ranges.positive_skew": 1.0, "motion.drifts.*.length": 1e30}
    near = {"start.sigma_position": 0.15, "start.sigma_velocity": 0.3}
    tracker = replace(batch.tracker, track_loss=NEVER_LOST).with_values(levels | normal | near)
    drawn, priors, states = own_world(tracker, [trajectory.recording for trajectory in batch.trajectories], 1)
    estimates = tracker.run(drawn, initial=priors)
    paths = [jax.tree_util.tree_map(lambda x, k=k: np.asarray(x)[..., k : k + 1], states) for k in range(TAGS)]
    # Of each path by itself: the mean information of paths that pass a station at other distances is of none of them.
    bounds = np.stack([posterior_bound(tracker, stack([r]), path) for r, path in zip(drawn, paths, strict=True)])
    true = np.stack(list(states.position), axis=-1).swapaxes(0, 1)
    errors = (np.stack(list(estimates.mean.position), axis=-1) - true)[:, SETTLED:]
    ratio = np.sqrt(np.mean(errors**2, axis=(0, 1)) / np.mean(bounds[:, SETTLED:, :3] ** 2, axis=(0, 1)))
    assert np.all((ratio > 0.9) & (ratio < 1.25))
    covariance = np.asarray(estimates.covariance)[:, SETTLED:, :2, :2]
    nees = np.einsum("btk,btkl,btl->bt", errors[..., :2], np.linalg.inv(covariance), errors[..., :2])
    assert 0.8 < nees.mean() / 2 < 1.3
    assert 0.90 < np.mean(nees < 5.991) < 0.98
