"""The rounding of readings as the lower bound of a fitted noise level."""

import numpy as np
import pytest

from tests.tuning.worlds import line_tracker, walks
from trackers.core.recording import Readings, Recording, stack
from trackers.recordings.reading_grids import reading_grids
from tuning.parameters import select_parameters
from tuning.reading_grids import floors

SIGMA = "sensors.gauge.sigma"


def test_noise_levels_have_the_rounding_as_their_lower_bound_unless_bounded():
    rng = np.random.default_rng(4)
    (made,) = walks([500], 1)
    values = 0.2 * np.round(rng.normal(0, 3, (500, 1)))
    recording = Recording(made.times, {"gauge": Readings(values, np.ones((500, 1), bool))}, made.inputs)
    tracker = line_tracker()
    parameters = select_parameters(tracker, ["motion.sigma_v", SIGMA])
    grids = reading_grids(tracker, [stack([recording])])
    assert floors(grids, parameters, {}) == pytest.approx([-np.inf, np.log(0.2 / np.sqrt(12))], rel=1e-4)
    assert floors(grids, parameters, {SIGMA: (0.01, 1.0)})[1] == -np.inf
