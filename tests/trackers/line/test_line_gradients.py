"""The particles' score by every number of the line's tracker, the initial standard deviation included, against the grid's gradient."""

import numpy as np
import pytest

from tests.known_start import NEVER_LOST
from tests.oracles.gradients import gradients
from tests.trackers.line.test_line_filters import GRID, REPORT, STARTS, _trajectories
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.filters.particle.filter import ParticleFilter
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.line.tracker import FloorFixes, LineStart
from trackwright.trackers.parts.fixes import FIXES

KEYS, PARTICLES = 64, 500
TUNED = ("motion.*", "sensors.*", "start.sigma_start")


@pytest.fixture(scope="module")
def slopes():
    motion = STARTS["halting"][0]
    start = LineStart(motion.line, Scale(0.5, "m"), Scale(0.1, "m/s"), resting=True)

    def of(filter, keys):
        tracker = Tracker(motion, {FIXES: FloorFixes(0.25, None)}, start, filter, NEVER_LOST)
        return gradients(tracker, stack(_trajectories("halting", keys)), TUNED)

    return of(GRID, 1).gradient[:, 0], of(ParticleFilter(PARTICLES, output_map=REPORT), KEYS).gradient


@pytest.mark.slow
def test_the_mean_score_of_rests_departures_fixes_and_start_is_the_grids_gradient(slopes):
    exact, scores = slopes
    assert len(exact) == 6
    error = np.abs(scores.mean(axis=1) - exact)
    # The grid's own gradient is off by the square of its cells: 0.002. Of six numbers one is beyond four standard
    # errors in one of 2,600 choices of keys.
    assert np.all(error < 4 * scores.std(axis=1) / np.sqrt(KEYS) + 0.002)
