"""The spread that a scale of Student's t implies, against draws."""

import numpy as np
import pytest

import trackwright as tw
from trackwright.tuning.implied_spread import implied_spread, student_t_spread


@pytest.mark.parametrize(("dof", "skew"), [(30.0, 1.0), (6.0, 3.0), (1.8, 4.0), (1.0, 1.0)])
def test_the_spread_is_that_of_draws(dof, skew):
    rng = np.random.default_rng(4)
    up = rng.random(2_000_000) < skew / (1 + skew)
    drawn = 0.02 * np.abs(rng.standard_t(dof, len(up))) * np.where(up, skew, -1.0)
    found = student_t_spread(0.02, dof, skew)
    assert found.is_deviation is (dof > 2)
    expected = drawn.std() if found.is_deviation else np.subtract(*np.quantile(drawn, [0.84, 0.16])) / 2
    assert found.value == pytest.approx(expected, rel=0.02)


def test_only_a_scale_of_students_t_has_one():
    tracker = tw.range_tracker(4)
    found, expected = implied_spread(tracker, "sensors.ranges.sigma_r"), student_t_spread(0.09, 1.8, 4.0)
    assert (found.value, found.is_deviation) == (pytest.approx(expected.value), False)
    assert implied_spread(tracker, "sensors.ranges.dof") is None
    assert implied_spread(tracker, "motion.sigma_a") is None
    assert implied_spread(tw.fix_tracker(dof=None), "sensors.fixes.sigma_horizontal") is None
