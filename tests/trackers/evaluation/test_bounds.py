"""The bound of a recording's positions: rows with known truth, axes in their places, and what has no bound."""

from pathlib import Path

import numpy as np
import pytest

from tests.oracles import cramer_rao, van_loan
from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.core.model.motion import GroundMotion
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.evaluation.bounds import bounds_of
from trackwright.trackers.parts.fixes import FIXES, FixSensor, FixStart
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracker_spec import TrackerBatch
from trackwright.trackers.recordings.trajectories import Trajectory

ROWS, SIGMA_A, SIGMA_Z, HORIZONTAL, VERTICAL = 9, 0.7, 0.1, 0.15, 0.4
TIMES = np.cumsum(np.random.default_rng(0).uniform(0.1, 0.6, ROWS))
KNOWN = np.array([False, True, True, False, True, True, True, True, False])
FOLDER = RecordingFolder("walk", Path("walk"), Rig("walk"), {})


def _batch(planar, known=KNOWN):
    rng, trajectories = np.random.default_rng(1), []
    for tag in ("1", "2"):
        place = np.cumsum(rng.normal(size=(ROWS, 3)), axis=0)
        readings = {FIXES: Readings(place, np.ones((ROWS, 3), bool))}
        recording = Recording(TIMES, readings, {"height": np.ones(ROWS)}, {"position": (place, known)}, tag)
        trajectories.append(Trajectory(FOLDER, tag, "", recording))
    tracker = Tracker(
        GroundMotion(SIGMA_A, SIGMA_Z),
        {FIXES: FixSensor(HORIZONTAL, VERTICAL)},
        FixStart(Scale(1.0, "m"), Scale(2.0, "m/s"), planar, 2),
    )
    return TrackerBatch(tracker, trajectories, planar)


@pytest.mark.parametrize("planar", [False, True])
def test_of_a_linear_model_it_is_the_textbook_bound_over_the_span_of_the_truth(planar):
    times, found = bounds_of(FOLDER, [_batch(planar)])
    # From the first to the last row with known truth.
    np.testing.assert_array_equal(times, TIMES[1:8])
    dts = np.diff(times)
    level = [van_loan(np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, SIGMA_A**2]), dt) for dt in dts]
    P = cramer_rao(level, [np.diag([HORIZONTAL**-2, 0.0])] * len(dts), np.diag([1.0, 4.0]))
    horizontal = np.sqrt([1.0, *P[:, 0, 0]])
    vertical = [(np.eye(1), np.array([[SIGMA_Z**2 * dt]])) for dt in dts]
    P = cramer_rao(vertical, [np.array([[VERTICAL**-2]])] * len(dts), np.eye(1))
    height = np.full(7, np.nan) if planar else np.sqrt([1.0, *P[:, 0, 0]])
    np.testing.assert_allclose(found, np.stack([horizontal, horizontal, height], axis=1), rtol=1e-9)
