"""The tracker of ranges: its motion's contract, starts, biases, outliers and gaps."""

import numpy as np
import pytest

from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.parts.multilaterate import recent_positions
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.uwb_imu.fusion import range_tracker

ANCHORS = np.array([[5.0, 0.0, 2.0], [0.0, 6.0, 1.0], [-4.0, -3.0, 2.5], [1.0, -6.0, 2.2], [-5.0, 4.0, 0.5]])
HEIGHT = 1.1


def _rows(rng, count=600, outlier=0.0, sigma=0.02, biases=None, still=False):
    """Times, anchors' numbers, ranges and the true positions of a tag on a circle of 2 m, one range in 20 ms."""
    times = np.arange(count) * 0.02
    numbers = np.arange(count) % len(ANCHORS)
    angle = 0.0 * times if still else 0.5 * times
    positions = np.stack([2 * np.cos(angle), 2 * np.sin(angle), np.full(count, HEIGHT)], axis=1)
    ranges = np.linalg.norm(positions - ANCHORS[numbers], axis=1) + rng.normal(0.0, sigma, count)
    ranges += 0.0 if biases is None else biases[numbers]
    struck = rng.random(count) < outlier
    return times, numbers, np.where(struck, ranges + rng.exponential(5.0, count), ranges), positions


def _recent(times, anchors, numbers, ranges, seen, height):
    """The positions at all rows of one tag."""
    heights = np.array([np.nan if height is None else height])
    return recent_positions(np.array([0, len(times)]), times, anchors, numbers, ranges, seen, heights)


def _recording(times, numbers, ranges, height):
    nearby = _recent(times, ANCHORS, numbers, ranges, np.ones(len(times), bool), height)
    inputs = {
        "anchors": ANCHORS[numbers],
        "anchor": numbers[:, None].astype(float),
        "nearby": nearby,
        "height": np.full(len(times), 0.0 if height is None else height),
    }
    readings = {RANGES: Readings(ranges[:, None], np.ones((len(times), 1), bool))}
    return Recording(times, readings, inputs)


@pytest.fixture(scope="module")
def runs():
    """Errors of a run at a known height: clean, with a tenth of outliers, and after a gap of a minute."""
    tracker = range_tracker(5, planar=True, sigma_a=1.0, sigma_r=0.04, positive_skew=2.0, bias=0.0, sigma_bias=0.05)
    out = {}
    for name, outlier in (("clean", 0.0), ("outlier", 0.1)):
        times, numbers, ranges, positions = _rows(
            np.random.default_rng(2), outlier=outlier, biases=np.array([0.1, 0, 0, 0, -0.1])
        )
        if name == "clean":
            times = times + np.where(np.arange(len(times)) >= 300, 60.0, 0.0)
        estimates = tracker.run(_recording(times, numbers, ranges, HEIGHT))
        estimated = np.stack([np.asarray(x) for x in estimates.mean.position], axis=1)
        out[name] = np.linalg.norm(estimated - positions[:, :2], axis=1), estimates
    return out


def test_the_tracker_follows_a_tag_that_moves_in_a_circle(runs):
    errors, _ = runs["clean"]
    # 2 cm of noise at 50 ranges a second, biases of 10 cm that change along the way for the tracker, not in the world.
    assert np.sqrt(np.mean(errors[150:300] ** 2)) < 0.09


def test_a_tenth_of_outliers_costs_centimetres(runs):
    assert np.sqrt(np.mean(runs["outlier"][0][150:] ** 2)) < 0.12


def test_biases_are_separated_from_motion(runs):
    bias = np.stack([np.asarray(x) for x in runs["outlier"][1].mean.bias], axis=1)
    # The mean of all five is only weakly seen; the difference of 20 cm between two is learnt to a part.
    assert bias[-1, 0] - bias[-1, 4] > 0.08


def test_with_too_many_anchors_the_state_has_only_the_bias_that_they_share():
    tracker = range_tracker(24, planar=True)
    times, numbers, ranges, _ = _rows(np.random.default_rng(3), count=60)
    estimates = tracker.run(_recording(times, numbers, ranges, HEIGHT))
    assert estimates.dimension == 5
    assert estimates.summary() == "ok"


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
