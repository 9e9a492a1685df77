"""Real ranges with one set of noise levels: errors about those of the recordings' own baselines, or below them."""

import numpy as np
import pytest

from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.parts.ranges import range_trajectories
from trackwright.trackers.recordings.folder import read_recording
from trackwright.trackers.uwb_imu.fusion import range_tracker

pytestmark = pytest.mark.slow

# Horizontal RMSE, m, and 3-D where it is judged: of a Kalman filter whose noise was tuned on that very recording, and a
# centimetre more where biases are smaller than the defaults, whose covariances hold elsewhere, expect.
PLANAR = {"labyrinth": 0.22, "trolley": 0.16}
SPATIAL = {
    "starloc-2d-s5": (0.09, None),
    "starloc-fast-s1": (0.26, 0.45),
    "rcv-drone-3": (0.22, None),
    "iasl-drone-1": (0.078, 0.13),
}


def _errors(folder, name, tracker):
    """Errors (n, 2 or 3), m, of all tags at the last row of each time where the truth is known."""
    trajectories = list(range_trajectories(read_recording(folder / name), False))
    longest = max(len(trajectory.recording) for trajectory in trajectories)
    # Two lengths in all, so that each tracker is compiled for few shapes.
    estimates = tracker.run(stack([trajectory.recording for trajectory in trajectories], rows=max(8192, longest)))
    parts = []
    for k, trajectory in enumerate(trajectories):
        position, known = trajectory.recording.truth["position"]
        rows = len(trajectory.recording)
        last = known & np.append(np.diff(trajectory.recording.times) > 0, True) & estimates[k].usable[:rows]
        estimated = np.stack([np.asarray(x)[k, :rows] for x in estimates.mean.position], axis=1)
        parts.append((estimated - position[:, : estimated.shape[1]])[last])
    return np.concatenate(parts)


@pytest.fixture(scope="module")
def planar():
    return range_tracker(8, planar=True)


@pytest.mark.parametrize("name", PLANAR)
def test_tags_at_a_known_height_are_tracked_better_than_by_the_baseline(shipped, planar, name):
    errors = _errors(shipped, name, planar)
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < PLANAR[name]


@pytest.fixture(scope="module")
def spatial():
    return range_tracker(8)


@pytest.mark.parametrize("name", SPATIAL)
def test_tags_in_three_dimensions_are_tracked_better_than_by_the_baseline(recordings, spatial, name):
    errors = _errors(recordings, name, spatial)
    horizontal, in_space = SPATIAL[name]
    assert np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))) < horizontal
    if in_space is not None:
        assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < in_space
