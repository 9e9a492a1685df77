"""The tracker of ranges: its number of biases, and its covariance in worlds of its own model."""

import numpy as np

from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.uwb_imu.fusion import range_tracker

ANCHORS = np.array([[5.0, 0.0, 2.0], [0.0, 6.0, 1.0], [-4.0, -3.0, 2.5], [1.0, -6.0, 2.2], [-5.0, 4.0, 0.5]])
HEIGHT = 1.1


def test_the_covariance_is_consistent_where_the_world_is_the_model():
    """300 tags over the floor by the model's own motion, biases and normal noise: NEES over them of chi-squared."""
    runs, rows, step = 300, 80, 0.05
    sigma_a, sigma_r, sigma_bias, sigma_shared, constant = 0.5, 0.1, 0.05, 0.15, 5.0
    rng = np.random.default_rng(4)

    def normal(*shape):
        return rng.normal(size=(runs, *shape))

    times, numbers = np.arange(rows) * step, np.arange(rows) % len(ANCHORS)
    position, velocity, bias = normal(2), normal(2), sigma_bias * normal(len(ANCHORS))
    begun, shared = position + normal(2), sigma_shared * normal()
    recordings, readings = [], []
    for k in range(rows):
        if k:
            along, across = normal(2), normal(2)
            kick = sigma_a * np.sqrt(step)
            position = position + velocity * step + kick * step * (along / 2 + across / np.sqrt(12))
            velocity = velocity + kick * along
            kept = np.exp(-step / constant)
            bias = kept * bias + sigma_bias * np.sqrt(1 - kept**2) * normal(len(ANCHORS))
        full = np.column_stack([position, np.full(runs, HEIGHT)])
        readings.append(
            np.linalg.norm(full - ANCHORS[numbers[k]], axis=1) + bias[:, numbers[k]] + shared + sigma_r * normal()
        )
    for run in range(runs):
        nearby = np.column_stack([np.tile(begun[run], (rows, 1)), np.full(rows, HEIGHT), np.ones(rows)])
        inputs = {
            "anchors": ANCHORS[numbers],
            "anchor": numbers[:, None].astype(float),
            "nearby": nearby,
            "height": np.full(rows, HEIGHT),
        }
        values = np.array([r[run] for r in readings])[:, None]
        recordings.append(Recording(times, {RANGES: Readings(values, np.ones((rows, 1), bool))}, inputs))
    # Student's t with a million degrees of freedom is normal to six digits.
    tracker = range_tracker(
        5,
        True,
        sigma_a,
        memory=1e4,
        sigma_r=sigma_r,
        positive_skew=1.0,
        dof=1e6,
        bias=0.0,
        sigma_bias=sigma_bias,
        time_constant=constant,
        sigma_shared=sigma_shared,
    )
    estimates = tracker.run(stack(recordings))
    estimated = np.stack([np.asarray(x)[:, -1] for x in (*estimates.mean.position, *estimates.mean.velocity)], axis=1)
    errors = estimated - np.column_stack([position, velocity])
    cov = estimates.covariance[:, -1, :4, :4]
    nees = np.einsum("ri,rij,rj->r", errors, np.linalg.inv(cov), errors)
    # The mean of 300 chi-squared numbers of 4 degrees of freedom: 4 ± 3 √(8/300); linearising adds a few per cent.
    assert 3.5 < nees.mean() < 4.7
