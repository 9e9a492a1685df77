"""Values fitted to all recordings but one, against fits that never saw it."""

import numpy as np
import pytest

import trackwright as tw
from tests.tuning.worlds import line_tracker, walks
from trackwright.tuning import left_out
from trackwright.tuning.left_out import left_out_values
from trackwright.tuning.objectives import StateLogLikelihood

LEVELS = ("motion.sigma_v", "sensors.gauge.sigma")


def _world():
    return [*walks([300, 200], 1), *walks([250], 2, sigma=0.5)]


@pytest.mark.parametrize("objective", ["nll", StateLogLikelihood(dimensions=1)])
def test_the_values_without_a_recording_are_those_of_a_fit_to_the_others(objective):
    made = _world()
    every = tw.fit(line_tracker(), made, objective, LEVELS)
    found = left_out_values(every)
    assert list(found) == ["1", "2", "3"]
    alone = tw.fit(line_tracker(), made[:2], objective, LEVELS)
    for name in LEVELS:
        assert float(found["3"][name]) == pytest.approx(float(alone.values[name]), rel=0.02)
        assert abs(np.log(found["3"][name] / every.values[name])) > 0.02, "the third is noisier"


def test_more_recordings_than_folds_are_left_out_several_at_once(monkeypatch):
    monkeypatch.setattr(left_out, "MOST_FOLDS", 2)
    every = tw.fit(line_tracker(), _world(), "nll", LEVELS)
    found = left_out_values(every)
    assert sorted(found) == ["1", "2", "3"]
    assert found["1"] is not found["3"]
    assert {k: float(v) for k, v in found["1"].items()} == {k: float(v) for k, v in found["3"].items()}


def test_one_recording_has_no_other():
    assert left_out_values(tw.fit(line_tracker(), walks([100], 1), "nll", LEVELS)) == {}
