"""The tracker of ranges of a site: its number of biases, and its noise levels where the site is calibrated."""

from dataclasses import replace

import numpy as np
import pytest

import trackwright as tw
from trackwright.sim import worlds as simulate
from trackwright.trackers.catalogue import TRACKERS, build
from trackwright.trackers.parts.ranges import RANGES, range_trajectories
from trackwright.trackers.recordings.calibration import UNCALIBRATED, AnchorCalibration, Calibration
from trackwright.trackers.uwb_imu.fusion import range_levels

ANCHOR = AnchorCalibration(np.zeros(2), np.zeros((2, 2)), np.array([0.0, 20.0]))


def _sigma_bias(folder):
    """The standard deviation of the biases of the tracker that runs on the folder."""
    batch = build("uwb", folder).only_batch(folder)
    return float(batch.tracker.motion.sigma_bias.value)


def test_biases_of_a_calibrated_site_have_its_spread_and_no_mean():
    folder = simulate.tool(n=1, seed=0, rows=40).folder()
    calibration = Calibration(anchors=dict.fromkeys(folder.rig.anchors, ANCHOR), range_spread=0.031)
    calibrated = folder.calibrated(calibration)
    assert _sigma_bias(calibrated) == pytest.approx(0.031)
    assert not np.any(build("uwb", calibrated).tunables["sensors.ranges.bias"].value)
    # Without a spread the biases have that of other sites; a calibration of stations alone changes nothing.
    assert _sigma_bias(folder.calibrated(replace(calibration, range_spread=None))) == pytest.approx(0.07)
    stations = Calibration(stations={"S": UNCALIBRATED}, range_spread=0.031)
    assert _sigma_bias(folder.calibrated(stations)) == _sigma_bias(folder)


@pytest.mark.parametrize("name", ["uwb", "uwb-imu"])
def test_without_a_calibration_errors_of_ranges_last_and_batches_are_apart(name):
    folder = simulate.tool(n=1, seed=0, rows=40).folder()
    calibrated = replace(folder.calibrated(Calibration(anchors=dict.fromkeys(folder.rig.anchors, ANCHOR))), name="b")
    named = build(name, [folder, calibrated])
    batches = named.batches([folder, calibrated])
    assert [batch.tracker.lasting_errors for batch in batches] == [True, False]


@pytest.mark.parametrize(("anchors", "biases"), [(4, 8), (8, 8), (9, 16)])
def test_every_anchor_has_a_bias_and_sites_with_a_few_more_or_fewer_share_a_program(anchors, biases):
    folder = simulate.ranges(n=1, rows=20).folder()
    more = {f"more {k}": np.array([k, 9.0, 2.0]) for k in range(anchors - len(folder.rig.anchors))}
    folder = replace(folder, rig=replace(folder.rig, anchors={**folder.rig.anchors, **more}))
    (trajectory,) = range_trajectories(folder, False)
    tracker = TRACKERS["uwb"].build(trajectory, True)
    assert (tracker.motion.biases, *tracker.sensors[RANGES].bias.value.shape) == (biases, biases)
    assert TRACKERS["uwb"].geometry(trajectory) == (biases,)


ANCHORS = np.array([[0.0, 0.0, 2.5], [10.0, 0.0, 2.0], [10.0, 8.0, 2.5], [0.0, 8.0, 2.0]])
SPREAD, HEIGHT, DT, RUNS, ROWS = 0.085, 1.0, 0.05, 200, 600


def _walks(time_constant, length):
    """Ranges of `RUNS` walks in NumPy, with Gauss–Markov biases of standard deviation `SPREAD`, and white noise."""
    rng = np.random.default_rng(3)
    kept, kick = np.exp(-DT / 5.5), 0.44 * np.sqrt(DT)
    position, velocity = [5.0, 4.0] + rng.normal(size=(RUNS, 2)), rng.normal(size=(RUNS, 2))
    bias, number = SPREAD * rng.normal(size=(RUNS, 4)), np.arange(ROWS) % 4
    truth, ranges = np.empty((RUNS, ROWS, 3)), np.empty((RUNS, ROWS))
    for row, k in enumerate(number):
        decay = np.exp(-DT * (1 / time_constant + np.hypot(*velocity.T) / length))[:, None]
        bias = decay * bias + np.sqrt(1 - decay**2) * SPREAD * rng.normal(size=(RUNS, 4))
        position, velocity = position + velocity * DT, kept * velocity + kick * rng.normal(size=(RUNS, 2))
        truth[:, row] = np.column_stack([position, np.full(RUNS, HEIGHT)])
        ranges[:, row] = np.linalg.norm(truth[:, row] - ANCHORS[k], axis=1) + bias[:, k] + 0.05 * rng.normal(size=RUNS)
    times = np.arange(ROWS) * DT
    recordings = [tw.uwb_imu.range_recording(times, z, ANCHORS, anchor=number, height=HEIGHT) for z in ranges]
    return recordings, truth[:, :, :2]


def _inside(tracker, recordings, truth):
    """The share of true positions (R, T, 2), m, inside the 95 % ellipses, after the first two seconds."""
    estimates = tracker.run(recordings)
    error = (np.stack([np.asarray(x) for x in estimates.mean.position], axis=-1) - truth)[:, 40:]
    cov = np.asarray(estimates.covariance)[:, 40:, :2, :2]
    return np.mean(np.einsum("rti,rtij,rtj->rt", error, np.linalg.inv(cov), error) < 5.991)


@pytest.mark.slow
def test_smoothed_ellipses_of_a_calibrated_site_hold_the_truth_whatever_the_biases_time_scale():
    """Biases that last for 2 to 30 s and 0.5 to 1.5 m: inside 93 to 97 %."""
    levels = range_levels(Calibration(anchors={"A": ANCHOR}, range_spread=SPREAD))
    tracker = tw.Smoothed(tw.uwb_imu.range_tracker(4, planar=True, **levels))
    for scales in ((2.0, 0.5), (5.0, 1.5), (30.0, 0.8)):
        assert 0.93 < _inside(tracker, *_walks(*scales)) < 0.97, scales
