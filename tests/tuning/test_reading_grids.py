"""The rounding of readings as the lower bound of a fitted noise level."""

import dataclasses

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.tuning.worlds import line_tracker, walks
from trackwright.sim import worlds
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.recordings.reading_grids import of_raw_readings, reading_grids
from trackwright.tuning.data import fit_data
from trackwright.tuning.fit_arrays import FitArrays
from trackwright.tuning.parameters import select_parameters
from trackwright.tuning.reading_grids import floors

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


def test_readings_that_are_held_are_bounded_by_their_changes():
    rng = np.random.default_rng(5)
    (made,) = walks([600], 1)
    held = np.repeat(np.cumsum(0.3 * rng.choice([-1, 1], 200) * rng.uniform(0.9, 1.1, 200)), 3)[:, None]
    recording = Recording(made.times, {"gauge": Readings(held, np.ones((600, 1), bool))}, made.inputs)
    tracker = line_tracker()
    (grid,) = reading_grids(tracker, [stack([recording])])
    assert np.isnan(grid.step)
    assert grid.change == pytest.approx(0.3, rel=0.05)
    parameters = select_parameters(tracker, [SIGMA])
    assert floors([grid], parameters, {}) == pytest.approx(np.log(grid.change / np.sqrt(12)), rel=1e-6)
    result = tw.fit(line_tracker(0.3, 0.5), recording, "nll", ["motion.sigma_v", SIGMA])
    (text,) = (text for text in result.cautions if "changes" in text)
    assert text.startswith(
        f"{SIGMA} fell to {grid.change / np.sqrt(12):.3g} m, the changes of its readings (typically "
    )


def test_averages_have_the_step_of_the_raw_readings():
    folder = worlds.ranges(n=1, rows=200, seed=1).folder()
    rounded = folder.tables["ranges"].with_columns(range_m=(pl.col("range_m") / 0.2).round() * 0.2)
    used = dataclasses.replace(folder, tables=folder.tables | {"ranges": rounded}).averaged(0.37)
    data = fit_data(tw.build("uwb", used).only_batch(used), "nll")
    (grid,) = reading_grids(data.tracker, data.rows())
    assert not grid.step > 0.1, "the readings that the tracker gets have no such step"
    (raw,) = of_raw_readings([grid], [used])
    assert raw.step == pytest.approx(0.2, rel=1e-6)
    assert FitArrays.of(data).folders == [used]
    without = worlds.ranges(n=1, rows=200, seed=2).folder()
    assert of_raw_readings([grid], [used, without])[0].step == pytest.approx(grid.step, nan_ok=True)
