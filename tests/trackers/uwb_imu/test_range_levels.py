"""The tracker of ranges of a site: its number of biases, and its noise levels where the site is calibrated."""

from dataclasses import replace

import numpy as np
import pytest

from trackwright.sim import worlds as simulate
from trackwright.trackers.catalogue import TRACKERS, build
from trackwright.trackers.parts.range_rows import range_trajectories
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.recordings.calibration import UNCALIBRATED, AnchorCalibration, Calibration

ANCHOR = AnchorCalibration(np.zeros(2), np.zeros((2, 2)), np.array([0.0, 20.0]))


def _sigma_bias(folder):
    """The standard deviation of the biases of the tracker that runs on the folder."""
    (batch,) = build("uwb", folder).batches(folder)
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


@pytest.mark.parametrize(("anchors", "biases"), [(4, 8), (8, 8), (9, 16)])
def test_every_anchor_has_a_bias_and_sites_with_a_few_more_or_fewer_share_a_program(anchors, biases):
    folder = simulate.ranges(n=1, rows=20).folder()
    more = {f"more {k}": np.array([k, 9.0, 2.0]) for k in range(anchors - len(folder.rig.anchors))}
    folder = replace(folder, rig=replace(folder.rig, anchors={**folder.rig.anchors, **more}))
    (trajectory,) = range_trajectories(folder, False)
    tracker = TRACKERS["uwb"].build(trajectory, True)
    assert (tracker.motion.biases, *tracker.sensors[RANGES].bias.value.shape) == (biases, biases)
    assert TRACKERS["uwb"].geometry(trajectory) == (biases,)
