"""The simulated assembly line: three situations on the thesis's path, and errors in the ratios it prints."""

import numpy as np
import pytest

from trackwright.sim.line import THESIS_KNOTS, LineDraw


def _moving(world):
    """Start and end of every tag's trip, s."""
    arclength = world.arclength
    first = np.argmax(arclength > 1e-9, axis=1)
    return world.times[first], world.times[np.argmax(arclength >= arclength[:, -1:] - 1e-9, axis=1)]


@pytest.mark.parametrize("situation", ["constant", "halts", "speeds"])
def test_tags_rest_ten_seconds_before_and_after_and_end_at_the_end(situation):
    world = LineDraw(situation).drawn(5, seed=1)
    start, end = _moving(world)
    # The rows are 0.2 s apart.
    np.testing.assert_allclose(start, 10.0, atol=0.21)
    np.testing.assert_allclose(world.times[-1] - end, 10.0, atol=0.41)
    np.testing.assert_allclose(world.positions[:, -1], np.tile(THESIS_KNOTS[-1], (5, 1)))
    assert np.all(np.diff(world.arclength, axis=1) >= 0)


def test_constant_speed_is_constant_and_halts_last_five_seconds_at_the_joins():
    constant, halting = LineDraw("constant").drawn(), LineDraw("halts").drawn()
    moving = np.diff(constant.arclength[0])
    assert np.median(moving[moving > 0]) == pytest.approx(0.3 / 5)
    for join in (4.05, 6.159, 10.209, 12.295):
        here = np.abs(halting.arclength[0] - join) < 1e-9
        assert 24 <= here.sum() <= 26
    assert halting.times[-1] - constant.times[-1] == pytest.approx(20.0, abs=0.21)


def test_errors_are_as_large_as_printed_and_half_of_their_variance_is_slow():
    world = LineDraw("constant").drawn(200, seed=3)
    error = world.fixes - world.positions
    # 200 tags x 75 s with a time constant of 1.5 s: about 10,000 independent errors.
    assert np.mean(np.hypot(*np.moveaxis(error, -1, 0))) == pytest.approx(0.39, abs=0.01)
    lag = 5
    correlation = np.mean(error[:, lag:] * error[:, :-lag]) / np.mean(error**2)
    assert correlation == pytest.approx(0.5 * np.exp(-1.0 / 1.5), abs=0.02)
